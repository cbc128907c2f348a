"""Docking: reaches a goal precisely, on a straight line in its approach direction.

| phase | what the robot does | next phase |
|---|---|---|
| DRIVE | the policy drives to the start of the line | ALIGN, within the usual tolerance of a goal |
| ALIGN | turns to the goal's heading | LINE |
| LINE | follows the line to the goal | arrived, or DRIVE if it left the line or stopped beside the goal |

A differential base cannot correct its lateral error at the goal, so it converges to the line on the way, as does a
holonomic base. The last motion is slow, because a scan is distorted by motion and a command takes effect late.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.messages.definitions import GOAL_TOLERANCE_M
from services.controller.policies.motion_model import STEP_S, braking_speed, turn_rate

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Goal
    from common.robot.robot import Robot

LINE_LENGTH_M = 0.6  # of the straight approach, which the robot drives exactly
LINE_SPEED = 0.2  # m/s
SETTLING_TIME_S = 0.3  # time constant of the arrival; longer than scan period, latency and braking time together
CONVERGENCE_M = 0.1  # a differential base corrects its lateral error over a few times this distance
MAX_LINE_ERROR_M = 0.1  # a robot that is farther from the line, at its side or beyond an end, drives to its start again
MAX_ALIGN_ERROR_RAD = 0.03  # heading error with which the robot may start to follow the line
STANDING_TIME_S = 1.0  # time at rest before the robot counts as arrived, because the belief lags behind slow motion
# The robot stops correcting an error below this share of the tolerance, so that noise does not keep it moving.
TARGET_SHARE = 0.33


class DockingPhase(Enum):
    """Phase of docking."""

    DRIVE = auto()
    ALIGN = auto()
    LINE = auto()


class Docking:
    """Drives to a goal that has an approach direction; the policy drives in phase DRIVE."""

    def __init__(self, goal: Goal, robot: Robot) -> None:
        assert goal.approach is not None  # noqa: S101 - only such a goal is docked at
        self.robot, self.phase = robot, DockingPhase.DRIVE
        self.position, self.direction = goal.pose.array()[:2], goal.approach  # m, m and rad in map
        self.tolerance, self.yaw_tolerance = goal.tolerance, goal.yaw_tolerance
        # A differential base without a goal heading drives forwards.
        self.heading = goal.approach if goal.yaw_tolerance is None else goal.pose.yaw
        self.backwards = abs(float(se2.wrap(self.heading - goal.approach))) > np.pi / 2

    def line(self) -> Array:
        """Points (7, 2) m in map from the start of the line to the goal."""
        behind = np.linspace(LINE_LENGTH_M, 0.0, 7)[:, None]
        return np.asarray(self.position - behind * np.array([np.cos(self.direction), np.sin(self.direction)]))

    def refusal(self) -> str | None:
        """Why this base cannot approach the goal like this, or None if it can."""
        # Angle between heading and line; the robot may also follow the line backwards.
        angle = float(se2.wrap(2 * (self.heading - self.direction))) / 2
        if self.robot.drive == "differential" and abs(angle) > (self.yaw_tolerance or np.inf):
            return "a differential base moves along its heading, and cannot approach the goal across it"
        return None

    def interrupt(self) -> None:
        """Starts again, because the robot was driven by hand, stopped, or lost its pose."""
        self.phase = DockingPhase.DRIVE

    def errors(self, pose: Array) -> tuple[float, float, float]:
        """Errors of a pose (3,) relative to the goal: m along the line, m across it, and rad of heading.

        The heading error is 0 for a holonomic base if the goal accepts any heading.
        """
        along, across = se2.rotate(-self.direction, self.position - pose[:2])
        free_heading = self.yaw_tolerance is None and self.robot.drive == "holonomic"
        return float(along), float(across), 0.0 if free_heading else float(se2.wrap(self.heading - pose[2]))

    def arrived(self, pose: Array) -> bool:
        """Whether a pose (3,) is within the goal's tolerances."""
        along, across, turn = self.errors(pose)
        return bool(np.hypot(along, across) <= self.tolerance and abs(turn) <= (self.yaw_tolerance or np.inf))

    def velocity(self, pose: Array, hold: float = STEP_S) -> Array | None:
        """Velocity (3,) in base_link for the pose (3,) at which the command takes effect, and holds for ``hold`` s.

        Returns None in phase DRIVE.
        """
        along, across, turn = self.errors(pose)
        if self.phase is DockingPhase.DRIVE and np.hypot(along - LINE_LENGTH_M, across) <= GOAL_TOLERANCE_M:
            self.phase = DockingPhase.ALIGN
        if self.phase is DockingPhase.ALIGN:
            if abs(turn) > MAX_ALIGN_ERROR_RAD:
                return np.array([0.0, 0.0, turn_rate(turn, self.robot, hold)])
            self.phase = DockingPhase.LINE
        if not -MAX_LINE_ERROR_M < along < LINE_LENGTH_M + MAX_LINE_ERROR_M or abs(across) > MAX_LINE_ERROR_M:
            self.phase = DockingPhase.DRIVE
        if self.phase is DockingPhase.DRIVE:
            return None
        is_off = abs(turn) > TARGET_SHARE * (self.yaw_tolerance or np.inf)
        turn_command = turn_rate(turn, self.robot, hold) if is_off else 0.0
        if self.robot.drive == "holonomic":
            velocity = self._holonomic_velocity(along, across)
            return np.array([*se2.rotate(self.direction - pose[2], velocity), turn_command])
        speed = self._speed(along)
        if speed > 0:  # with y' = yaw along the line, y'' = -2 y' / C - y / C^2: critically damped, so no overshoot
            turn_command = speed * (across / CONVERGENCE_M + 2 * turn) / CONVERGENCE_M
        elif speed == 0 and turn_command == 0 and not self.arrived(pose):
            self.phase = DockingPhase.DRIVE  # the robot stands beside the goal
            return None
        return np.array([-speed if self.backwards else speed, 0.0, turn_command])

    def _holonomic_velocity(self, along: float, across: float) -> Array:
        """Velocity (2,) m/s along and across the line, with which the robot gets onto the line before the goal."""
        target = np.array([along / 2, across])
        return target / max(float(np.hypot(*target)), 1e-9) * self._speed(float(np.hypot(along, across)))

    def _speed(self, distance: float) -> float:
        """Speed in m/s for ``distance`` m to go, with its sign; 0 within the share `TARGET_SHARE` of the tolerance."""
        if abs(distance) <= TARGET_SHARE * self.tolerance:
            return 0.0
        return float(np.copysign(min(LINE_SPEED, braking_speed(abs(distance), self.robot, SETTLING_TIME_S)), distance))
