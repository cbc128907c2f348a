"""Interpolates poses over time."""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array

MAX_GAP_NS = 1_000_000_000  # between two poses; over a longer gap there is no interpolation


class PoseTrack:
    """Poses over time, added in any order; 32 bytes each, and a pose that does not change is stored only twice."""

    def __init__(self) -> None:
        self._stamps, self._rows = array("q"), array("d")
        self._sorted: tuple[npt.NDArray[np.int64], Array] | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Adds ``pose`` (3,) at a time; ignores a pose that is not finite."""
        if not np.isfinite(pose).all():
            return
        row = array("d", pose.tolist())
        self._sorted = None
        unchanged = len(self) > 1 and self._rows[-6:-3] == self._rows[-3:] == row
        if unchanged and self._stamps[-2] <= self._stamps[-1] <= stamp_ns <= self._stamps[-2] + MAX_GAP_NS:
            self._stamps[-1] = stamp_ns
            return
        self._stamps.append(stamp_ns)
        self._rows.extend(row)

    def at(self, stamp_ns: int) -> Array | None:
        """Pose (3,) at a time, linearly interpolated in position and heading (by the shorter turn).

        Returns None before the first pose, after the last, and between two poses more than a second apart.
        """
        stamps, rows = self._sort()
        if not len(stamps):
            return None
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return np.array(rows[after])
        if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > MAX_GAP_NS:
            return None
        a, b = rows[after - 1], rows[after]
        share = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        yaw = se2.wrap(a[2] + share * se2.wrap(b[2] - a[2]))
        return np.array([*(a[:2] + share * (b[:2] - a[:2])), yaw])

    def _sort(self) -> tuple[npt.NDArray[np.int64], Array]:
        if self._sorted is None:
            stamps, rows = np.array(self._stamps, np.int64), np.array(self._rows).reshape(-1, 3)
            order = np.argsort(stamps, kind="stable")
            self._sorted = stamps[order], rows[order]
        return self._sorted
