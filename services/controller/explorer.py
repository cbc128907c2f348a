"""Explores an unknown building: chooses viewpoints until nothing is left to see, and then drives back to the start.

| from | event | to |
|---|---|---|
| - | a goal with `explore` | EXPLORING |
| EXPLORING, RETURNING | a viewpoint is worth a visit | EXPLORING |
| EXPLORING, RETURNING | no viewpoint is worth a visit | RETURNING |
| EXPLORING, RETURNING | no path can be planned from where the robot is | RETURNING; FAILED at the start |
| EXPLORING, RETURNING | the robot should return, but its start is not connected to the map | FAILED |
| EXPLORING, RETURNING | mapping has started again | FAILED |
| RETURNING | the robot has arrived, and no viewpoint was worth a visit | FINISHED |
| RETURNING | the way back stays refused, and the robot does not move | FAILED |

A viewpoint is given up if it is refused, or if the robot does not move `STALLED_M` or turn `STALLED_RAD` in
`STALLED_NS`; the way back only if both hold.

A goal of a user pauses the exploration until `PAUSE_NS` after that goal was reached or refused. Cancelling a goal ends
the exploration.

While the robot is not localised in the map, no viewpoint is chosen and a goal is kept: the controller first localises
the robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from common.geometry import se2
from common.messages.definitions import Exploration, Goal, Pose, Status
from services.controller.goal_state import Phase
from services.controller.policies.exploration import ExplorationState, NoPath
from services.controller.policies.recovery import MAX_GAP_NS

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.controller.goal_state import GoalState
    from services.controller.growing_map import AnchoredPose, PlanningMap
    from services.controller.policies.exploration import FieldOfView, Viewpoint

PAUSE_NS = 2_000_000_000  # how long the robot stands at a goal of a user before it goes on exploring
STALLED_NS = 8_000_000_000  # after this time without a motion of `STALLED_M` or a turn, the goal counts as unreachable
STALLED_M, STALLED_RAD = 0.2, 0.5
VIEWPOINT_TOLERANCE_M = 0.1
MAX_SPEED_FACTOR = 1.5  # a belief that moves faster than the robot can, by this factor, has jumped with the map
RETURN_TOLERANCE_M = 0.01  # of the goal at the start, so that the robot stands within 2 cm of it
AT_START_M = 0.1  # if no path can be planned this close to the start, returning does not help: the exploration fails


class Explorer:
    """One exploration: chooses the robot's goals."""

    def __init__(self, seq: int, pose: Array, planned: PlanningMap) -> None:
        """Begins at a pose (3,) in a map; ``seq`` is the number of the request."""
        self.seq, self.map = seq, planned
        self.phase: Literal["exploring", "returning", "finished", "failed"] = "exploring"
        self.goal: Goal | None = None  # of the exploration, not of a user
        self.paused = False  # whether a goal of a user takes precedence
        self.viewpoint_due = True  # whether a viewpoint has to be chosen; cleared by the caller that chooses it
        self.path_m = 0.0
        self._failure = ""  # why the exploration has failed
        self._can_plan = True  # whether a path could be planned at the last choice of a viewpoint
        self._pose, self.tracking = pose, True  # the pose is in the map only while the belief is in that state
        self._home = planned.anchor(pose)
        self._arrivals: list[AnchoredPose] = []  # where the robot arrived at viewpoints
        self._unreachable: list[AnchoredPose] = []  # viewpoints that were given up
        self._user_goal_over_since_ns: int | None = None
        self._last_moved = pose, 0  # pose and stamp in ns; the stamp is 0 before the first step towards a goal
        self._last_update_ns = 0  # stamp of the last step towards a goal
        self._last_belief_ns = 0
        self._map_jumped = False  # since the goal was chosen, so that it may now be at another place

    @property
    def active(self) -> bool:
        """Whether the exploration goes on: the robot still has to explore, or to return."""
        return self.phase in {"exploring", "returning"}

    @property
    def sets_goals(self) -> bool:
        """Whether the robot's goals are those of the exploration."""
        return self.active and not self.paused

    @property
    def home(self) -> Array | None:
        """Where exploration began, (3,) in the present map; None while that is not connected to it."""
        return next(iter(self.map.locate([self._home])), None)

    def use_map(self, planned: PlanningMap) -> bool:
        """Uses a new version of the map, in which another viewpoint may be better.

        The exploration fails if it is another map, because the start is not known there. Returns whether that happened.
        """
        is_another = self.active and planned.mapping_restarted_since(self.map)
        if is_another:
            self._fail("mapping has started again: explore again")
        self._map_jumped |= planned.jumped_from(self.map)
        self.map, self.viewpoint_due = planned, self.sets_goals
        return is_another

    def pause(self) -> None:
        """Pauses the exploration, because a user has set a goal."""
        self.goal, self.paused, self._user_goal_over_since_ns = None, True, None

    def update_pose(self, pose: Array, stamp_ns: int, max_speed: float, *, tracking: bool) -> None:
        """Updates the robot's pose (3,), which is in the map only if the belief is in state `tracking`.

        The robot drives at most at ``max_speed`` m/s.
        """
        step, period_s = float(np.hypot(*(pose - self._pose)[:2])), (stamp_ns - self._last_belief_ns) * 1e-9
        if step <= MAX_SPEED_FACTOR * max_speed * period_s:
            self.path_m += step
        self._pose, self._last_belief_ns, self.tracking = pose, stamp_ns, tracking

    def exploration_state(self, field_of_view: FieldOfView, goal_count: int) -> ExplorationState:
        """The input for the choice of the next viewpoint, after ``goal_count`` goals of users."""
        target = None
        if self.goal is not None and self.phase == "exploring":
            target = self.goal.pose.array()[:2]
        poses, home = self.map.message.poses, self.home
        end = (self._pose if home is None else home)[:2]
        arrivals, unreachable = self.map.locate(self._arrivals), self.map.locate(self._unreachable)[:, :2]
        return ExplorationState(
            self.map.graph, poses, arrivals, field_of_view, self._pose, end, target, unreachable, goal_count
        )

    def update(self, state: GoalState, stamp_ns: int) -> None:
        """Processes the state of the robot's goal after a scan."""
        if not self.active:
            return
        if self.paused:
            self.viewpoint_due |= self._resume_after_user_goal(state, stamp_ns)
        elif not self.tracking:
            self._last_moved = self._pose, 0  # the policy drives to localise
        elif self.goal is not None:
            self._record_motion(stamp_ns)
            stalled = stamp_ns - self._last_moved[1] > STALLED_NS
            if self.phase == "returning":
                self.viewpoint_due |= self._update_return(state, stalled=stalled)
            else:
                self.viewpoint_due |= self._update_viewpoint(self.goal, state, stalled=stalled)

    def _resume_after_user_goal(self, state: GoalState, stamp_ns: int) -> bool:
        """Ends the pause if the goal of a user has been over for `PAUSE_NS`; returns whether it did."""
        if state.active:
            self._user_goal_over_since_ns = None
        elif self._user_goal_over_since_ns is None or stamp_ns < self._user_goal_over_since_ns:
            self._user_goal_over_since_ns = stamp_ns
        elif stamp_ns - self._user_goal_over_since_ns >= PAUSE_NS:
            self.paused, self._last_moved = False, (self._pose, 0)
        return not self.paused

    def _record_motion(self, stamp_ns: int) -> None:
        """Stores when the robot last moved or turned, or was last driven by hand or without a belief."""
        place, since_ns = self._last_moved
        gap = not 0 <= stamp_ns - self._last_update_ns <= MAX_GAP_NS
        self._last_update_ns = stamp_ns
        motion = se2.between(place, self._pose)
        if np.hypot(*motion[:2]) > STALLED_M or abs(motion[2]) > STALLED_RAD or since_ns == 0 or gap:
            self._last_moved = self._pose, stamp_ns

    def _update_return(self, state: GoalState, *, stalled: bool) -> bool:
        """Ends the exploration if the robot is back, or cannot get back; returns whether it must try again."""
        if state.active:
            return False
        if state.phase is Phase.REACHED:
            if self._can_plan:
                self.phase = "finished"
        elif stalled:
            self._fail(f"cannot return to the start: {state.reason}")
        # A refused return is tried again, because the next attempt may find another path. After a return without a
        # plan, a viewpoint is chosen again, because there may be more room at the start.
        return self.active

    def _fail(self, reason: str) -> None:
        self.phase, self._failure = "failed", reason

    def _update_viewpoint(self, goal: Goal, state: GoalState, *, stalled: bool) -> bool:
        """Stores that the viewpoint was reached, or is given up; returns whether a viewpoint has to be chosen."""
        if state.active and not stalled:
            return False
        if state.phase is Phase.REACHED:
            self._arrivals.append(self.map.anchor(self._pose))
        elif not self._map_jumped:
            self._unreachable.append(self.map.anchor(goal.pose.array()))
        self.goal, self._last_moved = None, (self._pose, 0)
        return True

    def next_goal(
        self, viewpoint: Viewpoint | NoPath | None, half_field_of_view: float, *, under_way: bool
    ) -> Goal | None:
        """The goal for the result of `choose_viewpoint`: the viewpoint, or the way back if there is none.

        Returns None if the present goal is kept, or the exploration has failed. The scanner sees ``half_field_of_view``
        rad to either side. ``under_way``: the robot drives to the last goal.
        """
        self._can_plan = not isinstance(viewpoint, NoPath)
        home = self.home
        if isinstance(viewpoint, NoPath):
            if home is None or np.hypot(*(self._pose - home)[:2]) <= AT_START_M:
                self._fail(viewpoint.reason)
                return None
            viewpoint = None  # after the way back, there may be more room
        phase: Literal["exploring", "returning"] = "returning" if viewpoint is None else "exploring"
        pose = home if viewpoint is None else viewpoint.pose
        if pose is None:
            self._fail("cannot return to the start: nothing connects it to the present map")
            return None
        goal = Goal(stamp_ns=0, seq=self.seq, pose=Pose.of(pose), tolerance=RETURN_TOLERANCE_M)
        if viewpoint is not None:
            yaw_tolerance = None if half_field_of_view >= np.pi else half_field_of_view / 2
            goal = goal.model_copy(update={"tolerance": VIEWPOINT_TOLERANCE_M, "yaw_tolerance": yaw_tolerance})
        self._map_jumped = False
        # A goal within its tolerance of the present one does not replace it.
        same = self.goal is not None and np.hypot(*(self.goal.pose.array() - pose)[:2]) <= goal.tolerance
        if same and phase == self.phase and under_way:
            return None
        self.phase, self.goal = phase, goal
        return goal

    def add_progress(self, status: Status) -> Status:
        """The controller's status with the progress of the exploration."""
        progress = Exploration(phase=self.phase, seq=self.seq, area=self.map.free_area_m2, path=self.path_m)
        status = status.model_copy(update={"exploration": progress})
        if self.phase == "failed" and status.state not in {"lost", "manual"}:
            return status.model_copy(update={"state": "blocked", "reason": self._failure, "refused": True})
        if not self.sets_goals or status.state in {"lost", "manual"}:
            return status
        if not self.tracking:
            if status.state in {"idle", "reached"} or status.refused:
                reason = "the robot is not localised in the map"
                return status.model_copy(update={"state": "lost", "reason": reason, "refused": False})
            return status
        if status.state == "blocked" and not status.refused:
            return status
        reason = "returning to the start" if self.phase == "returning" else "driving to a viewpoint"
        return status.model_copy(update={"state": "exploring", "reason": reason, "refused": False})
