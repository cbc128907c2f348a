"""Interface of a policy, and the decision that it returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan


DecisionState = Literal["navigating", "blocked", "lost", "exploring"]  # the states of Status that a policy may set


def _no_points() -> Array:
    return np.zeros((0, 2))


@dataclass
class Decision:
    """The velocity chosen for one belief, before any limit, with what `Status` shows about it."""

    action: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m/s, m/s, rad/s in base_link
    reason: str = ""  # shown in Status; empty if nothing hinders the robot
    state: DecisionState = "navigating"
    path: Array = field(default_factory=_no_points)  # (K, 2) m in map, to the goal or destination
    motion: Array = field(default_factory=_no_points)  # (T, 2) m in map, predicted for the action until standstill
    recovering: bool = False  # a recovery motion, which does not lead to the goal
    refused: bool = False  # the goal turned out to be unreachable
    terms: dict[str, float] | None = None  # of the expected free energy, as in the message PolicyEnergy


class Policy(Protocol):
    """Turns a goal and beliefs into velocities. The setting `preset` selects one."""

    def refusal(self, goal: Array) -> str | None:
        """The reason why a goal (2,) m in map cannot be reached, or None if nothing is known to prevent it.

        What becomes known only on the way is reported by `decide`, as `Decision.refused`.
        """

    def set_goal(self, goal: Array | None) -> None:
        """Starts towards a goal (2,) m in map, or none. Forgets everything about the previous goal."""

    def interrupt(self) -> None:
        """Discards the current manoeuvre: the robot stopped, or is driven by hand."""

    def resume(self) -> None:
        """Undoes the last `interrupt`: the simulation was only paused, no simulated time has passed."""

    def prepare(self, scan: Scan) -> None:
        """Computes what depends on the scanner; called with each scan, before its belief."""

    def observe(self, scan: Scan | None, belief: Belief) -> None:
        """Processes a belief and the scan from which it was computed; None if that has not come, or is too old."""

    def decide(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:
        """Chooses a velocity towards the goal when the pose is known.

        ``velocity`` (3,) is the latest command. ``motion_until_effect`` (3,) is the motion from the belief's pose until
        the chosen velocity takes effect. Both are in base_link.
        """

    def decide_unlocalised(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:
        """Chooses a velocity when the belief is lost, localising or ambiguous; arguments as for `decide`."""
