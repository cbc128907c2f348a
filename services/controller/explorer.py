"""Exploration of an unknown building: which goal comes next, until nothing is left to see and the robot is back.

| from | event | to |
|---|---|---|
| - | a goal with `explore` | EXPLORING |
| EXPLORING, RETURNING | a view is worth the way | EXPLORING |
| EXPLORING, RETURNING | no view is | RETURNING |
| RETURNING | the robot has arrived and stands | FINISHED |
| RETURNING | the way back stays refused | FAILED |

A view that is refused, or that the robot gets no nearer to for `STALLED_NS`, is given up.

A goal of a user pauses it until `PAUSE_NS` after that goal was reached, refused or cancelled.

While the robot does not know where it is in the map, it keeps its goal, and the controller looks for the place instead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from common.geometry import se2
from common.messages.definitions import Exploration, Goal, Pose, Status
from services.controller.goal_state import Phase

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.controller.goal_state import GoalState
    from services.controller.growing_map import PlannedMap
    from services.controller.policies.exploration import ScannerView, Survey, View

PAUSE_NS = 2_000_000_000  # for which the robot stands at a goal of a user
STALLED_NS = 8_000_000_000  # without a motion of STALLED_M after which a place counts as unreachable
STALLED_M = 0.2
VIEW_TOLERANCE_M = 0.1
HOME_TOLERANCE_M = 0.005
RETURNED_M = 0.02  # a robot that stopped late and stands farther away tries again
SAME_PLACE_M = 0.1  # a view this close to the present goal is the same


class Explorer:
    """One exploration: chooses the robot's goals."""

    def __init__(self, seq: int, pose: Array, planned: PlannedMap) -> None:
        """Begin at a pose (3,) in a map; ``seq`` is the number of the request."""
        self.seq, self.map = seq, planned
        self.phase: Literal["exploring", "returning", "finished", "failed"] = "exploring"
        self.goal: Goal | None = None  # its own goal
        self.paused = False  # the goal of a user takes precedence
        self.path_m = 0.0
        self._pose, self._located = pose, True
        # Relative to the last key scan, so that it moves with the map when a loop closes.
        self._home_key = len(planned.message.poses) - 1
        self._home = se2.between(planned.message.poses[self._home_key], pose)
        self._arrivals = np.zeros((0, 3))
        self._unreachable = np.zeros((0, 2))
        self._over_since_ns: int | None = None  # stamp since which the goal of a user is over
        self._progress = pose, 0  # where and when (ns) the robot last got on; 0 before it began

    @property
    def active(self) -> bool:
        """Whether there is something left to do."""
        return self.phase in {"exploring", "returning"}

    @property
    def drives(self) -> bool:
        """Whether the robot's goals are those of the exploration."""
        return self.active and not self.paused

    @property
    def home(self) -> Array:
        """Where exploration began, (3,) in the present map."""
        poses = self.map.message.poses
        return se2.compose(poses[min(self._home_key, len(poses) - 1)], self._home)

    def pause(self) -> None:
        """A user has set a goal, or cancelled it."""
        self.goal, self.paused, self._over_since_ns = None, True, None

    def move(self, pose: Array, *, located: bool) -> None:
        """The robot is at a pose (3,), in the map if it is ``located``, else in a frame of its own."""
        if located == self._located:
            self.path_m += float(np.hypot(*(pose - self._pose)[:2]))
        self._pose, self._located = pose, located

    def survey(self, view: ScannerView) -> Survey:
        """What the choice of the next view depends on."""
        from services.controller.policies.exploration import Survey  # compiles

        target = None
        if self.goal is not None and self.phase == "exploring":
            target = self.goal.pose.array()[:2]
        poses, home = self.map.message.poses, self.home[:2]
        return Survey(self.map.graph, poses, self._arrivals, view, self._pose, home, target, self._unreachable)

    def needs_goal(self, state: GoalState, stamp_ns: int, *, moving: bool) -> bool:
        """Whether the present goal has just ended, so that a view must be chosen; notes how it ended.

        ``moving`` is what the command says: a robot may stop late, beyond the goal that it has reached.
        """
        if not self.active or not (self.paused or self.goal is not None):
            return False
        if state.phase is Phase.UNLOCALISED:
            self._progress = self._pose, 0  # it gets on in another way
            return False
        if self.paused:
            return self._resumes(state, stamp_ns)
        assert self.goal is not None  # noqa: S101 - as it is not paused
        stalled = self._stalled(stamp_ns)
        if self.phase == "returning":
            return self._needs_way_back(state, stalled=stalled, moving=moving)
        if state.active and not stalled:
            return False
        if state.phase is Phase.REACHED:
            self._arrivals = np.concatenate([self._arrivals, self._pose[None]])
        else:
            self._unreachable = np.concatenate([self._unreachable, self.goal.pose.array()[None, :2]])
        self.goal, self._progress = None, (self._pose, 0)
        return True

    def _needs_way_back(self, state: GoalState, *, stalled: bool, moving: bool) -> bool:
        """Whether the robot stands elsewhere than where it began; if not, the exploration is over."""
        reached = state.phase is Phase.REACHED
        if state.active or (reached and moving):
            return False
        if stalled or (reached and np.hypot(*(self._pose - self.home)[:2]) <= RETURNED_M):
            self.phase = "finished" if reached else "failed"
        return self.active  # if refused: from a narrow place, the next choice may be another

    def _resumes(self, state: GoalState, stamp_ns: int) -> bool:
        """Whether the goal of a user has been over for long enough."""
        if state.active:
            self._over_since_ns = None
        elif self._over_since_ns is None or stamp_ns < self._over_since_ns:
            self._over_since_ns = stamp_ns
        elif stamp_ns - self._over_since_ns >= PAUSE_NS:
            self.paused, self._progress = False, (self._pose, 0)
        return not self.paused

    def _stalled(self, stamp_ns: int) -> bool:
        """Whether the robot has not got on for `STALLED_NS`."""
        place, since_ns = self._progress
        if np.hypot(*(self._pose - place)[:2]) > STALLED_M or not 0 < since_ns <= stamp_ns:
            self._progress = self._pose, stamp_ns
            return False
        return stamp_ns - since_ns > STALLED_NS

    def next_goal(self, view: View | None, half_view: float, *, under_way: bool) -> Goal | None:
        """The goal of a view that was chosen, or the way back if there is none; None if the goal stays the same.

        ``half_view`` rad is what the scanner sees to either side; ``under_way``: the robot drives to the last goal.
        """
        phase: Literal["exploring", "returning"] = "returning" if view is None else "exploring"
        pose = self.home if view is None else view.pose
        same = self.goal is not None and np.hypot(*(self.goal.pose.array() - pose)[:2]) <= SAME_PLACE_M
        if same and phase == self.phase and under_way:
            return None
        self.phase = phase
        goal = Goal(stamp_ns=0, seq=self.seq, pose=Pose.of(pose), tolerance=HOME_TOLERANCE_M)
        if view is not None:
            yaw_tolerance = None if half_view >= np.pi else half_view / 2
            goal = goal.model_copy(update={"tolerance": VIEW_TOLERANCE_M, "yaw_tolerance": yaw_tolerance})
        self.goal = goal
        return goal

    def explain(self, status: Status) -> Status:
        """The controller's status, with the progress of the exploration."""
        progress = Exploration(phase=self.phase, seq=self.seq, area=self.map.free_area_m2, path=self.path_m)
        status = status.model_copy(update={"exploration": progress})
        if not self.drives or not self._located or status.state in {"lost", "manual"}:
            return status
        if status.state == "blocked" and not status.refused:
            return status
        reason = "returning to the start" if self.phase == "returning" else "going where a scan tells most"
        return status.model_copy(update={"state": "exploring", "reason": reason, "refused": False})
