"""The goal, the limits and the status: from a belief to a command."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Scan, Status, Twist
from common.robot.base import Robot
from common.runtime import safety
from services.controller.manual_drive import ManualDrive
from services.controller.policies.decision import Decision, Policy
from services.controller.policies.motion_model import is_moving, turn_rate
from services.controller.policies.paper_action import ActionParameters
from services.controller.policies.straight_line import StraightLinePolicy

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

BLOCKED_AFTER_S = 2.0  # time without motion on the way to a goal after which the state becomes "blocked"


@dataclass
class Navigator:
    """Turns beliefs into commands and statuses.

    The navigator keeps the goal, the state shown in `Status`, manual driving and the limits. A policy chooses the
    velocity. Uses stamps only, never a clock.
    """

    robot: Robot = field(default_factory=Robot)
    parameters: ActionParameters = field(default_factory=ActionParameters)  # of preset `paper`
    world: World | None = None  # lets preset `paper` refuse goals inside walls; without it any goal is accepted
    preset: Policy | None = None  # defaults to preset `paper`

    def __post_init__(self) -> None:
        self.policy: Policy = self.preset or StraightLinePolicy(self.robot, self.parameters, self.world)
        self.decision = Decision()  # what the policy decided on the latest belief

        # State of the current goal. `state` and `reason` are what `Status` shows. Two flags qualify them:
        # - `_goal_refused`: the goal cannot be reached (inside a wall, or in another room). The robot stands, and
        #   `state` stays "blocked" until the next goal.
        # - `_pose_unknown`: the last belief could not be used for navigation, or none came. The first belief that is
        #   good enough sets `state` back to "navigating".
        self.goal: Goal | None = None
        self.state: Literal["idle", "navigating", "reached", "blocked", "lost", "exploring"] = "idle"
        self.reason = ""
        self._goal_refused = False
        self._pose_unknown = False
        self._standing_since_ns: int | None = None  # stands on the way to the goal; None while it makes progress

        # Inputs and outputs so far.
        self._scan: Scan | None = None
        self._scan_points = np.zeros((0, 2))  # m in base_link
        self._manual = ManualDrive()
        self._velocity = np.zeros(3)  # the latest command
        self._command_stamp_ns: int | None = None  # its stamp
        # The velocity before `stop_without_belief` set it to zero. None unless every scan had been answered by then,
        # which means that the simulation was paused rather than that the estimator is late.
        self._velocity_before_pause: Array | None = None

    def on_scan(self, scan: Scan) -> None:
        """Keep the scan for the obstacle limits and for the policy."""
        self._scan_points, self._scan = safety.scan_points(scan), scan

    def on_drive(self, drive: Drive) -> None:
        """Take a manual velocity command, which has priority over the goal."""
        scan_stamp_ns = self._scan.stamp_ns if self._scan is not None else 0
        self._manual.update(drive, max(scan_stamp_ns, self._command_stamp_ns or 0))

    def on_goal(self, goal: Goal) -> None:
        """Replace the goal, cancel it, or refuse it if the policy knows that it cannot be reached."""
        self._standing_since_ns = None
        self.goal, self.state, self.reason, self._goal_refused = goal, "navigating", "", False
        if goal.cancel:
            self.goal, self.state, self.reason = None, "idle", "cancelled"
        elif (refusal := self.policy.refusal(goal.pose.array()[:2])) is not None:
            self.state, self.reason, self._goal_refused = "blocked", refusal, True
        self.policy.set_goal(None if self.goal is None or self._goal_refused else goal.pose.array()[:2])

    @property
    def scan_stamp(self) -> int | None:
        """Stamp of the latest scan in ns. None before the first scan."""
        return None if self._scan is None else self._scan.stamp_ns

    @property
    def has_active_goal(self) -> bool:
        """Whether there is a goal that is neither refused nor reached."""
        return self.goal is not None and not self._goal_refused and self.state != "reached"

    def step(self, belief: Belief) -> tuple[CmdVel, Status]:
        """Command and status that answer a belief, both with its stamp."""
        pose, manual_twist = belief.pose.array(), self._manual.twist(belief.stamp_ns)
        self._resume_after_pause(belief.stamp_ns)
        self.decision = Decision()
        if self._scan is not None and self._scan.stamp_ns == belief.stamp_ns:
            self.policy.observe(self._scan, belief)
        if manual_twist is not None:
            self._suspend_goal()
        distance = None if self.goal is None else float(np.hypot(*(self.goal.pose.array() - pose)[:2]))
        desired = self._goal_velocity(belief, pose, distance) if manual_twist is None else manual_twist
        command, limited_by_scan = self._limit(belief.stamp_ns, desired)
        if manual_twist is not None:
            return command, self._manual_status(belief.stamp_ns, distance)
        self._update_progress(belief.stamp_ns, limited_by_scan=limited_by_scan)
        return command, self.status(belief.stamp_ns, distance)

    def step_without_belief(self, stamp_ns: int) -> tuple[CmdVel, Status] | None:
        """Command and status that answer a scan while no estimator runs, so that manual driving still works.

        Returns None if the robot stands and is not driven by hand.
        """
        manual_twist = self._manual.twist(stamp_ns)
        if manual_twist is None and not self._velocity.any():
            return None
        self._resume_after_pause(stamp_ns)
        if manual_twist is not None:
            self._suspend_goal()
            return self._limit(stamp_ns, manual_twist)[0], self._manual_status(stamp_ns, None)
        self._set_lost("no belief: is the estimator running?")
        return self._limit(stamp_ns, np.zeros(3))[0], self.status(stamp_ns, None)

    def _resume_after_pause(self, stamp_ns: int) -> None:
        """Restores velocity and policy from before a pause, if the stamps show that no simulated time was lost."""
        if self._velocity_before_pause is None:
            return
        max_gap_ns = self.robot.command_age * 1e9
        if self._command_stamp_ns is not None and 0 < stamp_ns - self._command_stamp_ns <= max_gap_ns:
            self._velocity = self._velocity_before_pause
            self.policy.resume()
        self._velocity_before_pause = None

    def _limit(self, stamp_ns: int, desired: Array) -> tuple[CmdVel, bool]:
        """Command for a desired velocity (3,) within every limit, and whether the scan reduced it."""
        previous_ns = self._command_stamp_ns
        period_s = 0.0 if previous_ns is None else max(0.0, (stamp_ns - previous_ns) * 1e-9)
        self._command_stamp_ns = stamp_ns
        ramped = safety.ramp(self._velocity, safety.clip_twist(desired, self.robot), self.robot, period_s)
        self._velocity, limited_by_scan = safety.limit_velocity(ramped, self._scan_points, self.robot)
        vx, vy, wz = map(float, self._velocity)
        return CmdVel(stamp_ns=stamp_ns, twist=Twist(vx=vx, vy=vy, wz=wz)), limited_by_scan

    def _suspend_goal(self) -> None:
        """Keeps the goal for after manual driving, unless it was reached already."""
        if self.state == "reached":
            self.goal = None
        if not self._goal_refused:
            self.state, self.reason = "idle" if self.goal is None else "navigating", ""
        self.policy.interrupt()
        self._standing_since_ns, self._pose_unknown = None, False

    def _manual_status(self, stamp_ns: int, distance: float | None) -> Status:
        """Status with state "manual"; `state` of the goal is left as it is."""
        reason = "driven by hand" + ("; the goal waits" if self.goal is not None and not self._goal_refused else "")
        return self.status(stamp_ns, distance).model_copy(update={"state": "manual", "reason": reason})

    def _goal_velocity(self, belief: Belief, pose: Array, distance: float | None) -> Array:
        """Velocity (3,) in base_link that the policy chooses, before any limit; updates the state of the goal."""
        if self.goal is None or distance is None or self._goal_refused or self.state == "reached":
            return np.zeros(3)
        if belief.state in {"lost", "localising", "ambiguous"}:
            self.decision, self._pose_unknown = self.policy.decide_unlocalised(belief, self._velocity), True
            self.state, self.reason = self.decision.state, self.decision.reason
            return self.decision.action
        if self._pose_unknown:
            self._pose_unknown, self.state, self.reason = False, "navigating", ""
        if distance <= self.goal.tolerance:
            self.policy.interrupt()
            turn = self._turn_to_goal_heading(pose)
            if turn is None:
                self.state, self.reason = "reached", f"within {self.goal.tolerance:g} m of the goal"
                return np.zeros(3)
            self.decision = Decision(turn, "there: turning into the goal's heading")
            return turn
        self.decision = self.policy.decide(belief, self._velocity)
        if self.decision.refused:
            self.state, self.reason, self._goal_refused = "blocked", self.decision.reason, True
        return self.decision.action

    def _turn_to_goal_heading(self, pose: Array) -> Array | None:
        """Turn (3,) in base_link towards the goal's heading. None if the heading is within tolerance or free."""
        if self.goal is None or self.goal.yaw_tolerance is None:
            return None
        error = float(se2.wrap(self.goal.pose.yaw - pose[2]))
        if abs(error) <= self.goal.yaw_tolerance:
            return None
        return np.array([0.0, 0.0, turn_rate(error, self.robot)])

    def _update_progress(self, stamp_ns: int, *, limited_by_scan: bool) -> None:
        """Sets the state to "blocked" after `BLOCKED_AFTER_S` without motion, and back when the robot moves."""
        if self.state not in {"navigating", "blocked"} or self._goal_refused or self._pose_unknown:
            self._standing_since_ns = None
            return
        self.reason = self.decision.reason or ("slowed by the scan" if limited_by_scan else "")
        if self.decision.recovering:
            self.state = "blocked"
            return
        obstructed = limited_by_scan or self.decision.state == "blocked"
        if is_moving(self._velocity) or not obstructed:
            self._standing_since_ns = None
            self.state = "navigating"
            return
        self._standing_since_ns = stamp_ns if self._standing_since_ns is None else self._standing_since_ns
        if (stamp_ns - self._standing_since_ns) * 1e-9 >= BLOCKED_AFTER_S:
            self.state, self.reason = "blocked", self.decision.reason or "the scan shows something in the way"

    def status(self, stamp_ns: int, distance: float | None) -> Status:
        """Status message with the current goal and state; ``distance`` to the goal in m."""
        return Status(
            stamp_ns=stamp_ns,
            state=self.state,
            reason=self.reason,
            refused=self._goal_refused,
            goal=self.goal.pose if self.goal is not None else None,
            goal_seq=self.goal.seq if self.goal is not None else 0,
            distance=distance,
        )

    def stop_without_belief(self, stamp_ns: int, reason: str) -> tuple[CmdVel, Status]:
        """Zero command and its status, for when no belief came in time. Keeps the goal for when beliefs come again."""
        if self._scan is not None and self._scan.stamp_ns == self._command_stamp_ns:
            self._velocity_before_pause = self._velocity  # the latest scan was answered: the simulation is paused
        self.policy.interrupt()
        self._velocity = np.zeros(3)
        self._set_lost(reason)
        status = self.status(stamp_ns, None)
        if not self._goal_refused:  # otherwise keep showing why the goal was refused
            status = status.model_copy(update={"reason": reason})
        return CmdVel(stamp_ns=stamp_ns, twist=Twist()), status

    def _set_lost(self, reason: str) -> None:
        """Marks an active goal as waiting for a belief."""
        if self.state in {"navigating", "blocked", "exploring"} and not self._goal_refused:
            self.state, self.reason, self._pose_unknown = "lost", reason, True
