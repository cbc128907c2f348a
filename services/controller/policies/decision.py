"""The result of a policy: a command and its reasons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan


State = Literal["navigating", "blocked", "lost", "exploring"]


def _none() -> Array:
    return np.zeros((0, 2))


@dataclass
class Decision:
    """What to do now, before any limit, and why."""

    action: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m/s, m/s, rad/s in base_link
    reason: str = ""  # empty: nothing is in the way
    state: State = "navigating"
    path: Array = field(default_factory=_none)  # (K, 2) m in map
    motion: Array = field(default_factory=_none)  # (T, 2) m in map
    recovering: bool = False  # it moves to get free, not on
    refused: bool = False  # the goal cannot be, as is known by now


class Preset(Protocol):
    """How a goal becomes actions."""

    def refusal(self, goal: Array) -> str | None:
        """Why a goal (2,) m in map cannot be; None: it can, as far as is known. What shows later, `decide` says."""

    def aim(self, goal: Array | None) -> None:
        """Prefer a place (2,) m in map; None: none. What was under way is forgotten."""

    def interrupt(self) -> None:
        """The robot stands, or somebody else drives it: nothing is under way."""

    def go_on(self) -> None:
        """As before the last interruption: no time has passed."""

    def see(self, scan: Scan, belief: Belief) -> None:
        """The scan that a belief is about."""

    def decide(self, belief: Belief, velocity: Array) -> Decision:
        """On the way to the goal, with a belief that knows where it is; ``velocity`` (3,) is the last command."""

    def seek(self, belief: Belief, velocity: Array) -> Decision:
        """With a belief that does not."""
