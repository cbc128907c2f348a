"""Passes on fresh velocity commands within the limits, and stops otherwise.

The base needs a watchdog of its own, as ROS drivers have: if this process dies, it cannot send a stop.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from common.geometry.se2 import Array
from common.messages.definitions import CmdVel, Scan
from common.robot.robot import Robot
from common.robot.self_filter import NO_FILTER, SelfFilter
from common.runtime import safety

MIN_SPEED = 1e-3  # m/s and rad/s; smaller components become 0
STOP_REPEAT_S = 0.5  # how long a stop is repeated; after that other publishers (a joystick, nav2) may use the topic
STOP_REPEAT_PERIOD_S = 0.1  # between repeated stops after commands have ended


class CommandGate:
    """Checks each command against the scan with its stamp, and limits its velocity.

    All times ``now`` are monotonic, in s.
    """

    def __init__(self, robot: Robot, self_filter: SelfFilter = NO_FILTER, *, obstacle_stop: bool = True) -> None:
        self.robot, self.self_filter = robot, self_filter
        self.obstacle_stop = obstacle_stop
        self.refused = 0  # commands that were too old, out of order, or newer than the newest scan
        self.stopped = False  # the last command was slowed down because of an obstacle
        self._points = np.zeros((0, 2))  # of the last scan
        self._scan: tuple[int, float] | None = None  # stamp and reception time of the newest scan
        # s between the last scans: of their stamps, and of their receptions, which is longer in a slow simulation
        self._periods: deque[float] = deque(maxlen=5)
        self._reception_periods: deque[float] = deque(maxlen=5)
        self._velocity: tuple[Array, float] | None = None  # from odometry, with its reception time
        self._command_stamp = -1
        self._command_at = -1e9  # when the last newer command was received
        self._moving_at = -1e9  # when the last command that moves the robot was passed on
        self._moving = False
        self._stopped_at = self._stop_repeated_at = -1e9  # first and last stop after commands have ended

    @property
    def timeout(self) -> float:
        """Time in s without a newer command after which the robot is stopped. Longer for a slow scanner."""
        return max(self.robot.command_timeout, 1.5 * _median(self._periods), 1.5 * _median(self._reception_periods))

    def add_scan(self, scan: Scan, now: float) -> None:
        """Stores the scan's stamp and its obstacles."""
        if self._scan is not None:
            before, received_at = self._scan
            if scan.stamp_ns < before:  # stamps went back: the next commands have smaller stamps too
                self._command_stamp = -1
            else:
                self._periods.append(min((scan.stamp_ns - before) * 1e-9, 1.0))
                self._reception_periods.append(min(now - received_at, 1.0))
        self._scan = (scan.stamp_ns, now)
        velocity = self._current_velocity(now)
        corrected = self.self_filter.correct_and_mask(scan, np.zeros(3) if velocity is None else velocity)
        self._points = safety.scan_points(corrected)

    def add_velocity(self, twist: Array, now: float) -> None:
        """Stores the robot's velocity (3,) from odometry."""
        self._velocity = (twist, now)

    def _current_velocity(self, now: float) -> Array | None:
        """Velocity (3,) from odometry; None if there was none lately."""
        return self._velocity[0] if self._velocity and now - self._velocity[1] < 0.5 else None

    def command(self, message: CmdVel, now: float) -> Array | None:
        """Velocity (3,) to pass on, in m/s, m/s, rad/s. Returns None if nothing should be sent."""
        if not self._is_fresh(message.stamp_ns, now):
            self.refused += 1
            return None
        if message.stamp_ns > self._command_stamp:  # a repeated command does not extend the timeout
            self._command_at = now
        self._command_stamp = message.stamp_ns
        twist = safety.clip_twist(message.twist.array(), self.robot)
        self.stopped = False
        if self.obstacle_stop:
            current = self._current_velocity(now)
            # If nothing else arrives, the robot is stopped after the timeout. The first beam of a scan is a period old.
            hold = self.timeout + _median(self._periods) + (now - self._scan[1] if self._scan is not None else 0.0)
            twist, self.stopped = safety.limit_velocity(twist, self._points, self.robot, current, hold)
        twist = np.where(np.abs(twist) < MIN_SPEED, 0.0, twist)
        if twist.any():
            if self.due(now) <= 0:  # a command repeated after the timeout
                return self.stop_for_silence(now)
            self._moving, self._moving_at, self._stopped_at = True, now, -1e9
            return twist
        self._moving = False
        return twist if now - self._moving_at <= STOP_REPEAT_S else None

    def _is_fresh(self, stamp_ns: int, now: float) -> bool:
        """Whether a command answers a recent scan, and is not older than the last command."""
        if self._scan is None or now - self._scan[1] > self.robot.command_age:
            return False
        age = (self._scan[0] - stamp_ns) * 1e-9
        return 0 <= age <= self.robot.command_age and stamp_ns >= self._command_stamp

    def due(self, now: float) -> float:
        """Seconds until a moving robot has to be stopped because commands have ended."""
        return self._command_at + self.timeout - now

    @property
    def moving(self) -> bool:
        """Whether the last command that was passed on moves the robot."""
        return self._moving

    def stop_for_silence(self, now: float) -> Array | None:
        """A stop, as zeros (3,), if the robot is moving, else None. `repeat_stop` repeats it."""
        moving, self._moving = self._moving, False
        if moving:
            self._stopped_at = self._stop_repeated_at = now
        return np.zeros(3) if moving else None

    def repeat_due(self, now: float) -> float | None:
        """Seconds until the stop is repeated, because a single message may be lost. Returns None if not needed."""
        if now - self._stopped_at > STOP_REPEAT_S:
            return None
        return self._stop_repeated_at + STOP_REPEAT_PERIOD_S - now

    def repeat_stop(self, now: float) -> Array | None:
        """A repeated stop, as zeros (3,), if it is due, else None."""
        due = self.repeat_due(now)
        if due is None or due > 0:
            return None
        self._stop_repeated_at = now
        return np.zeros(3)


def _median(periods: deque[float]) -> float:
    """Median in s, robust against a single gap or a change of the clock; 0 if there are none."""
    return float(np.median(periods)) if periods else 0.0
