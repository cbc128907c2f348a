"""Chooses where to drive while the pose is ambiguous or unknown.

The candidates are paths to viewpoints: places from which a scan may distinguish the possible poses. With several
possible poses, the expected free energy of a path in nats is

    G(path) = NATS_PER_METRE * (cost to the viewpoint + cost from there to the goal)
              + entropy of a beam there - novelty * information of a scan there

The cost to the goal and the entropy are means over the possible poses. The information is how well predicted scans
distinguish the poses. Its novelty is less than 1 near a place where the robot has already been, because scans from one
place are not independent.

With an unknown pose there is no path to the goal, and no scan can be predicted. The candidates are then straight lines
to free places in the present scan, and the cost is that of the line and of the turn towards it. The information is the
entropy of an unknown pose, times the novelty of the place, times the probability that the map shows the place as free.
So if the map covers a part of the building, the robot stays in this part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.ranges import is_surface
from common.robot.scan_geometry import Sweep
from services.controller.policies import expected_free_energy as efe
from services.controller.policies.decision import Decision
from services.controller.policies.expected_free_energy import NATS_PER_METRE, ExpectedFreeEnergy
from services.controller.policies.motion_model import STEP_S, period_of, turn_to_lookahead
from services.controller.policies.motion_selection import Surroundings, select_motion
from services.controller.policies.recovery import BACKING_OFF, back_off
from services.controller.policies.scan_information import DEFAULT_SIGMA_M

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan
    from common.messages.requests import PredictReply
    from common.robot.robot import Robot
    from common.robot.scan_geometry import Sector
    from services.controller.policies.geodesic_field import CostField, FreeSpaceGraph
    from services.controller.policies.recovery import Recovery

MIN_WEIGHT = 1e-3  # lighter hypotheses are ignored: a belief can be `tracking` despite them
# A hypothesis counts as at least this probable. The robot drives to the goal only when all other hypotheses are
# excluded; without this limit, to exclude an improbable one would not be worth a metre of driving.
MIN_COUNTED_WEIGHT = 0.05
MAX_HYPOTHESES = 6  # scans are predicted for each
VIEWPOINT_SPACING_M = 1.0  # of the viewpoints that are compared
# Limits of the cost of the path to a viewpoint: 1 per metre where nothing is near and scans give the pose, else more.
MIN_PATH_COST_M, MAX_PATH_COST_M = 0.8, 12.0
MAX_VIEWPOINTS = 60
CHOICE_PERIOD_NS = 1_000_000_000  # minimum time between two choices of a viewpoint
MAX_SPEED = 0.5  # m/s, because it is not known what is behind and beside the robot
INITIAL_WAIT_NS = 1_000_000_000  # time for the estimator to localise before the robot moves
CORRELATION_LENGTH_M = 1.0  # scans from places this far apart are nearly independent
MAX_VISITED = 100  # positions kept, VISITED_SPACING_M apart
VISITED_SPACING_M = 0.25
UNSEEN_RANGE_M = 1.5  # obstacles this close are remembered when they leave the field of view
UNSEEN_MEMORY_NS = 5_000_000_000  # and forgotten after this time, when dead reckoning is no longer exact enough
UNSEEN_CELL_M = 0.05  # one point is kept per cell of this size
STALLED_NS = 3_000_000_000  # after this time without progress, the robot gives up the viewpoint
REACHED_M = 0.1  # a viewpoint nearer than this was reached
PROGRESS_M, PROGRESS_RAD = 0.25, 0.5  # a motion or turn by this is progress; turning to and fro by less is not
MAX_USEFUL_DISTANCE_M = 5.0  # more free distance than this is no advantage
HALF_WINDOW_RAD = 0.35  # the free distance in a direction is the shortest range this far to either side of it
MIN_FREE_DISTANCE_M = 0.7  # if every direction has less, the robot turns on the spot
TURN_RATE = 0.5  # rad/s, of a turn on the spot to look elsewhere
MAX_LOOKAHEAD_M = 2.0  # distance of the lookahead point while the pose is unknown
NOMINAL_SIGMA_M = 0.02  # standard deviation of a beam at which its entropy counts as 0


@dataclass(frozen=True)
class ViewpointPaths:
    """Paths to viewpoints, compared under one belief. The first hypothesis is the best one."""

    hypotheses: Array  # (K, 3) base_link in map
    weights: Array  # (K,)
    displacements: Array  # (M, 3) from start to end, in base_link; the same from each hypothesis
    path_costs: Array  # (M,) m

    def poses(self) -> Array:
        """Poses (K, M, 3) in map at the end of each path from each hypothesis."""
        return se2.compose(self.hypotheses[:, None, :], self.displacements[None, :, :])


class VisitedPlaces:
    """Where the robot has been while its pose was not known, in the present base_link, by dead reckoning."""

    def __init__(self) -> None:
        self.positions = np.zeros((1, 2))  # (V, 2) m
        self._stamp_ns: int | None = None

    def integrate(self, stamp_ns: int, velocity: Array) -> Array:
        """Integrates the latest command (3,) up to a stamp; returns the motion (3,) since the stamp before."""
        seconds = 0.0 if self._stamp_ns is None else max(0.0, (stamp_ns - self._stamp_ns) * 1e-9)
        motion = velocity * seconds
        self.positions = se2.rotate(-motion[2], self.positions - motion[:2])
        self._stamp_ns = stamp_ns
        if np.hypot(*self.positions.T).min() > VISITED_SPACING_M:
            self.add(np.zeros(2))
        return motion

    def add(self, place: Array) -> None:
        """Counts a place (2,) m in base_link as visited."""
        self.positions = np.concatenate([self.positions, place[None]])[-MAX_VISITED:]

    def novelty(self, places: Array) -> Array:
        """Share (M,) of the information of a scan that is new at places (M, 2) m in base_link."""
        distance = np.hypot(*np.moveaxis(places[:, None] - self.positions, -1, 0)).min(axis=1)
        return np.asarray(-np.expm1(-(distance**2) / (2 * CORRELATION_LENGTH_M**2)))


class UnseenPoints:
    """Obstacles close to the robot that have left its field of view, in the present base_link, by dead reckoning."""

    def __init__(self) -> None:
        self._points, self._stamps = np.zeros((0, 2)), np.zeros(0, np.int64)  # (K, 2) m, and when they were seen, ns

    def update(self, stamp_ns: int, motion: Array, points: Array, scan: Scan) -> Array:
        """Adds the ``points`` (N, 2) m of the present scan; returns them and those that are out of view.

        ``motion`` (3,) is that since the last update.
        """
        kept, laser = se2.rotate(-motion[2], self._points - motion[:2]), scan.mount.array()
        bearing = np.arctan2(*(kept - laser[:2]).T[::-1]) - laser[2]
        age = stamp_ns - self._stamps
        remembered = (np.hypot(*kept.T) < UNSEEN_RANGE_M) & (age >= 0) & (age < UNSEEN_MEMORY_NS)
        unseen = remembered & (Sweep.of(scan).beams_at(bearing) < 0)
        near = points[np.hypot(*points.T) < UNSEEN_RANGE_M]
        self._points = np.concatenate([kept[unseen], near])
        self._stamps = np.concatenate([self._stamps[unseen], np.full(len(near), stamp_ns)])
        order = np.argsort(-self._stamps, kind="stable")  # of several points in a cell, the latest is kept
        cells = np.round(self._points[order] / UNSEEN_CELL_M)
        latest = order[np.unique(cells, axis=0, return_index=True)[1]]
        self._points, self._stamps = self._points[latest], self._stamps[latest]
        return np.concatenate([points, kept[unseen]])


class StallTimer:
    """Measures for how long the robot has made no progress."""

    def __init__(self, max_speed: float = np.inf) -> None:
        """``max_speed`` is the robot's, in m/s; a slow one needs to move less."""
        self._progress_m = min(PROGRESS_M, 0.5 * max_speed * STALLED_NS * 1e-9)
        self._pose = np.zeros(3)  # in the present base_link, where the robot last made progress
        self._progress_ns: int | None = None  # stamp of the last progress; None before the first one
        self._stamp_ns = 0

    def add_motion(self, stamp_ns: int, motion: Array) -> None:
        """Processes the motion (3,) since the stamp before."""
        self._stamp_ns, self._pose = stamp_ns, se2.between(motion, self._pose)
        moved = np.hypot(*self._pose[:2]) > self._progress_m or abs(self._pose[2]) > PROGRESS_RAD
        if moved or self._progress_ns is None:
            self.restart()

    def restart(self) -> None:
        """Measures from now on."""
        self._pose, self._progress_ns = np.zeros(3), self._stamp_ns

    @property
    def expired(self) -> bool:
        """Whether there was no progress for `STALLED_NS`."""
        return self._progress_ns is not None and self._stamp_ns - self._progress_ns > STALLED_NS


class ActiveLocaliser:
    """Chooses velocities while the pose is ambiguous or unknown."""

    def __init__(
        self,
        robot: Robot,
        graph: FreeSpaceGraph,
        min_point_distance: float,
        recovery: Recovery,
        *,
        may_turn: bool = True,
    ) -> None:
        """Keeps the robot's centre ``min_point_distance`` m away from scan points.

        ``may_turn``: the robot may turn to face its direction of motion.
        """
        self.may_turn = may_turn
        self.robot = robot.model_copy(update={"max_speed": min(robot.max_speed, MAX_SPEED)})
        self.min_point_distance = min_point_distance
        self._recovery = recovery
        self._period = STEP_S  # s between the last scans
        self.use_graph(graph)
        self.reset()

    def use_graph(self, graph: FreeSpaceGraph) -> None:
        """Plans in another map from now on."""
        self.graph = graph
        area = float((graph.free.clearance > 0).sum()) * graph.grid.resolution**2
        # Entropy of an unknown pose, at the resolution of poses.
        resolved = float(np.sqrt(np.linalg.det(efe.RESOLUTION_COVARIANCE)))  # m² rad
        self._unknown_entropy = float(np.log(max(1.0, 2 * np.pi * area / resolved)))

    def reset(self) -> None:
        """Forgets everything. Call it when the pose is known, or the goal has changed."""
        self._visited, self._stall_timer = VisitedPlaces(), StallTimer(self.robot.max_speed)
        self._unseen_points = UnseenPoints()
        self._requested_ns: int | None = None  # stamp of the last search for candidates
        self._paths: ViewpointPaths | None = None  # result of that search; None if the map has no path
        self._prediction_failure = ""  # why the last request was not answered
        self._viewpoint: tuple[Array, dict[str, float]] | None = None  # (3,) in base_link, and its expected free energy
        self._field: tuple[Array, CostField | None] | None = None  # a viewpoint (2,) m in map and its field
        self._unknown_since_ns: int | None = None  # stamp since which there are no likely hypotheses

    def prediction_request(self, belief: Belief) -> ViewpointPaths | None:
        """Candidate paths; scans must be predicted for their end poses and passed to `use_predictions`.

        Returns None if no predictions are needed now.
        """
        poses, weights = _likely_hypotheses(belief)
        stamp = belief.stamp_ns
        if len(poses) < 2 or (self._requested_ns is not None and 0 <= stamp - self._requested_ns < CHOICE_PERIOD_NS):
            return None
        self._requested_ns, self._paths = stamp, self._candidate_paths(poses, weights)
        if self._paths is None:
            self._viewpoint = None
        return self._paths

    def _candidate_paths(self, poses: Array, weights: Array) -> ViewpointPaths | None:
        """Paths from the best of the hypotheses (K, 3), also to the present viewpoint; None if the map has none."""
        field = self.graph.cost_field(poses[0][:2], self.min_point_distance + VIEWPOINT_SPACING_M)
        if field is None or not field.reaches(poses[0][:2]):
            return None
        displacements, path_costs = self._candidate_viewpoints(field, poses[0])
        if self._viewpoint is not None:
            present, _ = self._viewpoint
            cost = field.cost_from(se2.compose(poses[0], present)[:2])
            if np.isfinite(cost):
                displacements = np.concatenate([present[None], displacements])
                path_costs = np.concatenate([[cost], path_costs])
        return ViewpointPaths(poses, weights, displacements, path_costs) if len(path_costs) else None

    def use_predictions(self, reply: PredictReply, range_max: float, cost_to_goal: Callable[[Array], Array]) -> None:
        """Chooses a viewpoint with the predictions for the last request.

        ``cost_to_goal`` returns the cost (...,) m of the paths to the goal from places (..., 2) m in map.
        """
        self._prediction_failure = ""
        paths = self._paths
        if paths is None:
            return
        shape = (len(paths.hypotheses), len(paths.displacements), -1)
        ranges = reply.ranges.astype(np.float64).reshape(shape)
        sigma = np.full_like(ranges, DEFAULT_SIGMA_M)
        if len(reply.sigma):
            sigma = reply.sigma.astype(np.float64).reshape(shape)
        energy = path_energy(paths, ranges, sigma, range_max, cost_to_goal, self._visited.novelty)
        best = int(np.argmin(energy.total))
        self._viewpoint = paths.displacements[best], energy.of(best, energy.total)

    def fail_prediction(self, reason: str) -> None:
        """Stores why the last request was not answered. The next one follows after `CHOICE_PERIOD_NS`."""
        self._prediction_failure = reason

    def decide(self, belief: Belief, scan: Scan, points: Array, velocity: Array, field_of_view: Sector) -> Decision:
        """Chooses a velocity; ``points`` (K, 2) m in base_link are obstacles."""
        self._period = period_of(scan)
        motion = self._visited.integrate(belief.stamp_ns, velocity)
        self._stall_timer.add_motion(belief.stamp_ns, motion)
        points = self._unseen_points.update(belief.stamp_ns, motion, points, scan)
        if self._viewpoint is not None:
            self._viewpoint = (se2.between(motion, self._viewpoint[0]), self._viewpoint[1])
            # A further scan from where it has arrived gives no information. If it kept the viewpoint, the robot would
            # stay until another one is worth its path.
            if np.hypot(*self._viewpoint[0][:2]) < REACHED_M:
                self._viewpoint = None
        self._recovery.restart_timer()  # here, progress decides when the robot backs off
        moving = np.zeros(len(points), bool)  # all points count as static
        surroundings = Surroundings(
            _no_walls, points, moving, 0.0, self.min_point_distance, field_of_view=field_of_view, may_turn=self.may_turn
        )
        if self._recovery.is_active(belief.stamp_ns):
            self._stall_timer.restart()
            action = back_off(velocity, surroundings, self.robot, self._period).action
            return Decision(action, BACKING_OFF, "blocked", recovering=True)
        poses, _ = _likely_hypotheses(belief)
        if len(poses) > 1 and self._requested_ns is not None and self._paths is None:
            return self._drive_to_open_space(belief, scan, surroundings, velocity)
        if len(poses) > 1:
            return self._tell_apart(belief.stamp_ns, poses, surroundings, velocity)
        if self._unknown_since_ns is None or belief.stamp_ns < self._unknown_since_ns:
            self._unknown_since_ns = belief.stamp_ns
        if belief.stamp_ns - self._unknown_since_ns < INITIAL_WAIT_NS:
            self._stall_timer.restart()
            return Decision(reason=f"the belief is {belief.state}: standing while the estimator searches", state="lost")
        return self._drive_to_open_space(belief, scan, surroundings, velocity)

    def _tell_apart(self, stamp_ns: int, poses: Array, surroundings: Surroundings, velocity: Array) -> Decision:
        """Drives to the viewpoint that was chosen to tell the hypotheses (K, 3) apart, or waits until there is one."""
        self._unknown_since_ns = None
        if self._viewpoint is not None:
            self._give_up_if_stalled(stamp_ns, self._viewpoint[0][:2])
            return self._drive_to(poses[0], *self._viewpoint, surroundings, velocity, len(poses))
        self._stall_timer.restart()
        if self._prediction_failure:
            reason = f"{len(poses)} places are possible; standing without predicted scans to tell them apart"
            return Decision(reason=f"{reason}: {self._prediction_failure}", state="lost")
        return Decision(reason=f"{len(poses)} places are possible: choosing where to drive to tell them apart")

    def _give_up_if_stalled(self, stamp_ns: int, place: Array) -> None:
        """Counts the place (2,) m in base_link as visited and backs off, if the robot makes no progress towards it.

        It backs off because, if it cannot reach one place from here, it often cannot reach others either.
        """
        if self._stall_timer.expired:
            self._stall_timer.restart()
            self._visited.add(place)
            self._recovery.begin(stamp_ns)

    def _candidate_viewpoints(self, field: CostField, pose: Array) -> tuple[Array, Array]:
        """Displacements (M, 3) in base_link of the viewpoints around a hypothesis (3,), and costs (M,) m of the paths.

        The ``field`` leads to the hypothesis.
        """
        step = max(1, round(VIEWPOINT_SPACING_M / self.graph.grid.resolution))
        rows, columns = np.meshgrid(*(np.arange(step // 2, n, step) for n in field.cost.shape), indexing="ij")
        cells = (rows * field.cost.shape[1] + columns).ravel()
        cost = field.cost.ravel()[cells]
        is_candidate = (cost > MIN_PATH_COST_M) & (cost < MAX_PATH_COST_M)
        if not is_candidate.any():  # where scans tell little about the pose, a metre costs hundreds
            near = np.hypot(*(self.graph.grid.centres(cells) - pose[:2]).T) < MAX_PATH_COST_M
            is_candidate = (cost > MIN_PATH_COST_M) & np.isfinite(cost) & near
        cells, cost = cells[is_candidate], cost[is_candidate]
        # Thin out to MAX_VIEWPOINTS, evenly over the costs.
        selected = np.argsort(cost, kind="stable")[:: max(1, -(-len(cost) // MAX_VIEWPOINTS))]
        cells, cost = cells[selected], cost[selected]
        # Paths of the field lead to the hypothesis, so a cell's next cell is the previous one on the way there.
        places, previous = self.graph.grid.centres(cells), self.graph.grid.centres(field.next_cell[cells])
        heading = np.arctan2(*(places - previous).T[::-1])  # on arrival
        return se2.between(pose, np.column_stack([places, heading])), cost

    def _drive_to(
        self,
        pose: Array,
        viewpoint: Array,
        terms: dict[str, float],
        surroundings: Surroundings,
        velocity: Array,
        count: int,
    ) -> Decision:
        """Drives from the first of ``count`` hypotheses towards a viewpoint (3,) in base_link."""
        target = se2.compose(pose, viewpoint)[:2]
        if self._field is None or np.hypot(*(self._field[0] - target)) > 2 * self.graph.grid.resolution:
            self._field = (target, self.graph.cost_field(target, self.min_point_distance + VIEWPOINT_SPACING_M))
        field = self._field[1]
        path = field.path(pose[:2]) if field is not None else np.zeros((0, 2))
        where = self.graph.free.place_text(target, decimals=1)
        reason = f"{count} places are possible: going to {where} to tell them apart"
        if field is None or not len(path):
            self._viewpoint = None
            return Decision(reason="no path to a place where the possible poses could be told apart", state="blocked")
        lookahead = se2.rotate(-pose[2], field.lookahead_point(pose[:2], path) - pose[:2])
        return self._approach(lookahead, surroundings, velocity, Decision(reason=reason, path=path, terms=terms))

    def _drive_to_open_space(self, belief: Belief, scan: Scan, surroundings: Surroundings, velocity: Array) -> Decision:
        """Drives straight to the free place in the present scan where the next scan is expected to tell most."""
        bearing, room = _free_distances(scan)
        length = np.minimum(room - self.min_point_distance, MAX_USEFUL_DISTANCE_M)
        if room.max() < MIN_FREE_DISTANCE_M and self.may_turn:
            reason = f"the belief is {belief.state}: turning towards free space"
            return Decision(np.array([0.0, 0.0, TURN_RATE]), reason, "exploring")
        reason = f"the belief is {belief.state}: driving to free space, to see more"
        direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        turn = np.abs(se2.wrap(bearing - surroundings.forward)) * self.robot.max_speed / self.robot.max_turn
        places = np.maximum(length, 0.0)[:, None] * direction
        gain = self._unknown_entropy * self._visited.novelty(places) * self._probability_of_being_mapped(places, belief)
        zero = np.zeros(len(gain))
        energy = ExpectedFreeEnergy(NATS_PER_METRE * (length + turn), zero, zero, gain)
        best = int(np.argmin(energy.total))
        self._give_up_if_stalled(belief.stamp_ns, length[best] * direction[best])
        lookahead = min(float(length[best]), MAX_LOOKAHEAD_M) * direction[best]
        return self._approach(
            lookahead, surroundings, velocity, Decision(reason=reason, terms=energy.of(best, energy.total))
        )

    def _probability_of_being_mapped(self, places: Array, belief: Belief) -> Array:
        """Probability (M,) that the map shows the free places (M, 2) m in base_link as free.

        It is 1 where the map is free at the pose of the belief, and 1 - P(this pose is right) elsewhere.
        """
        in_map = se2.transform(belief.pose.array(), places)
        outside = ~self.graph.grid.inside(in_map) | (self.graph.free.clearance_at(in_map) <= 0)
        return np.asarray(1.0 - (belief.probability or 0.0) * outside)

    def _approach(self, lookahead: Array, surroundings: Surroundings, velocity: Array, decision: Decision) -> Decision:
        """The ``decision`` with a velocity towards the lookahead point (2,) m in base_link."""
        action = turn_to_lookahead(
            velocity,
            select_motion(velocity, lookahead, surroundings, self.robot).action,
            lookahead,
            self.robot,
            may_turn=self.may_turn,
            forward=surroundings.forward,
            period=self._period,
        )
        if not action.any() and self.may_turn:  # no free motion: turn to look elsewhere
            action[2] = TURN_RATE if lookahead[1] >= 0 else -TURN_RATE
        decision.action, decision.state = action, "exploring"
        return decision


def path_energy(
    paths: ViewpointPaths,
    ranges: Array,
    sigma: Array,
    range_max: float,
    cost_to_goal: Callable[[Array], Array],
    novelty: Callable[[Array], Array],
) -> ExpectedFreeEnergy:
    """Expected free energy of M paths under K hypotheses.

    ``ranges`` and ``sigma`` (K, M, B) m are the scans predicted at the ends. ``cost_to_goal`` returns the cost (...,) m
    of the paths to the goal from places (..., 2) m in map; ``novelty`` returns the share (M,) of the information of
    scans at places (M, 2) m in base_link that is new.
    """
    rest_of_path = paths.weights @ cost_to_goal(paths.poses()[..., :2]) / paths.weights.sum()
    nominal_variance = NOMINAL_SIGMA_M**2 + efe.ARRIVAL_ERROR_M**2
    beam_entropy = np.log((sigma**2 + efe.ARRIVAL_ERROR_M**2) / nominal_variance).mean(axis=2) / 2
    gain = efe.place_information(paths.weights, ranges, sigma, range_max)
    return ExpectedFreeEnergy(
        NATS_PER_METRE * (paths.path_costs + rest_of_path),
        paths.weights @ beam_entropy / paths.weights.sum(),
        np.zeros(len(gain)),
        gain * novelty(paths.displacements[:, :2]),
    )


def _likely_hypotheses(belief: Belief) -> tuple[Array, Array]:
    """Poses (K, 3) and counted weights (K,) of the likely hypotheses of an ambiguous belief, best first."""
    likely = [h for h in belief.hypotheses if h.weight >= MIN_WEIGHT and belief.state == "ambiguous"][:MAX_HYPOTHESES]
    poses = np.array([h.pose.array() for h in likely]).reshape(-1, 3)
    return poses, np.array([max(h.weight, MIN_COUNTED_WEIGHT) for h in likely])


def _free_distances(scan: Scan) -> tuple[Array, Array]:
    """Bearing (B,) rad in base_link of each beam, and the room in its direction (B,) m: the least range around it."""
    ranges = np.where(np.isneginf(scan.ranges), 0.0, scan.ranges.astype(np.float64))
    ranges = np.minimum(ranges, MAX_USEFUL_DISTANCE_M)
    # Beams that were not measured, or were cut out, must not limit the room: their neighbours decide.
    ranges[~is_surface(scan.ranges) & ~np.isinf(scan.ranges)] = np.inf
    sweep = Sweep.of(scan)
    half = max(1, round(HALF_WINDOW_RAD / max(sweep.spacing, HALF_WINDOW_RAD / 1000)))  # beams
    # Padding with 0: outside the field of view there is no room.
    padded = np.pad(ranges, half, mode="wrap") if sweep.all_round else np.pad(ranges, half)
    room = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).min(axis=1)
    room[np.isinf(room)] = 0.0  # no beam in the window measured anything
    return scan.angles() + scan.mount.yaw, room


def _no_walls(positions: Array) -> Array:
    """Wall distances (...,) of positions (..., 2) without a map: infinite."""
    return np.full(positions.shape[:-1], np.inf)
