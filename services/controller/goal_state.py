"""The state of the current goal: every phase, and every transition.

| from | event | to |
|---|---|---|
| any | `start` | NAVIGATING, or REFUSED if there is a reason to refuse the goal |
| any | `cancel` | IDLE |
| NAVIGATING, BLOCKED, UNLOCALISED | `lose_pose`, `lose_belief` | UNLOCALISED |
| UNLOCALISED | `find_pose` | NAVIGATING |
| NAVIGATING, BLOCKED | `update_progress`: recovers, or has stood before an obstacle for 2 s | BLOCKED |
| BLOCKED | `update_progress`: moves, or nothing is in the way | NAVIGATING |
| NAVIGATING, BLOCKED | `reach` | REACHED |
| NAVIGATING, BLOCKED | `refuse` | REFUSED |
| NAVIGATING, BLOCKED, UNLOCALISED | `suspend` | NAVIGATING |
| REACHED | `suspend` | IDLE |
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING, Literal

from common.messages.definitions import Goal, Status

if TYPE_CHECKING:
    from services.controller.policies.decision import Decision

BLOCKED_AFTER_S = 2.0  # time without motion before an obstacle after which the phase becomes BLOCKED

Shown = Literal["idle", "navigating", "reached", "blocked", "lost", "exploring"]


class Phase(Enum):
    """Phase of the current goal."""

    IDLE = auto()  # there is no goal
    NAVIGATING = auto()  # the robot drives to the goal
    BLOCKED = auto()  # an obstacle is in the way, which may go away
    UNLOCALISED = auto()  # the belief cannot be used for navigation, or no beliefs arrive
    REACHED = auto()  # the robot stands at the goal
    REFUSED = auto()  # the goal cannot be reached: it is inside a wall, or in another room


SHOWN: dict[Phase, Shown] = {
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
        self._activity: Shown = "lost"  # shown while UNLOCALISED
        self._enter(Phase.IDLE)

    def _enter(self, phase: Phase, reason: str = "") -> None:
        self.phase, self.reason = phase, reason
        self._standing_since_ns: int | None = None  # before an obstacle; None while the robot makes progress

    @property
    def active(self) -> bool:
        """Whether there is a goal that is neither reached nor refused."""
        return self.phase in {Phase.NAVIGATING, Phase.BLOCKED, Phase.UNLOCALISED}

    def start(self, goal: Goal, refusal: str | None) -> None:
        """Replace the goal. If ``refusal`` is not None, it is the reason to refuse the new one."""
        self.goal = goal
        self._enter(Phase.NAVIGATING if refusal is None else Phase.REFUSED, refusal or "")

    def cancel(self) -> None:
        """Forget the goal."""
        self.goal = None
        self._enter(Phase.IDLE, "cancelled")

    def refuse(self, reason: str) -> None:
        """Refuse the goal, because it has turned out to be unreachable."""
        self._enter(Phase.REFUSED, reason)

    def reach(self, reason: str) -> None:
        """The robot has arrived."""
        self._enter(Phase.REACHED, reason)

    def lose_pose(self, activity: Shown, reason: str) -> None:
        """The belief cannot be used for navigation; ``activity`` is what the robot does meanwhile."""
        if self.active:
            self._activity = activity
            self._enter(Phase.UNLOCALISED, reason)

    def lose_belief(self, reason: str) -> None:
        """Beliefs no longer arrive."""
        self.lose_pose("lost", reason)

    def find_pose(self) -> None:
        """The belief can be used for navigation."""
        if self.phase is Phase.UNLOCALISED:
            self._enter(Phase.NAVIGATING)

    def suspend(self) -> None:
        """The robot is driven by hand. The goal is kept for afterwards, unless it was reached."""
        if self.active:
            self._enter(Phase.NAVIGATING)
        elif self.phase is not Phase.REFUSED:
            self.goal = None
            self._enter(Phase.IDLE)

    def update_progress(self, stamp_ns: int, decision: Decision, *, moving: bool, limited_by_scan: bool) -> None:
        """The policy decided on a velocity; ``limited_by_scan``: obstacles in the scan reduced it."""
        if self.phase not in {Phase.NAVIGATING, Phase.BLOCKED}:
            return
        self.reason = decision.reason or ("slowed by the scan" if limited_by_scan else "")
        if decision.recovering:
            self.phase = Phase.BLOCKED
        elif moving or not (limited_by_scan or decision.state == "blocked"):
            self.phase, self._standing_since_ns = Phase.NAVIGATING, None
        else:
            if self._standing_since_ns is None:
                self._standing_since_ns = stamp_ns
            if (stamp_ns - self._standing_since_ns) * 1e-9 >= BLOCKED_AFTER_S:
                self.phase, self.reason = Phase.BLOCKED, decision.reason or "the scan shows something in the way"

    def status(self, stamp_ns: int, distance: float | None) -> Status:
        """The published status; ``distance`` to the goal in m."""
        return Status(
            stamp_ns=stamp_ns,
            state=SHOWN.get(self.phase, self._activity),
            reason=self.reason,
            refused=self.phase is Phase.REFUSED,
            goal=self.goal.pose if self.goal is not None else None,
            goal_seq=self.goal.seq if self.goal is not None else 0,
            distance=distance,
        )
