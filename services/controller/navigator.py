"""Turns beliefs into commands: handles the goal and manual driving, calls the policy, and applies the limits."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Drive, Exploration, Goal, PolicyEnergy, Scan, Status
from common.robot.robot import Robot
from common.robot.self_filter import NO_FILTER, SelfFilter
from common.runtime import safety
from services.controller.docking import STANDING_TIME_S, Docking
from services.controller.explorer import Explorer
from services.controller.goal_state import GoalState, Phase
from services.controller.lifts import LiftRide, plan_ride
from services.controller.manual_drive import ManualDrive
from services.controller.policies.decision import Decision, Policy
from services.controller.policies.exploration import FieldOfView
from services.controller.policies.motion_model import STEP_S, delay_until_effect, is_moving, period_of, turn_rate
from services.controller.policies.paper_action import ActionParameters
from services.controller.policies.straight_line import StraightLinePolicy
from services.controller.velocity_command import VelocityCommand

if TYPE_CHECKING:
    from common.geometry.floors import Floor
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.controller.growing_map import PlanningMap
    from services.controller.policies.exploration import ExplorationState, NoPath, Viewpoint

MAX_RECENT_SCANS = 60  # 4 s at 15 Hz: longer than a search of the whole map takes on a slow computer


class Answer(NamedTuple):
    """The answer to a belief, or to a scan without one: a command and a status, both with its stamp."""

    command: CmdVel
    status: Status


@dataclass
class Navigator:
    """Turns beliefs into commands and statuses. A policy chooses the velocity.

    All times are stamps of messages, never those of a clock.
    """

    robot: Robot = field(default_factory=Robot)
    world: World | None = None  # the map; None while the mapper builds it, or if preset `paper` drives without a map
    chosen_policy: Policy | None = None  # defaults to preset `paper`
    self_filter: SelfFilter = NO_FILTER

    def __post_init__(self) -> None:
        self.policy: Policy = self.chosen_policy or StraightLinePolicy(self.robot, ActionParameters(), self.world)
        self.decision = Decision()  # what the policy decided on the latest belief
        self.goal_state = GoalState()
        self._command = VelocityCommand(self.robot)
        self._manual = ManualDrive()
        self._docking: Docking | None = None  # if the goal has an approach direction
        self._ride: LiftRide | None = None  # while the goal is on another floor
        self._map: PlanningMap | None = None  # the mapper's, if there is one
        self._pose: Array | None = None  # (3,) base_link in map, of the latest belief in state `tracking`
        self._tracking = False  # whether the latest belief is in that state
        self._floor: Floor | None = None  # of the robot when the destination was chosen; None if it was unknown
        self.explorer: Explorer | None = None  # None before the first, after a cancel, and once a goal follows its end
        self._exploration_request: Goal | None = None  # waits for the first map and a pose in it
        self._goal_count = 0  # goals and cancels so far; a viewpoint chosen before the latest is discarded
        self._recent_scans: deque[Scan] = deque(maxlen=MAX_RECENT_SCANS)  # the latest last
        self._scan_points = np.zeros((0, 2))  # m in base_link

    def on_scan(self, scan: Scan) -> None:
        """Stores the scan, without the robot itself and its motion, for the obstacle limits and the policy."""
        if self._scan is not None and scan.stamp_ns < self._scan.stamp_ns:  # the simulation was reset
            self._recent_scans.clear()
        corrected = self.self_filter.correct_and_mask(scan, self._command.velocity)
        self._recent_scans.append(corrected)
        self._scan_points = safety.scan_points(corrected)
        self.policy.prepare(corrected)

    def on_drive(self, drive: Drive) -> None:
        """Stores a manual velocity command, which has priority over the goal."""
        # The scan's stamp first: after a simulation reset, the command still has a stamp from before.
        self._manual.update(drive, self.scan_stamp or self._command.stamp_ns or 0)

    def on_goal(self, goal: Goal) -> None:
        """Replaces, cancels or refuses the goal, or begins to explore. A goal known to be unreachable is refused."""
        self._exploration_request = None
        self._goal_count += 1
        if goal.cancel or goal.explore or self.explorer is None or not self.explorer.active:
            self.explorer = None
        else:
            self.explorer.pause()
        if goal.explore and not goal.cancel:
            self._explore(goal)
        else:
            self._set_goal(goal)

    def _explore(self, request: Goal) -> None:
        self._cancel_goal()
        if isinstance(self.policy, StraightLinePolicy):
            reason = "preset paper cannot explore: use preset geodesic, and start with `presage up --mapping`"
            self.goal_state.start(request, reason)
            return
        if self.world is not None:
            self.goal_state.start(request, "cannot explore in a known world: start with `presage up --mapping`")
            return
        self._exploration_request = request
        self._begin_exploration()

    @property
    def _explores(self) -> bool:
        """Whether an exploration decides where the robot drives, or begins as soon as the robot is localised."""
        if self.explorer is not None and self.explorer.sets_goals:
            return True
        return self._exploration_request is not None and self._map is not None

    def _begin_exploration(self) -> None:
        """Begins the requested exploration when there is a map and the robot is localised in it."""
        if self._exploration_request is None or not self._tracking:
            return
        if self._map is not None and self._pose is not None:
            self.explorer = Explorer(self._exploration_request.seq, self._pose, self._map)
            self._exploration_request = None

    def on_map(self, planned: PlanningMap) -> None:
        """Uses a new version of the mapper's map, unless it has no key scans. The caller passes it to the policy.

        If mapping has started again, the goal is refused and an exploration fails.
        """
        if not len(planned.message.poses):
            return
        before, self._map = self._map, planned
        if self.explorer is not None and self.explorer.use_map(planned):
            self._cancel_goal()
        if self.goal_state.active and before is not None and planned.mapping_restarted_since(before):
            self._docking = self._ride = None
            self.goal_state.refuse("mapping has started again: send the goal again")
            self.policy.set_goal(None)

    def take_exploration_state(self) -> ExplorationState | None:
        """Returns the input for the choice of a viewpoint, or None if no choice is due.

        The caller passes the viewpoint that was chosen to `use_viewpoint`.
        """
        explorer = self.explorer
        if explorer is None or not explorer.tracking or self.goal_state.phase is Phase.UNLOCALISED:
            return None  # the robot first has to be localised
        if self._scan is None or not explorer.viewpoint_due:
            return None
        explorer.viewpoint_due = False
        if not explorer.sets_goals:
            return None
        field_of_view = FieldOfView.of(self._scan, explorer.map.message.grid.resolution)
        return explorer.exploration_state(field_of_view, self._goal_count)

    def use_viewpoint(self, viewpoint: Viewpoint | NoPath | None, exploration_state: ExplorationState) -> None:
        """Drives to the viewpoint that was chosen, or back to the start if there is none.

        ``viewpoint`` may also be the reason why none can be planned.
        """
        outdated = exploration_state.goal_count != self._goal_count
        if self.explorer is None or not self.explorer.sets_goals or outdated:
            return
        if not self.explorer.tracking:
            self.explorer.viewpoint_due = True
            return
        half_field_of_view = exploration_state.field_of_view.sector.half
        goal = self.explorer.next_goal(viewpoint, half_field_of_view, under_way=self.goal_state.active)
        if not self.explorer.active:  # it has failed, so the robot must not drive on to the last viewpoint
            self._cancel_goal()
        elif goal is not None:
            self._set_goal(goal)

    def _cancel_goal(self) -> None:
        self._docking = self._ride = None
        self.goal_state.cancel()
        self.policy.set_goal(None)

    def _set_goal(self, goal: Goal) -> None:
        if goal.cancel:
            self._cancel_goal()
            return
        self._docking = self._ride = None
        try:
            goal = goal.in_map(self.world)
        except UserError as error:
            self.goal_state.start(goal, str(error))
            self.policy.set_goal(None)
            return
        self._docking = None if goal.approach is None else Docking(goal, self.robot)
        self.goal_state.start(goal, self._refusal(goal))
        self._choose_destination(goal)

    def _choose_destination(self, goal: Goal) -> None:
        """Gives the policy the goal, or a lift if the goal is on another floor; refuses it if there is no lift."""
        destination = goal.pose.array()[:2] if self._docking is None else self._docking.line()[0]
        self._ride, self._floor = None, self._present_floor()
        if self.goal_state.active and self.world is not None and self._pose is not None and self._floor is not None:
            ride = plan_ride(self.world, self._pose, destination, self.policy.refusal)
            if isinstance(ride, str):
                self.goal_state.refuse(ride)
            elif ride is not None:
                self._ride, destination = ride, ride.place
        self.policy.set_goal(destination if self.goal_state.active else None)

    def _present_floor(self) -> Floor | None:
        """The floor on which the robot is known to be."""
        if self.world is None or self._pose is None or not self._tracking:
            return None
        return self.world.floor_at(self._pose)

    def _follow_floor(self) -> None:
        """Chooses the destination again if the robot is on another floor than that for which it was chosen."""
        goal, floor = self.goal_state.goal, self._present_floor()
        if goal is not None and self.goal_state.active and floor is not None and floor != self._floor:
            self._choose_destination(goal)

    def _refusal(self, goal: Goal) -> str | None:
        def refusal_at(place: Array) -> str | None:
            if self.world is not None and self.world.floors and self._present_floor() != self.world.floor_at(place):
                # The policy can check paths only on the robot's floor.
                return self.world.placement_error(place, self.robot.radius)
            return self.policy.refusal(place)

        if self._docking is None:
            place = goal.pose.array()[:2]
            # A goal at which the robot stands already is never refused, whatever the map says about walls.
            at_goal = self._pose is not None and np.hypot(*(self._pose[:2] - place)) <= goal.tolerance
            return None if at_goal else refusal_at(place)
        if (reason := self._docking.refusal()) is not None:
            return reason
        reasons = [refusal_at(point) for point in self._docking.line()]
        return next((f"the line to the goal is not free: {reason}" for reason in reasons if reason is not None), None)

    @property
    def _scan(self) -> Scan | None:
        """The latest scan; None before the first one."""
        return self._recent_scans[-1] if self._recent_scans else None

    def _scan_of(self, belief: Belief) -> Scan | None:
        """The scan of a belief; None if it has not come, or is too old."""
        return next((scan for scan in reversed(self._recent_scans) if scan.stamp_ns == belief.stamp_ns), None)

    @property
    def scan_stamp(self) -> int | None:
        """Stamp of the latest scan in ns; None before the first scan."""
        return None if self._scan is None else self._scan.stamp_ns

    def step(self, belief: Belief) -> Answer:
        """Returns command and status for a belief, both with its stamp."""
        pose, manual_twist = belief.pose.array(), self._manual.twist(belief.stamp_ns)
        self._resume_after_pause(belief.stamp_ns)
        self.decision = Decision()
        self._tracking = belief.state == "tracking"
        if self._tracking:
            self._pose = pose
        self._begin_exploration()
        if self.explorer is not None:
            self.explorer.update_pose(pose, belief.stamp_ns, self.robot.max_speed, tracking=self._tracking)
        self.policy.observe(self._scan_of(belief), belief)
        self._follow_floor()
        if manual_twist is not None:
            self._suspend_goal()
        goal = self.goal_state.goal
        distance = None if goal is None else float(np.hypot(*(goal.pose.array() - pose)[:2]))
        shown_distance = distance if self._ride is None else None  # between floors it has no meaning
        if manual_twist is not None:
            command, _ = self._command.limit(belief.stamp_ns, manual_twist, self._scan_points)
            return Answer(command, self._add_exploration(self._manual_status(belief.stamp_ns, shown_distance)))
        desired = np.zeros(3)
        if goal is not None and distance is not None and self.goal_state.active:
            desired = self._goal_velocity(belief, pose, goal, distance)
        elif not self._tracking and self._explores:
            desired = self._localising_velocity(belief)
        command, limited_by_scan = self._command.limit(belief.stamp_ns, desired, self._scan_points)
        moving = is_moving(self._command.velocity)
        self.goal_state.update_progress(
            belief.stamp_ns, pose, self.decision, moving=moving, limited_by_scan=limited_by_scan
        )
        if self.explorer is not None:
            self.explorer.update(self.goal_state, belief.stamp_ns)
        status = self._add_exploration(self.goal_state.status(belief.stamp_ns, shown_distance))
        if (terms := self.decision.terms) is not None:
            status = status.model_copy(update={"energy": PolicyEnergy(**terms)})
        return Answer(command, status)

    def step_without_belief(self, stamp_ns: int) -> Answer | None:
        """Returns command and status for a scan while no estimator runs, so that manual driving still works.

        Returns None if the robot stands and is not driven by hand.
        """
        manual_twist = self._manual.twist(stamp_ns)
        if manual_twist is None and not self._command.velocity.any():
            return None
        self._resume_after_pause(stamp_ns)
        if manual_twist is not None:
            self._suspend_goal()
            command, _ = self._command.limit(stamp_ns, manual_twist, self._scan_points)
            return Answer(command, self._add_exploration(self._manual_status(stamp_ns, None)))
        self.goal_state.lose_belief("no belief: is the estimator running?")
        command, _ = self._command.limit(stamp_ns, np.zeros(3), self._scan_points)
        return Answer(command, self.status(stamp_ns))

    @property
    def waits_for_scan(self) -> bool:
        """Whether every scan was answered: the simulation may be paused. Otherwise the estimator is late."""
        answered_ns = self._command.stamp_ns  # newer than the last scan if only the estimator got the one after it
        return self._scan is not None and answered_ns is not None and self._scan.stamp_ns <= answered_ns

    def stop_without_belief(self, stamp_ns: int, reason: str) -> Answer:
        """Returns the command to stop and its status, for when no belief came in time.

        The goal is kept, and resumed with the next belief.
        """
        command = self._command.stop(stamp_ns, paused=self.waits_for_scan)
        self.policy.interrupt()
        self.goal_state.lose_belief(reason)
        status = self.status(stamp_ns)
        if not status.refused:  # otherwise keep showing why the goal was refused
            status = status.model_copy(update={"reason": reason})
        return Answer(command, status)

    def _resume_after_pause(self, stamp_ns: int) -> None:
        if self._command.resume(stamp_ns):
            self.policy.resume()

    def _suspend_goal(self) -> None:
        self.goal_state.suspend()
        self.policy.interrupt()
        self._interrupt_docking()

    def _manual_status(self, stamp_ns: int, distance: float | None) -> Status:
        """Status with state "manual"; the state of the goal is left as it is."""
        reason = "driven by hand; the goal waits" if self.goal_state.active else "driven by hand"
        status = self.goal_state.status(stamp_ns, distance)
        return status.model_copy(update={"state": "manual", "reason": reason})

    def status(self, stamp_ns: int) -> Status:
        """The status between two beliefs."""
        return self._add_exploration(self.goal_state.status(stamp_ns, None))

    def _add_exploration(self, status: Status) -> Status:
        """The status with the progress of the exploration, if there is one."""
        if self._exploration_request is not None:
            progress = Exploration(phase="exploring", seq=self._exploration_request.seq, area=0.0, path=0.0)
            missing = "for the mapper's first map" if self._map is None else "until the robot is localised in the map"
            reason = f"waiting {missing}"
            return status.model_copy(update={"exploration": progress, "state": "exploring", "reason": reason})
        return status if self.explorer is None else self.explorer.add_progress(status)

    def _goal_velocity(self, belief: Belief, pose: Array, goal: Goal, distance: float) -> Array:
        """Velocity (3,) in base_link that the policy chooses, before any limit; updates the state of the goal."""
        if not self._tracking:
            return self._localising_velocity(belief)
        self.goal_state.find_pose()
        if self._ride is not None:
            return self._lift_velocity(self._ride, belief, pose)
        if self._docking is not None:
            velocity = self._docking_velocity(self._docking, belief, pose, goal)
            if velocity is not None:
                return velocity
        elif distance <= goal.tolerance:
            self.policy.interrupt()
            turn = self._turn_to_goal_heading(se2.compose(pose, self._motion_until_effect(belief.stamp_ns)), goal)
            if turn is None:
                # Only once the robot stands: one that turns while it brakes may leave the tolerance again.
                if self._has_stood(belief.stamp_ns, 0.0):
                    self.goal_state.reach(_arrival(belief, goal))
                return np.zeros(3)
            self.decision = Decision(turn, "at the goal: turning to its heading")
            return turn
        return self._policy_velocity(belief)

    def _localising_velocity(self, belief: Belief) -> Array:
        self.decision = self.policy.decide_unlocalised(
            belief, self._command.velocity, self._motion_until_effect(belief.stamp_ns)
        )
        self.goal_state.lose_pose(self.decision.state, self.decision.reason)
        self._interrupt_docking()
        return self.decision.action

    def _policy_velocity(self, belief: Belief) -> Array:
        self.decision = self.policy.decide(belief, self._command.velocity, self._motion_until_effect(belief.stamp_ns))
        if self.decision.refused:
            self.goal_state.refuse(self.decision.reason)
        return self.decision.action

    def _lift_velocity(self, ride: LiftRide, belief: Belief, pose: Array) -> Array:
        """Velocity (3,) in base_link towards the lift, or zero at it."""
        if ride.is_at_lift(pose):
            self.policy.interrupt()
            self.decision = Decision(reason=ride.reason(pose))
            return np.zeros(3)
        velocity = self._policy_velocity(belief)
        self.decision.reason = self.decision.reason or ride.reason(pose)
        return velocity

    def _docking_velocity(self, docking: Docking, belief: Belief, pose: Array, goal: Goal) -> Array | None:
        """Velocity (3,) in base_link on the line to the goal; None while the policy drives to the line."""
        velocity = docking.velocity(se2.compose(pose, self._motion_until_effect(belief.stamp_ns)), self._command_period)
        if velocity is None:
            return None
        self.policy.interrupt()
        self.decision = Decision(velocity)
        if not velocity.any() and self._has_stood(belief.stamp_ns, STANDING_TIME_S) and docking.arrived(pose):
            self.goal_state.reach(_arrival(belief, goal))
        return velocity

    @property
    def _command_period(self) -> float:
        """Time in s for which a command holds: until the next scan."""
        return max(STEP_S, period_of(self._scan))

    def _motion_until_effect(self, stamp_ns: int) -> Array:
        """Motion (3,) in base_link from a stamp until a command with that stamp takes effect."""
        return self._command.motion_until_effect(stamp_ns, delay_until_effect(self.robot, self._scan))

    def _has_stood(self, stamp_ns: int, seconds: float) -> bool:
        """Whether the base has stood for this time before a stamp, and no command is still to take effect."""
        delay = delay_until_effect(self.robot, self._scan)
        motion = self._command.motion_until_effect(stamp_ns, delay + seconds)
        return not (motion.any() or self._command.velocity.any())

    def _interrupt_docking(self) -> None:
        if self._docking is not None:
            self._docking.interrupt()

    def _turn_to_goal_heading(self, pose: Array, goal: Goal) -> Array | None:
        """Velocity (3,) of a turn towards the goal's heading; None if any heading will do, or it is reached.

        ``pose`` (3,) is that at which the command takes effect.
        """
        if goal.yaw_tolerance is None:
            return None
        error = float(se2.wrap(goal.pose.yaw - pose[2]))
        if abs(error) <= goal.yaw_tolerance:
            return None
        return np.array([0.0, 0.0, turn_rate(error, self.robot, self._command_period)])


def _arrival(belief: Belief, goal: Goal) -> str:
    """Status text on arrival, with the uncertainty of the position if that is larger than the tolerance."""
    reason = f"within {goal.tolerance:g} m of the goal"
    if belief.covariance is None:  # the estimator does not state how uncertain the position is
        return f"believed {reason}"
    uncertainty = 2 * float(np.sqrt(np.linalg.eigvalsh(belief.covariance[:2, :2])[-1]))  # 2 sigma
    return reason if uncertainty <= goal.tolerance else f"{reason}, but the pose is only known to {uncertainty:.2g} m"
