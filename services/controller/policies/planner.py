"""Default policy: drives to a goal around walls and obstacles.

The navigator applies the limits to the velocities that this policy returns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.world import lack_of_room
from common.robot.scan_geometry import ALL_ROUND, Sweep
from common.runtime import safety
from services.controller.policies import expected_free_energy as efe
from services.controller.policies.active_localisation import ActiveLocaliser, ViewpointPaths
from services.controller.policies.decision import Decision, DecisionState
from services.controller.policies.free_space import NO_MAP, FreeSpace
from services.controller.policies.geodesic_field import OBSTACLE_GAP_M, WALL_COST_RANGE_M, CostField, FreeSpaceGraph
from services.controller.policies.motion_model import (
    STANDING_SPEED,
    braking_speed,
    is_moving,
    period_of,
    stopping_distance,
    turn_rate,
    turn_to_lookahead,
)
from services.controller.policies.motion_selection import PoseBelief, Surroundings, least_distance, select_motion
from services.controller.policies.obstacles import MAX_RANGE_M, TemporaryObstacles
from services.controller.policies.recovery import BACKING_OFF, MAX_GAP_NS, STUCK_AFTER_NS, Recovery, back_off
from services.controller.policies.scan_information import ScanInformation

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from common.messages.definitions import Belief, Scan
    from common.messages.requests import PredictReply
    from common.robot.robot import Robot

REPLAN_PERIOD_NS = 400_000_000  # minimum time between two plans when obstacles near the path change
REPLAN_PERIOD_FAR_NS = 1_500_000_000  # the same when obstacles change elsewhere
BLIND_AHEAD = "the scanner does not see ahead, where a differential base drives: mount it facing ahead"
NO_SIGHT = "the scanner sees no farther than the robot's own radius: check range_max of the scans, and radius"
MAX_GOAL_SHIFT_M = 2.0  # maximum distance from an occupied goal at which the robot waits until it is free
MIN_PROGRESS_M = 0.02  # near the goal, the robot counts as stuck if it moves by less than this
MAX_COST_TO_GOAL_M = 100.0  # larger costs are clipped, also that of a goal to which no path leads


class GeodesicPolicy:
    """Preset `geodesic`: drives around the walls of a map and around obstacles in the scan."""

    def __init__(
        self, robot: Robot, world: World | None, *, keep_heading: bool = False, epistemic: bool = True
    ) -> None:
        """Builds the graph of the world. Without a world, every goal is refused until `use_map`.

        ``keep_heading``: a holonomic base does not turn to face its direction of motion. ``epistemic``: motions are
        also judged by the information that they gain; otherwise the robot drives on as if the best hypothesis were
        true.
        """
        # In a growing map this is off, because the information of a scan cannot be computed where the map is unknown.
        self.epistemic = epistemic and world is not None
        self.robot, self.world, self.keep_heading = robot, world, keep_heading
        self._unlimited_robot = robot  # the maximum speed of `robot` is less if the scanner's range is too short for it
        self.free = NO_MAP if world is None else FreeSpace.of(world)
        self.graph = FreeSpaceGraph(self.free, robot.radius)
        self.obstacles = TemporaryObstacles(self.free)
        self._recovery = Recovery()
        self.localiser = ActiveLocaliser(
            robot, self.graph, robot.radius + OBSTACLE_GAP_M, self._recovery, may_turn=not keep_heading
        )
        self.field: CostField | None = None  # to the goal, around obstacles unless `ignores_obstacles`
        self.ignores_obstacles = False  # whether the field leads through obstacles, because they leave no path
        self.field_changed = False  # set by `_update_field` when there is another field; the publisher clears it
        self._goal: Array | None = None
        self._component: int | None = None  # of the graph, where the robot was when last tracked
        self._scan: Scan | None = None
        self._information: ScanInformation | None = None  # None before the first scan, and without `epistemic`
        self._obstacles_set_ns = -REPLAN_PERIOD_NS  # when obstacles were last given to the graph
        self._obstacle_cells: npt.NDArray[Any] = np.zeros(0, int)  # cells of the graph that these obstacles occupy
        self._field_outdated = False  # whether the field was computed before these obstacles were given
        self._reachable_from: int | None = None  # a component of the graph; the goal can be reached from there
        self._field_of_view = ALL_ROUND
        # A place near the goal, (2,) m in map, and the stamp since which the robot has stayed within `MIN_PROGRESS_M`
        # of it; None until it is near the goal.
        self._last_progress: tuple[Array, int] | None = None
        self._decided_ns = 0  # stamp of the last belief for which it decided
        self._obstacle_near_ns = -STUCK_AFTER_NS  # when an obstacle was last near the robot or the goal

    def refusal(self, goal: Array) -> str | None:
        """The reason why a goal (2,) m cannot be reached according to the map, or None if it can.

        The text names the nearest place that can be reached.
        """
        if self.free is NO_MAP:
            return "there is no map yet; does the mapper run, and do scans arrive?"
        refusal = self._wall_refusal(goal)
        if refusal is None:
            cell = self.graph.nearest_free(goal, self.robot.radius, map_only=True)
            if cell is not None and self._component in (None, self.graph.component[cell]):
                return None
            refusal = self._refusal_text(goal, "cannot be reached from here")
        nearest = self.graph.nearest_free(goal, component=self._component, map_only=True)
        if nearest is None:
            return refusal
        where = self.free.place_text(self.free.grid.centres([nearest])[0])
        return f"{refusal}; the nearest place that can be reached is {where}"

    def _refusal_text(self, goal: Array, problem: str) -> str:
        map_name = "the map so far" if self.world is None else self.world.name
        return f"{self.free.place_text(goal)} in {map_name} {problem}"

    def _wall_refusal(self, goal: Array) -> str | None:
        """The reason why the robot cannot stand at a goal (2,) m, or None if it can."""
        if self.world is not None:
            return self.world.placement_error(goal, self.robot.radius)
        clearance = float(self.free.clearance_at(goal)) if self.free.grid.inside(goal) else -1.0
        if clearance >= self.robot.radius:
            return None
        return self._refusal_text(goal, lack_of_room(clearance, self.robot.radius))

    def use_map(self, graph: FreeSpaceGraph, *, jumped: bool) -> None:
        """Plans in a new version of the mapper's map.

        If a loop closure has moved places in it (``jumped``), the obstacles seen so far are forgotten.
        """
        self.free, self.graph = graph.free, graph
        if jumped:
            self.obstacles = TemporaryObstacles(self.free)
        else:
            self.obstacles.change_map(self.free)
        self.localiser.use_graph(graph)
        self.field = self._component = self._reachable_from = None
        self._obstacles_set_ns, self._obstacle_cells = -REPLAN_PERIOD_NS, np.zeros(0, int)

    def set_goal(self, goal: Array | None) -> None:
        """Sets the goal (2,) m in map, or none."""
        self._goal, self.field, self._reachable_from = goal, None, None
        self.localiser.reset()
        self.interrupt()

    def interrupt(self) -> None:
        """Stops watching for progress: a robot that does not drive to its goal is not stuck."""
        self._last_progress = None
        self._recovery.reset()

    def resume(self) -> None:
        """Does nothing: `interrupt` discarded nothing that has to be restored."""

    def prepare(self, scan: Scan) -> None:
        """Limits the speed to what the scanner's range allows; called with each scan.

        With the first, it also computes how informative scans are in each place; uninformative places cost more.
        """
        self._limit_speed(scan)
        if not self.epistemic or self._information is not None:
            return
        self._information = ScanInformation.of(self.graph, scan, self.robot.max_speed)
        self.graph.set_extra_cost_per_metre(self._information.ambiguity / efe.NATS_PER_METRE)

    def observe(self, scan: Scan | None, belief: Belief) -> None:
        """Stores the scan and its field of view; while tracking, also obstacles and the robot's part of the graph."""
        if scan is not None:
            self._field_of_view = Sweep.of(scan).sector(scan.mount.yaw)
            self._scan = scan
        if belief.state != "tracking":
            return  # the pose is not reliable; obstacles found so far are kept
        self.localiser.reset()
        pose = belief.pose.array()
        if scan is not None:
            self.obstacles.update(scan, pose)
        if (cell := self.graph.nearest_free(pose[:2], self.graph.min_clearance, map_only=True)) is not None:
            self._component = int(self.graph.component[cell])

    def _limit_speed(self, scan: Scan) -> None:
        """Limits the speed so that the robot can stop within the range in which the scanner shows obstacles."""
        sight = min(scan.range_max, MAX_RANGE_M) - self._unlimited_robot.radius - OBSTACLE_GAP_M
        if (speed := braking_speed(sight, self._unlimited_robot)) != self.robot.max_speed:
            self.robot = self._unlimited_robot.model_copy(update={"max_speed": speed})

    def decide(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:
        """Chooses the velocity of least expected free energy; arguments as for `Policy.decide`."""
        pose, stamp_ns = se2.compose(belief.pose.array(), motion_until_effect), belief.stamp_ns
        if not 0 <= stamp_ns - self._decided_ns <= MAX_GAP_NS:  # without beliefs, the robot stood
            self.interrupt()
        self._decided_ns = stamp_ns
        if (refusal := self._refusal_from_here()) is not None:
            return Decision(reason=refusal, state="blocked", refused=True)
        points, moving = self.obstacles.points(), self.obstacles.moving(stamp_ns)
        self._update_field(pose[:2], points[~moving], stamp_ns)  # moving obstacles will have left
        path = self.field.path(pose[:2]) if self.field is not None else np.zeros((0, 2))
        if not len(path):
            return Decision(reason="no way to the goal from here", state="blocked")
        surroundings = self._surroundings(pose, points, moving)
        if self._recovery.is_active(stamp_ns):
            selected = back_off(velocity, surroundings, self.robot, period_of(self._scan))
            motion = se2.transform(pose, selected.poses[:, :2])
            return Decision(selected.action, BACKING_OFF, "blocked", path, motion, recovering=True)
        assert self.field is not None  # noqa: S101 - there is a path
        turning = abs(float(velocity[2])) > STANDING_SPEED
        stop = self._stop_beside_goal(stamp_ns, pose, self.field.goal, surroundings, path, turning=turning)
        if stop is not None:
            return stop
        lookahead = self.field.lookahead_point(pose[:2], path, stopping_distance(self.robot))
        cost_beyond = self.field.cost_from(lookahead)
        lookahead = se2.rotate(-pose[2], lookahead - pose[:2])
        known = PoseBelief(pose, _covariance(belief), self._information)
        selected = select_motion(velocity, lookahead, surroundings, self.robot, known, cost_beyond)
        action = turn_to_lookahead(
            velocity,
            selected.action,
            lookahead,
            self.robot,
            may_turn=surroundings.may_turn,
            forward=surroundings.forward,
            period=period_of(self._scan),
        )
        # The velocity that was commanded counts, not the action: the limits may have stopped the robot.
        self._recovery.watch(stamp_ns, moving=is_moving(velocity))
        standing = not selected.action.any()
        reason = self._reason(pose, surroundings, hindered=selected.hindered, standing=standing)
        state: DecisionState = "blocked" if reason and standing else "navigating"
        motion = se2.transform(pose, selected.poses[:, :2])
        return Decision(action, reason, state, path, motion, terms=selected.terms)

    def _refusal_from_here(self) -> str | None:
        """The reason why the goal cannot be reached from where the robot is; checked again when that changes."""
        if self._goal is None or self._component == self._reachable_from:
            return None
        refusal = self.refusal(self._goal)
        if refusal is None:
            self._reachable_from = self._component
        return refusal

    def prediction_request(self, belief: Belief) -> ViewpointPaths | None:
        """Paths at whose ends scans must be predicted before `decide_unlocalised`; None if none are needed."""
        if self._goal is None or not self.epistemic:
            return None
        return self.localiser.prediction_request(belief)

    def use_predictions(self, reply: PredictReply) -> None:
        """Uses the scans that were predicted for the last `prediction_request`."""
        if self._scan is not None:
            self.localiser.use_predictions(reply, self._scan.range_max, self._cost_to_goal)

    def fail_prediction(self, reason: str) -> None:
        """Stores why the last `prediction_request` was not answered, for the status."""
        self.localiser.fail_prediction(reason)

    def _cost_to_goal(self, points: Array) -> Array:
        """Cost (...,) m of the path to the goal from points (..., 2) m in map, at most `MAX_COST_TO_GOAL_M`."""
        if self.field is None and self._goal is not None:
            self.field, self._field_outdated = self.graph.cost_field(self._goal), True
        if self.field is None:
            return np.full(points.shape[:-1], MAX_COST_TO_GOAL_M)
        return np.minimum(self.field.cost.ravel()[self.free.grid.cell_of(points)], MAX_COST_TO_GOAL_M)

    def decide_unlocalised(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:
        """Chooses a velocity with which the pose becomes known.

        Without `epistemic`, an ambiguous belief leads to the goal, as if its best hypothesis were true. Only then
        ``motion_until_effect`` is used: the localiser plans from the pose of the belief.
        """
        if self._scan is None:
            return Decision(reason=f"standing until localised: the belief is {belief.state}")
        self._last_progress = None  # near the goal, the robot is not stuck while its pose is not known
        if self.epistemic or belief.state != "ambiguous":
            points = safety.scan_points(self._scan)
            points = points[np.hypot(*points.T) < MAX_RANGE_M]
            return self.localiser.decide(belief, self._scan, points, velocity, self._field_of_view)
        decision = self.decide(belief, velocity, motion_until_effect)
        decision.reason = decision.reason or f"the belief is {belief.state}: assuming its best hypothesis"
        return decision

    def _update_field(self, position: Array, points: Array, stamp_ns: int) -> None:
        """Recomputes the cost field if the goal, the map or the obstacles, ``points`` (K, 2) m in map, have changed.

        Changed obstacles are given to the graph first, and a field that still leads to the goal is recomputed only with
        the next scan, because each of the two takes milliseconds.
        """
        if self._goal is None:
            self.field = None
            return
        cells = np.unique(self.free.grid.cell_of(points)) if len(points) else np.zeros(0, int)
        changed = np.setxor1d(cells, self._obstacle_cells, assume_unique=True)
        if self.field is None or (len(changed) and self._may_replan(self.field, position, changed, stamp_ns)):
            self.graph.set_obstacles(points)
            self._obstacles_set_ns, self._obstacle_cells, self._field_outdated = stamp_ns, cells, True
            if self.field is not None and not self.ignores_obstacles:
                return
        if self.field is not None and not self._field_outdated:
            return
        self._field_outdated = False
        self.field = self.graph.cost_field_around_obstacles(self._goal, MAX_GOAL_SHIFT_M, position)
        self.field_changed = True
        self.ignores_obstacles = False
        if self.field is None or not self.field.reaches(position):
            # Obstacles leave no path. Drive by the map alone, up to the obstacle that blocks the path, and wait there.
            self.graph.set_obstacles(np.zeros((0, 2)))
            self.field = self.graph.cost_field_around_obstacles(self._goal, MAX_GOAL_SHIFT_M, position)
            self.ignores_obstacles = bool(len(points))

    def _may_replan(self, field: CostField, position: Array, changed: npt.NDArray[Any], stamp_ns: int) -> bool:
        """Whether the plan is old enough to be replaced because obstacles in the cells ``changed`` came or went."""
        age = stamp_ns - self._obstacles_set_ns
        if age < 0 or age >= REPLAN_PERIOD_FAR_NS:  # below 0, the simulation was reset
            return True
        return age >= REPLAN_PERIOD_NS and self._affects_path(field, position, changed)

    def _affects_path(self, field: CostField, position: Array, cells: npt.NDArray[Any]) -> bool:
        """Whether obstacles in these cells may change the path of the field from ``position`` (2,) m."""
        if self.ignores_obstacles:
            return True
        path = field.path(position)
        if not len(path):
            return False
        distance = least_distance(self.free.grid.centres(cells), path)
        return bool(distance.min() < self.graph.min_clearance + WALL_COST_RANGE_M)

    def _surroundings(self, pose: Array, points: Array, moving: npt.NDArray[np.bool_]) -> Surroundings:
        def wall_distance(positions: Array) -> Array:
            return self.free.clearance_at(se2.transform(pose, positions))

        return Surroundings(
            wall_distance,
            se2.rotate(-pose[2], points - pose[:2]),
            moving,
            self.graph.min_clearance,
            self.robot.radius + OBSTACLE_GAP_M,
            field_of_view=self._field_of_view,
            may_turn=not self.keep_heading,
        )

    def _stop_beside_goal(
        self, stamp_ns: int, pose: Array, place: Array, surroundings: Surroundings, path: Array, *, turning: bool
    ) -> Decision | None:
        """The decision to stop beside a goal that cannot be reached exactly; None while the robot can drive on.

        Beside an obstacle the robot waits; otherwise the goal is refused. ``place`` (2,) m is the end of the ``path``:
        the goal, or the free place beside it. A robot that is ``turning`` may first have to turn around.
        """
        assert self._goal is not None  # noqa: S101 - there is a path
        to_goal = self._goal - pose[:2]
        distance, shift = float(np.hypot(*to_goal)), float(np.hypot(*(place - self._goal)))
        if distance > shift + 2 * self.robot.radius:
            self._last_progress = None
        elif self._last_progress is None or np.hypot(*(pose[:2] - self._last_progress[0])) > MIN_PROGRESS_M:
            # A robot that drives past the goal because its commands come late also moves: no wall stops it.
            self._last_progress = (pose[:2], stamp_ns)
        # Other free places may be as near to the goal as this one, so the robot need not stand exactly here.
        arrived = shift > 0 and distance < shift + self.free.grid.resolution
        half_turn_ns = 1e9 * np.pi / self.robot.max_turn
        patience_ns = STUCK_AFTER_NS + (half_turn_ns if turning else 0.0)
        stuck = self._last_progress is not None and stamp_ns - self._last_progress[1] > patience_ns
        of_robot, of_goal = (
            np.hypot(*(surroundings.points - centre).T).min(initial=np.inf)
            for centre in (np.zeros(2), se2.rotate(-pose[2], to_goal))
        )
        if min(of_robot, of_goal) < 2 * self.robot.radius:
            self._obstacle_near_ns = stamp_ns
            reason = f"{distance:.2f} m from the goal, {self._hindrance_text(pose, surroundings, standing=True)}"
            if not (arrived or stuck):
                return None
            # The robot must see the goal to notice that the obstacle has gone.
            return Decision(self._turn_to_see(se2.rotate(-pose[2], to_goal), surroundings), reason, "blocked", path)
        # After an obstacle has gone, the field may still lead around it for a while.
        if not stuck or distance > self.robot.radius or 0 <= stamp_ns - self._obstacle_near_ns < STUCK_AFTER_NS:
            return None
        stopped = f"stopped {distance:.2f} m from the goal, probably because a wall is too close"
        problem = f"cannot be reached exactly: {stopped}"
        return Decision(reason=self._refusal_text(self._goal, problem), state="blocked", path=path, refused=True)

    def _turn_to_see(self, place: Array, surroundings: Surroundings) -> Array:
        """Action (3,) that turns the robot on the spot until its scanner sees a ``place`` (2,) m in base_link."""
        bearing = float(np.arctan2(place[1], place[0]))
        if not surroundings.may_turn or surroundings.sees(bearing):
            return np.zeros(3)
        return np.array([0.0, 0.0, turn_rate(float(se2.wrap(bearing - surroundings.forward)), self.robot)])

    def _reason(self, pose: Array, surroundings: Surroundings, *, hindered: bool, standing: bool) -> str:
        """Status text: why the robot does not drive freely, or nothing."""
        if self.robot.drive == "differential" and not bool(surroundings.sees(0.0)):
            return BLIND_AHEAD
        if not self.robot.max_speed:
            return NO_SIGHT
        if self.ignores_obstacles:
            return self._no_path_text(pose, surroundings, standing=standing)
        return self._hindrance_text(pose, surroundings, standing=standing) if hindered else ""

    def _hindrance_text(self, pose: Array, surroundings: Surroundings, *, standing: bool) -> str:
        """Status text for when something rules out the best motion.

        It names the nearest obstacle, but not as the cause: that may be another obstacle, or a wall.
        """
        effect = "waiting" if standing else "slowed or diverted"
        if not len(surroundings.points):
            return f"{effect}: a wall is near"
        nearest, position = self._nearest_point(pose, surroundings)
        # Anything seen for less than a second may be a person, or a box that was just moved.
        what = "something that may move" if surroundings.moving[nearest] else "something that is not in the map"
        away = f"{np.hypot(*surroundings.points[nearest]):.1f} m away at {position}"
        return f"{effect}; the nearest obstacle is {what}, {away}"

    def _no_path_text(self, pose: Array, surroundings: Surroundings, *, standing: bool) -> str:
        """Status text for when obstacles leave no path."""
        place = f", the nearest at {self._nearest_point(pose, surroundings)[1]}" if len(surroundings.points) else ""
        activity = "waiting until they go" if standing else "driving up to them"
        return f"no way around obstacles that are not in the map{place}: {activity}"

    def _nearest_point(self, pose: Array, surroundings: Surroundings) -> tuple[int, str]:
        """Index of the obstacle point nearest to the robot, and its position as text. Requires at least one."""
        nearest = int(np.argmin(np.hypot(*surroundings.points.T)))
        return nearest, self.free.place_text(se2.transform(pose, surroundings.points[nearest]), decimals=1)


def _covariance(belief: Belief) -> Array:
    """Covariance (3, 3) of x, y, yaw of a belief; zero if the estimator states none."""
    return np.zeros((3, 3)) if belief.covariance is None else np.asarray(belief.covariance, float)
