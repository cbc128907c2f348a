"""Manual velocity commands, with a timeout."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Drive

# Age at which a drive message expires. Messages that command zero velocity override the goal for as long at most.
MANUAL_TIMEOUT_NS = 500_000_000


class ManualDrive:
    """The latest velocity commanded by hand, until it expires.

    All times are stamps of scans and beliefs, so that the timeout pauses when a simulation pauses.
    """

    def __init__(self) -> None:
        self._twist = np.zeros(3)
        self._last_message_ns: int | None = None
        self._zero_since_ns: int | None = None  # since when all messages command zero velocity

    def update(self, drive: Drive, now_ns: int) -> None:
        """Stores a drive message that arrived at ``now_ns``, the stamp of the latest scan or command."""
        self._twist = drive.twist.array()
        if self._twist.any():
            self._zero_since_ns = None
        elif self._zero_since_ns is None or self._expired(now_ns):
            self._zero_since_ns = now_ns
        self._last_message_ns = now_ns

    def twist(self, now_ns: int) -> Array | None:
        """Velocity (3,) in m/s, m/s and rad/s in base_link, before any limit.

        Returns None if the robot is not driven by hand: no message came within the timeout, or only zero velocity has
        been commanded for longer than that, so that an idle joystick does not hold up the goal.
        """
        if self._expired(now_ns):
            return None
        if self._zero_since_ns is not None and now_ns - self._zero_since_ns > MANUAL_TIMEOUT_NS:
            return None
        return self._twist

    def _expired(self, now_ns: int) -> bool:
        # A belief may be somewhat earlier than the latest scan. If time goes back farther, the simulation was reset,
        # and the message is from before.
        if self._last_message_ns is not None and now_ns < self._last_message_ns - MANUAL_TIMEOUT_NS:
            self._last_message_ns = None
        return self._last_message_ns is None or now_ns - self._last_message_ns > MANUAL_TIMEOUT_NS
