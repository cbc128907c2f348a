"""Preset `manual`: the robot is only driven by hand, and refuses goals."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.controller.policies.decision import Decision

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan


class ManualPolicy:
    """Never moves by itself, as while mapping, when there is no map yet."""

    def refusal(self, goal: Array) -> str | None:  # noqa: ARG002
        """Refuses every goal."""
        return "the robot is only driven by hand (preset manual), as there is no map"

    def set_goal(self, goal: Array | None) -> None:
        """Do nothing."""

    def interrupt(self) -> None:
        """Do nothing."""

    def resume(self) -> None:
        """Do nothing."""

    def prepare(self, scan: Scan) -> None:
        """Do nothing."""

    def observe(self, scan: Scan, belief: Belief) -> None:
        """Do nothing."""

    def decide(self, belief: Belief, velocity: Array) -> Decision:  # noqa: ARG002
        """Stand."""
        return Decision()

    def decide_unlocalised(self, belief: Belief, velocity: Array) -> Decision:  # noqa: ARG002
        """Stand."""
        return Decision()
