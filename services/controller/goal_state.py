"""The state of the current goal: every phase, and every transition.

| from | event | to |
|---|---|---|
| any | `start` | NAVIGATING, or REFUSED if there is a reason to refuse the goal |
| any | `cancel` | IDLE |
| NAVIGATING, BLOCKED, UNLOCALISED | `lose_pose`, `lose_belief` | UNLOCALISED |
| UNLOCALISED | `find_pose` | NAVIGATING |
| NAVIGATING, BLOCKED | `update_progress`: the robot backs off, or has stood before an obstacle for 2 s | BLOCKED |
| BLOCKED | `update_progress`: the robot has moved, or nothing is in the way | NAVIGATING |
| NAVIGATING, BLOCKED | `reach` | REACHED |
| NAVIGATING, BLOCKED, UNLOCALISED | `refuse` | REFUSED |
| NAVIGATING, BLOCKED, UNLOCALISED | `suspend` | NAVIGATING |
| REACHED | `suspend` | IDLE |
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING, Literal

import numpy as np

from common.geometry import se2
from common.messages.definitions import Goal, Status

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.controller.policies.decision import Decision

BLOCKED_AFTER_S = 2.0  # time without motion before an obstacle after which the phase becomes BLOCKED
# A smaller motion counts as standing: before an obstacle, the robot moves by millimetres with the noise of the scan.
MIN_MOTION_M, MIN_MOTION_RAD = 0.02, 0.05

StatusState = Literal["idle", "navigating", "reached", "blocked", "lost", "exploring"]  # of the message Status


class Phase(Enum):
    """Phase of the current goal."""

    IDLE = auto()  # there is no goal
    NAVIGATING = auto()  # the robot drives to the goal
    BLOCKED = auto()  # an obstacle is in the way, which may go away
    UNLOCALISED = auto()  # the belief cannot be used for navigation, or no beliefs arrive
    REACHED = auto()  # the robot stands at the goal
    REFUSED = auto()  # the goal cannot be reached: it is inside a wall, or in another room


STATUS_OF_PHASE: dict[Phase, StatusState] = {  # while UNLOCALISED, it depends on what the robot does
    Phase.IDLE: "idle",
    Phase.NAVIGATING: "navigating",
    Phase.BLOCKED: "blocked",
    Phase.REACHED: "reached",
    Phase.REFUSED: "blocked",
}


class GoalState:
    """The goal and its phase. Each method is an event of the table above."""

    def __init__(self) -> None:
        self.goal: Goal | None = None
        self._activity: StatusState = "lost"  # the published state while UNLOCALISED
        self._enter(Phase.IDLE)

    def _enter(self, phase: Phase, reason: str = "") -> None:
        self.phase, self.reason = phase, reason
        # Since when, in ns, and at which pose (3,) the robot has stood before an obstacle; None if there is none.
        self._standing_since: tuple[int, Array] | None = None

    @property
    def active(self) -> bool:
        """Whether there is a goal that is neither reached nor refused."""
        return self.phase in {Phase.NAVIGATING, Phase.BLOCKED, Phase.UNLOCALISED}

    def start(self, goal: Goal, refusal: str | None) -> None:
        """Replaces the goal, and refuses the new one if ``refusal`` gives a reason."""
        self.goal = goal
        self._enter(Phase.NAVIGATING)
        if refusal is not None:
            self.refuse(refusal)

    def cancel(self) -> None:
        """Forgets the goal."""
        self.goal = None
        self._enter(Phase.IDLE, "cancelled")

    def refuse(self, reason: str) -> None:
        """Refuses the goal, which cannot be reached for this reason."""
        self._enter(Phase.REFUSED, f"goal refused: {reason}")

    def reach(self, reason: str) -> None:
        """Ends the goal: the robot has arrived."""
        self._enter(Phase.REACHED, reason)

    def lose_pose(self, activity: StatusState, reason: str) -> None:
        """Notes that the belief cannot be used for navigation; ``activity`` is what the robot does meanwhile."""
        if self.active:
            self._activity = activity
            self._enter(Phase.UNLOCALISED, reason)

    def lose_belief(self, reason: str) -> None:
        """Notes that beliefs no longer arrive."""
        self.lose_pose("lost", reason)

    def find_pose(self) -> None:
        """Notes that the belief can be used for navigation."""
        if self.phase is Phase.UNLOCALISED:
            self._enter(Phase.NAVIGATING)

    def suspend(self) -> None:
        """Interrupts the goal while the robot is driven by hand; forgets it if it was reached."""
        if self.active:
            self._enter(Phase.NAVIGATING)
        elif self.phase is not Phase.REFUSED:
            self.goal = None
            self._enter(Phase.IDLE)

    def update_progress(
        self, stamp_ns: int, pose: Array, decision: Decision, *, moving: bool, limited_by_scan: bool
    ) -> None:
        """Processes a decision of the policy at a pose (3,).

        ``moving``: the command moves the robot. ``limited_by_scan``: obstacles in the scan reduced its velocity.
        """
        if self.phase not in {Phase.NAVIGATING, Phase.BLOCKED}:
            return
        self.reason = decision.reason or ("slowed for an obstacle in the scan" if limited_by_scan else "")
        if decision.recovering:
            self.phase = Phase.BLOCKED
        elif not (limited_by_scan or decision.state == "blocked"):
            self.phase, self._standing_since = Phase.NAVIGATING, None
        elif self._standing_since is None or (moving and _has_moved(self._standing_since[1], pose)):
            self.phase, self._standing_since = Phase.NAVIGATING, (stamp_ns, pose)
        elif (stamp_ns - self._standing_since[0]) * 1e-9 >= BLOCKED_AFTER_S:
            self.phase, self.reason = Phase.BLOCKED, decision.reason or "an obstacle in the scan is in the way"

    def status(self, stamp_ns: int, distance: float | None) -> Status:
        """The status to publish, with the ``distance`` m to the goal if it is known."""
        return Status(
            stamp_ns=stamp_ns,
            state=STATUS_OF_PHASE.get(self.phase, self._activity),
            reason=self.reason,
            refused=self.phase is Phase.REFUSED,
            goal=self.goal.pose if self.goal is not None else None,
            goal_seq=self.goal.seq if self.goal is not None else 0,
            distance=distance,
        )


def _has_moved(before: Array, now: Array) -> bool:
    x, y, turn = se2.difference(now, before)
    return bool(np.hypot(x, y) > MIN_MOTION_M or abs(turn) > MIN_MOTION_RAD)
