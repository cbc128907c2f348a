"""Preset `paper`: the goal attracts in a straight line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from services.controller.policies.decision import Decision, State
from services.controller.policies.paper_action import Preference, next_action, observed_position, preferred_position

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from common.messages.definitions import Belief, Scan
    from common.robot.base import Robot


class Straight:
    """The paper's controller; see `action`."""

    def __init__(self, robot: Robot, preference: Preference, world: World | None) -> None:
        """``world`` is to refuse a goal inside a wall; None: any goal is tried."""
        self.robot, self.preference, self.world = robot, preference, world
        self._goal: Array | None = None
        self._action = np.zeros(2)
        self._kept = np.zeros(2)

    def refusal(self, goal: Array) -> str | None:
        """Inside something, or too near to it."""
        if self.world is None:
            return None
        clearance = float(self.world.clearance(goal)[0])
        if clearance >= self.robot.radius:
            return None
        where = f"({goal[0]:.2f}, {goal[1]:.2f}) in {self.world.name}"
        what = "inside something, or off the map" if clearance < 0 else f"{clearance:.2f} m from a wall"
        return f"goal refused: {where} is {what}"

    def aim(self, goal: Array | None) -> None:
        """The sum of equation 4 begins at 0."""
        self._goal, self._action = goal, np.zeros(2)

    def interrupt(self) -> None:
        """The sum of equation 4 begins at 0 again, unless `go_on` follows."""
        self._kept, self._action = self._action, np.zeros(2)

    def go_on(self) -> None:
        """As before the last interruption."""
        self._action = self._kept

    def see(self, scan: Scan, belief: Belief) -> None:
        """Nothing: the belief says all."""

    def decide(self, belief: Belief, velocity: Array) -> Decision:  # noqa: ARG002 - the sum knows
        """One step of equation 4."""
        if self._goal is None:
            return Decision()
        pose = belief.pose.array()
        observed = observed_position(pose, belief.xi.astype(np.float64), belief.curvature)
        preferred = preferred_position(observed, self._goal, self.preference.reach)
        self._action = next_action(self._action, observed, preferred, float(pose[2]), self.preference)
        return Decision(np.array([self._action[0], self._action[1], 0.0]))

    def seek(self, belief: Belief, velocity: Array) -> Decision:  # noqa: ARG002
        """Stand."""
        self._action = np.zeros(2)
        state: State = "lost" if belief.state == "lost" else "navigating"
        return Decision(reason=f"standing until localised: the belief is {belief.state}", state=state)
