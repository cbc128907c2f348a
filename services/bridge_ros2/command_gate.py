"""Passes on fresh velocity commands within the limits, and stops otherwise.

The base's own watchdog, as ROS drivers have one, stands behind this: nobody can send a stop who has died.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from common.geometry.se2 import Array
from common.messages.definitions import CmdVel, Scan
from common.robot.base import Robot
from common.runtime import safety

MIN_SPEED = 1e-3  # m/s and rad/s; less is none
STOP_REPEAT_S = 0.5  # s for which a stop is said again; then the topic is left to others (a joystick, nav2)
STOP_REPEAT_PERIOD_S = 0.1  # s between two of those that nobody asked for


class CommandGate:
    """Judges each command by the scan it answers."""

    def __init__(self, robot: Robot, *, obstacle_stop: bool = True) -> None:
        """Standing."""
        self.robot = robot
        self.obstacle_stop = obstacle_stop
        self.refused = 0  # commands too old, out of order, or answering a scan that never was
        self.stopped = False  # the last command was slowed before an obstacle
        self._points = np.zeros((0, 2))
        self._scan: tuple[int, float] | None = None  # stamp of the newest, and when it came
        self._periods: deque[float] = deque(maxlen=5)  # s between the last scans
        self._velocity: tuple[Array, float] | None = None  # by odometry, and when
        self._stamp = -1  # of the last command
        self._heard = self._moved = -1e9  # when a newer command came, and when one that moves was passed on
        self._moving = False
        self._ended = self._reminded = -1e9  # when a stop for silence was said first, and last

    @property
    def _period(self) -> float:
        """S between scans; a single gap, or a clock that is set, changes nothing."""
        return float(np.median(self._periods)) if self._periods else 0.0

    @property
    def timeout(self) -> float:
        """S without a newer command after which the robot stops; a slow scanner's commands come less often."""
        return max(self.robot.command_timeout, 1.5 * self._period)

    def add_scan(self, scan: Scan, now: float) -> None:
        """What commands are about, and what is in the way."""
        if self._scan is not None:
            before, _ = self._scan
            if scan.stamp_ns < before:  # time begins anew: so do commands
                self._stamp = -1
            else:
                self._periods.append(min((scan.stamp_ns - before) * 1e-9, 1.0))
        self._scan = (scan.stamp_ns, now)
        self._points = safety.scan_points(scan)

    def add_velocity(self, twist: Array, now: float) -> None:
        """(3,) how the robot moves, by its odometry."""
        self._velocity = (twist, now)

    def command(self, message: CmdVel, now: float) -> Array | None:
        """(3,) m/s, m/s, rad/s to pass on; None: nothing."""
        if not self._fresh(message.stamp_ns, now):
            self.refused += 1
            return None
        if message.stamp_ns > self._stamp:  # one said again keeps nothing going
            self._heard = now
        self._stamp = message.stamp_ns
        twist = safety.clip_twist(message.twist.array(), self.robot)
        self.stopped = False
        if self.obstacle_stop:
            current = self._velocity[0] if self._velocity and now - self._velocity[1] < 0.5 else None
            hold = max(safety.REACTION_TIME_S, 2 * self._period)
            twist, self.stopped = safety.limit_velocity(twist, self._points, self.robot, current, hold)
        twist = np.where(np.abs(twist) < MIN_SPEED, 0.0, twist)
        if twist.any():
            if self.due(now) <= 0:  # said again after the time was up
                return self.stop_for_silence(now)
            self._moving, self._moved, self._ended = True, now, -1e9
            return twist
        self._moving = False
        return twist if now - self._moved <= STOP_REPEAT_S else None

    def _fresh(self, stamp_ns: int, now: float) -> bool:
        """Whether it answers a scan of lately, and none before the last one's."""
        if self._scan is None or now - self._scan[1] > self.robot.command_age:
            return False
        age = (self._scan[0] - stamp_ns) * 1e-9
        return 0 <= age <= self.robot.command_age and stamp_ns >= self._stamp

    def due(self, now: float) -> float:
        """S until a moving robot has to be stopped."""
        return self._heard + self.timeout - now

    @property
    def moving(self) -> bool:
        """Whether the last that was passed on moves the robot."""
        return self._moving

    def stop_for_silence(self, now: float) -> Array | None:
        """(3,) zeros where commands have ended under way; `repeat_stop` says them again."""
        moving, self._moving = self._moving, False
        if moving:
            self._ended = self._reminded = now
        return np.zeros(3) if moving else None

    def repeat_due(self, now: float) -> float | None:
        """S until a stop for silence is to be said again: one message may get lost, and links fail just then."""
        return None if now - self._ended > STOP_REPEAT_S else self._reminded + STOP_REPEAT_PERIOD_S - now

    def repeat_stop(self, now: float) -> Array | None:
        """(3,) zeros, where it is time for them."""
        due = self.repeat_due(now)
        if due is None or due > 0:
            return None
        self._reminded = now
        return np.zeros(3)
