"""The commanded velocity, within the limits of the base and of the obstacles in the scan."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.messages.definitions import CmdVel, Twist
from common.runtime import safety

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.robot.robot import Robot


class VelocityCommand:
    """The latest command. The next one differs from it by no more than the base can accelerate."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.velocity = np.zeros(3)  # (3,) m/s, m/s, rad/s in base_link
        self.stamp_ns: int | None = None  # of the latest belief or scan that was answered
        self._below_dead_band = np.zeros(3)  # sum over scans of desired velocities that were too low to command
        self._period_s = 0.0  # s between the last two commands that were not stops
        self._stopped = False  # whether the last command was a stop
        self._before_pause: Array | None = None  # velocity before a pause of the simulation
        self._sent: deque[tuple[int, Array]] = deque(maxlen=100)  # stamps in ns and velocities of the last commands

    def limit(self, stamp_ns: int, desired: Array, points: Array) -> tuple[CmdVel, bool]:
        """Returns the command for a desired velocity (3,), and whether obstacle ``points`` (K, 2) m reduced it."""
        period_s = 0.0 if self.stamp_ns is None else max(0.0, (stamp_ns - self.stamp_ns) * 1e-9)
        # After a pause or a jump of the clock, stamps are far apart, but the base accelerated for two periods at most.
        longest = self._period_s if self._stopped else (2 * self._period_s or self.robot.command_timeout)
        period_s = min(period_s, longest)
        self.stamp_ns, self._period_s, self._stopped = stamp_ns, period_s, False
        possible, too_low = self._in_pulses(safety.clip_twist(desired, self.robot))
        ramped = safety.ramp(self.velocity, possible, self.robot, period_s)
        self.velocity, limited_by_scan = safety.limit_velocity(ramped, points, self.robot)
        # The base ignores speeds below the dead band, also while the command is still accelerating to a pulse.
        moves = self._speeds(self.velocity) >= self._dead_bands
        self._below_dead_band -= np.where(too_low & moves, self.velocity, 0.0)
        self._sent.append((stamp_ns, self.velocity))
        vx, vy, wz = map(float, self.velocity)
        return CmdVel(stamp_ns=stamp_ns, twist=Twist(vx=vx, vy=vy, wz=wz)), limited_by_scan

    def motion_until_effect(self, stamp_ns: int, delay_s: float) -> Array:
        """Motion (3,) in base_link from a stamp until a command with that stamp takes effect, ``delay_s`` later.

        Until then the earlier commands apply, each of which also takes effect ``delay_s`` after its stamp.
        """
        motion, end_ns, first_ns = np.zeros(3), stamp_ns, stamp_ns - round(delay_s * 1e9)
        for sent_ns, velocity in reversed(self._sent):
            if end_ns <= first_ns:
                break
            begin_ns = min(max(sent_ns, first_ns), end_ns)
            motion = se2.compose(velocity * (end_ns - begin_ns) * 1e-9, motion)
            end_ns = begin_ns
        return motion

    @property
    def _dead_bands(self) -> Array:
        return np.array([self.robot.dead_band, self.robot.dead_band, self.robot.turn_dead_band])

    def _speeds(self, velocity: Array) -> Array:
        """The speed (3,) to compare with the dead band of each component: that along the path for vx and vy."""
        return np.array([np.hypot(*velocity[:2])] * 2 + [abs(velocity[2])])

    def _in_pulses(self, desired: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The desired velocity (3,), or where that is below the base's dead band, pulses just above the dead band.

        The sum of the pulses follows that of the desired velocities, as in a sigma-delta modulator. Also returns where
        the desired velocity is below the dead band (3,).
        """
        limits, speeds = self._dead_bands, self._speeds(desired)
        too_low = (speeds > 0) & (speeds < limits)
        total = np.where(too_low, self._below_dead_band + desired, 0.0)
        # At most two pulses wait. More would add up where an obstacle keeps the robot from moving.
        self._below_dead_band = total * np.minimum(1.0, 2 * limits / np.maximum(self._speeds(total), 1e-9))
        sums = self._speeds(self._below_dead_band)
        # Slightly more than the dead band, because the base compares rounded numbers.
        pulse = np.where(sums >= limits, self._below_dead_band * 1.01 * limits / np.maximum(sums, 1e-9), 0.0)
        return np.where(too_low, pulse, desired), too_low

    def stop(self, stamp_ns: int, *, paused: bool) -> CmdVel:
        """Returns the command to stop. If the simulation may be ``paused``, `resume` can undo it."""
        if paused:
            self._before_pause = self.velocity
        self.velocity, self._stopped = np.zeros(3), True
        self._sent.append((stamp_ns, self.velocity))
        return CmdVel(stamp_ns=stamp_ns, twist=Twist())

    def resume(self, stamp_ns: int) -> bool:
        """Restores the velocity from before a pause, if the last command is not older than `Robot.command_age`.

        Returns whether it was restored.
        """
        before, self._before_pause = self._before_pause, None
        if before is None or self.stamp_ns is None:
            return False
        if not 0 < stamp_ns - self.stamp_ns <= self.robot.command_age * 1e9:
            return False
        self.velocity, self._stopped = before, False
        return True
