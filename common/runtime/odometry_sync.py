"""Pairs each scan with the odometry of its stamp, which may arrive later than the scan."""

from __future__ import annotations

from common.messages.definitions import Odom, Scan

MAX_SILENCE_NS = 1_000_000_000  # scans no longer wait for odometry that has been silent for longer
ScanWithOdometry = tuple[Scan, Odom | None]


class OdometrySync:
    """Holds each scan back until its odometry arrives, or until later odometry or the next scan does."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Discards the waiting scan and the last odometry."""
        self._odom: Odom | None = None
        self._waiting: Scan | None = None

    def add_odometry(self, odom: Odom) -> list[ScanWithOdometry]:
        """Returns the scan that waited for this odometry, if any."""
        self._odom = odom
        return self._release() if self._waiting is not None and odom.stamp_ns >= self._waiting.stamp_ns else []

    def add_scan(self, scan: Scan) -> list[ScanWithOdometry]:
        """Returns the scans that no longer wait: the one before, and this one unless it waits itself."""
        ready = self._release()
        self._waiting = scan
        waits = self._odom is not None and 0 < scan.stamp_ns - self._odom.stamp_ns < MAX_SILENCE_NS
        return ready if waits else ready + self._release()

    def _release(self) -> list[ScanWithOdometry]:
        scan, self._waiting = self._waiting, None
        if scan is None:
            return []
        return [(scan, self._odom if self._odom is not None and self._odom.stamp_ns == scan.stamp_ns else None)]
