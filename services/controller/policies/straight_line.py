"""Preset `paper`: drives straight to the goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from services.controller.policies.decision import Decision, DecisionState
from services.controller.policies.paper_action import (
    ActionParameters,
    next_action,
    observed_position,
    preferred_position,
)

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from common.messages.definitions import Belief, Scan
    from common.robot.robot import Robot


class StraightLinePolicy:
    """The paper's controller: accumulates steps of equation 4 (see `paper_action`). Needs no map."""

    def __init__(self, robot: Robot, parameters: ActionParameters, world: World | None) -> None:
        """``world`` is used only to refuse goals inside walls; without it any goal is accepted."""
        self.robot, self.parameters, self.world = robot, parameters, world
        self._goal: Array | None = None
        self._action = np.zeros(2)  # m/s in base_link, the sum of equation 4
        self._action_before_interrupt = np.zeros(2)

    def refusal(self, goal: Array) -> str | None:
        """The reason why a goal (2,) m in map cannot be reached: a wall within the robot's radius. None if it can."""
        return None if self.world is None else self.world.placement_error(goal, self.robot.radius)

    def set_goal(self, goal: Array | None) -> None:
        """Sets the goal (2,) m in map, and the sum of equation 4 to zero."""
        self._goal, self._action = goal, np.zeros(2)

    def interrupt(self) -> None:
        """Sets the sum of equation 4 to zero; `resume` restores it."""
        self._action_before_interrupt, self._action = self._action, np.zeros(2)

    def resume(self) -> None:
        """Restores the sum of equation 4 from before the last `interrupt`."""
        self._action = self._action_before_interrupt

    def prepare(self, scan: Scan) -> None:
        """Does nothing: this policy uses the belief alone."""

    def observe(self, scan: Scan | None, belief: Belief) -> None:
        """Does nothing: this policy uses the belief alone."""

    def decide(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:  # noqa: ARG002
        """Adds one step of equation 4; its sum replaces the latest command."""
        if self._goal is None:
            return Decision()
        pose = belief.pose.array()
        observed = observed_position(pose, belief.xi, belief.curvature)
        preferred = preferred_position(observed, self._goal, self.parameters.reach)
        self._action = next_action(self._action, observed, preferred, float(pose[2]), self.parameters)
        return Decision(np.array([self._action[0], self._action[1], 0.0]))

    def decide_unlocalised(self, belief: Belief, velocity: Array, motion_until_effect: Array) -> Decision:  # noqa: ARG002
        """Stands until the pose is known."""
        self._action = np.zeros(2)
        state: DecisionState = "lost" if belief.state == "lost" else "navigating"
        return Decision(reason=f"standing until localised: the belief is {belief.state}", state=state)
