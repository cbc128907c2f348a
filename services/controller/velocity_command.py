"""The commanded velocity, within the limits of the base and of the obstacles in the scan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.messages.definitions import CmdVel, Twist
from common.runtime import safety

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.base import Robot


class VelocityCommand:
    """The latest command. The next one differs from it by no more than the base can accelerate."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.velocity = np.zeros(3)  # (3,) m/s, m/s, rad/s in base_link
        self.stamp_ns: int | None = None  # of the latest belief or scan that was answered
        self._before_pause: Array | None = None  # velocity before a pause of the simulation

    def limit(self, stamp_ns: int, desired: Array, points: Array) -> tuple[CmdVel, bool]:
        """The command for a desired velocity (3,), and whether the obstacle ``points`` (K, 2) m reduced it."""
        period_s = 0.0 if self.stamp_ns is None else max(0.0, (stamp_ns - self.stamp_ns) * 1e-9)
        self.stamp_ns = stamp_ns
        ramped = safety.ramp(self.velocity, safety.clip_twist(desired, self.robot), self.robot, period_s)
        self.velocity, limited_by_scan = safety.limit_velocity(ramped, points, self.robot)
        vx, vy, wz = map(float, self.velocity)
        return CmdVel(stamp_ns=stamp_ns, twist=Twist(vx=vx, vy=vy, wz=wz)), limited_by_scan

    def stop(self, stamp_ns: int, *, paused: bool) -> CmdVel:
        """The command to stand. If the simulation may be ``paused``, `resume` can undo it."""
        if paused:
            self._before_pause = self.velocity
        self.velocity = np.zeros(3)
        return CmdVel(stamp_ns=stamp_ns, twist=Twist())

    def resume(self, stamp_ns: int) -> bool:
        """Restore the velocity from before a pause, if the stamps show that no simulated time has passed.

        Returns whether it was restored.
        """
        before, self._before_pause = self._before_pause, None
        if before is None or self.stamp_ns is None:
            return False
        if not 0 < stamp_ns - self.stamp_ns <= self.robot.command_age * 1e9:
            return False
        self.velocity = before
        return True
