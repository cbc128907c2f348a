"""Journal of the controller: its recent changes of state, with the reasons."""

from __future__ import annotations

import math
import re
from collections import deque
from typing import Any

from common.messages.definitions import Status, Truth

MAX_ROWS = 20  # shown on the page
DISTANCE_MARGIN, ANGLE_MARGIN = 0.1, 0.3  # m and rad; smaller displacements are never reported
ACCELERATION, TURN_ACCELERATION = 2.0, 12.0  # m/s² and rad/s²; more than robots reach
NUMBERS = re.compile(r"[-+\d.,()]+")


class Journal:
    """Has one row for each change of state or reason.

    A status with the same state makes no new row if its reason is empty, or differs only in numbers.
    """

    def __init__(self) -> None:
        self._rows: deque[dict[str, Any]] = deque(maxlen=MAX_ROWS)
        self._last: dict[str, Any] | None = None  # the last row made by a status

    def add(self, status: Status) -> bool:
        """Processes a status. Returns whether it made a new row."""
        reason = status.reason[:500]
        last = self._last
        same = last is not None and last["state"] == status.state
        if last is not None and same and (not reason or _without_numbers(last["reason"]) == _without_numbers(reason)):
            return False
        self._last = {"t": status.stamp_ns * 1e-9, "state": status.state, "reason": reason}
        self._rows.append(self._last)
        return True

    def add_displacement(self, before: Truth, after: Truth) -> bool:
        """Adds a row and returns True if the robot cannot have driven from one true pose to the next."""
        if not is_displaced(before, after):
            return False
        away = math.hypot(after.pose.x - before.pose.x, after.pose.y - before.pose.y)
        reason = f"{away:.1f} m, to ({after.pose.x:.2f}, {after.pose.y:.2f}); the estimator is not informed"
        self._rows.append({"t": after.stamp_ns * 1e-9, "state": "carried", "reason": reason})
        return True

    def clear(self) -> None:
        """Removes all rows, after stamps went back."""
        self._rows.clear()
        self._last = None

    def rows(self) -> list[dict[str, Any]]:
        """Rows with time in s, state and reason, the oldest first."""
        return list(self._rows)


def is_displaced(before: Truth, after: Truth) -> bool:
    """Whether the robot moved or turned further between two true poses than its velocities at the two poses allow."""
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    away = math.hypot(after.pose.x - before.pose.x, after.pose.y - before.pose.y)
    turned = after.pose.yaw - before.pose.yaw
    if seconds < 0 or not math.isfinite(away + turned):
        return False
    turned = abs(math.remainder(turned, math.tau))
    speed = max(math.hypot(truth.twist.vx, truth.twist.vy) for truth in (before, after))
    turn_rate = max(abs(truth.twist.wz) for truth in (before, after))
    reach = DISTANCE_MARGIN + (speed + ACCELERATION * seconds) * seconds
    return away > reach or turned > ANGLE_MARGIN + (turn_rate + TURN_ACCELERATION * seconds) * seconds


def _without_numbers(reason: str) -> str:
    return NUMBERS.sub("#", reason)
