"""Turns beliefs into commands: handles the goal and manual driving, calls the policy, and applies the limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Scan, Status
from common.robot.base import Robot
from common.runtime import safety
from services.controller.goal_state import GoalState
from services.controller.manual_drive import ManualDrive
from services.controller.policies.decision import Decision, Policy
from services.controller.policies.motion_model import is_moving, turn_rate
from services.controller.policies.paper_action import ActionParameters
from services.controller.policies.straight_line import StraightLinePolicy
from services.controller.velocity_command import VelocityCommand

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World


@dataclass
class Navigator:
    """Turns beliefs into commands and statuses. A policy chooses the velocity. Uses stamps only, never a clock."""

    robot: Robot = field(default_factory=Robot)
    parameters: ActionParameters = field(default_factory=ActionParameters)  # of preset `paper`
    world: World | None = None  # lets preset `paper` refuse goals inside walls; without it any goal is accepted
    preset: Policy | None = None  # the policy; defaults to preset `paper`

    def __post_init__(self) -> None:
        self.policy: Policy = self.preset or StraightLinePolicy(self.robot, self.parameters, self.world)
        self.decision = Decision()  # what the policy decided on the latest belief
        self.goal_state = GoalState()
        self._command = VelocityCommand(self.robot)
        self._manual = ManualDrive()
        self._scan: Scan | None = None
        self._scan_points = np.zeros((0, 2))  # m in base_link

    def on_scan(self, scan: Scan) -> None:
        """Keep the scan for the obstacle limits and for the policy."""
        self._scan_points, self._scan = safety.scan_points(scan), scan

    def on_drive(self, drive: Drive) -> None:
        """Store a manual velocity command, which has priority over the goal."""
        self._manual.update(drive, max(self.scan_stamp or 0, self._command.stamp_ns or 0))

    def on_goal(self, goal: Goal) -> None:
        """Replace the goal, cancel it, or refuse it if the policy knows that it cannot be reached."""
        position = goal.pose.array()[:2]
        if goal.cancel:
            self.goal_state.cancel()
        else:
            self.goal_state.start(goal, self.policy.refusal(position))
        self.policy.set_goal(position if self.goal_state.active else None)

    @property
    def scan_stamp(self) -> int | None:
        """Stamp of the latest scan in ns; None before the first scan."""
        return None if self._scan is None else self._scan.stamp_ns

    def step(self, belief: Belief) -> tuple[CmdVel, Status]:
        """Command and status that answer a belief, both with its stamp."""
        pose, manual_twist = belief.pose.array(), self._manual.twist(belief.stamp_ns)
        self._resume_after_pause(belief.stamp_ns)
        self.decision = Decision()
        if self._scan is not None and self._scan.stamp_ns == belief.stamp_ns:
            self.policy.observe(self._scan, belief)
        if manual_twist is not None:
            self._suspend_goal()
        goal = self.goal_state.goal
        distance = None if goal is None else float(np.hypot(*(goal.pose.array() - pose)[:2]))
        if manual_twist is not None:
            command, _ = self._command.limit(belief.stamp_ns, manual_twist, self._scan_points)
            return command, self._manual_status(belief.stamp_ns, distance)
        desired = np.zeros(3)
        if goal is not None and distance is not None and self.goal_state.active:
            desired = self._goal_velocity(belief, pose, goal, distance)
        command, limited_by_scan = self._command.limit(belief.stamp_ns, desired, self._scan_points)
        moving = is_moving(self._command.velocity)
        self.goal_state.update_progress(belief.stamp_ns, self.decision, moving=moving, limited_by_scan=limited_by_scan)
        return command, self.goal_state.status(belief.stamp_ns, distance)

    def step_without_belief(self, stamp_ns: int) -> tuple[CmdVel, Status] | None:
        """Command and status that answer a scan while no estimator runs, so that manual driving still works.

        Returns None if the robot stands and is not driven by hand.
        """
        manual_twist = self._manual.twist(stamp_ns)
        if manual_twist is None and not self._command.velocity.any():
            return None
        self._resume_after_pause(stamp_ns)
        if manual_twist is not None:
            self._suspend_goal()
            command, _ = self._command.limit(stamp_ns, manual_twist, self._scan_points)
            return command, self._manual_status(stamp_ns, None)
        self.goal_state.lose_belief("no belief: is the estimator running?")
        command, _ = self._command.limit(stamp_ns, np.zeros(3), self._scan_points)
        return command, self.goal_state.status(stamp_ns, None)

    def stop_without_belief(self, stamp_ns: int, reason: str) -> tuple[CmdVel, Status]:
        """Zero command and its status, if no belief came in time. Keeps the goal, to resume it with the next belief."""
        # If every scan was answered, the simulation may be paused; otherwise the estimator is late.
        paused = self._scan is not None and self._scan.stamp_ns == self._command.stamp_ns
        command = self._command.stop(stamp_ns, paused=paused)
        self.policy.interrupt()
        self.goal_state.lose_belief(reason)
        status = self.goal_state.status(stamp_ns, None)
        if not status.refused:  # otherwise keep showing why the goal was refused
            status = status.model_copy(update={"reason": reason})
        return command, status

    def _resume_after_pause(self, stamp_ns: int) -> None:
        if self._command.resume(stamp_ns):
            self.policy.resume()

    def _suspend_goal(self) -> None:
        self.goal_state.suspend()
        self.policy.interrupt()

    def _manual_status(self, stamp_ns: int, distance: float | None) -> Status:
        """Status with state "manual"; the state of the goal is left as it is."""
        reason = "driven by hand; the goal waits" if self.goal_state.active else "driven by hand"
        status = self.goal_state.status(stamp_ns, distance)
        return status.model_copy(update={"state": "manual", "reason": reason})

    def _goal_velocity(self, belief: Belief, pose: Array, goal: Goal, distance: float) -> Array:
        """Velocity (3,) in base_link that the policy chooses, before any limit; updates the state of the goal."""
        if belief.state in {"lost", "localising", "ambiguous"}:
            self.decision = self.policy.decide_unlocalised(belief, self._command.velocity)
            self.goal_state.lose_pose(self.decision.state, self.decision.reason)
            return self.decision.action
        self.goal_state.find_pose()
        if distance <= goal.tolerance:
            self.policy.interrupt()
            turn = self._turn_to_goal_heading(pose, goal)
            if turn is None:
                self.goal_state.reach(f"within {goal.tolerance:g} m of the goal")
                return np.zeros(3)
            self.decision = Decision(turn, "there: turning into the goal's heading")
            return turn
        self.decision = self.policy.decide(belief, self._command.velocity)
        if self.decision.refused:
            self.goal_state.refuse(self.decision.reason)
        return self.decision.action

    def _turn_to_goal_heading(self, pose: Array, goal: Goal) -> Array | None:
        """Turn (3,) in base_link towards the goal's heading; None if the heading is within tolerance or free."""
        if goal.yaw_tolerance is None:
            return None
        error = float(se2.wrap(goal.pose.yaw - pose[2]))
        if abs(error) <= goal.yaw_tolerance:
            return None
        return np.array([0.0, 0.0, turn_rate(error, self.robot)])
