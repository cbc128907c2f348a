"""Interpolates poses over time."""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array

GAP_NS = 1_000_000_000  # further apart than this two poses say nothing of what lies between


class Track:
    """Poses as they come, in any order: 32 bytes each, and what stays the same costs nothing."""

    def __init__(self) -> None:
        self._stamps, self._rows = array("q"), array("d")
        self._sorted: tuple[npt.NDArray[np.int64], Array] | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, pose: Array) -> None:
        """``pose`` (3,) at a time; one that is not finite is none."""
        if not np.isfinite(pose).all():
            return
        row = array("d", pose.tolist())
        self._sorted = None
        stands = len(self) > 1 and self._rows[-6:-3] == self._rows[-3:] == row
        if stands and self._stamps[-2] <= self._stamps[-1] <= stamp_ns <= self._stamps[-2] + GAP_NS:
            self._stamps[-1] = stamp_ns
            return
        self._stamps.append(stamp_ns)
        self._rows.extend(row)

    def at(self, stamp_ns: int) -> Array | None:
        """(3,) there: along the straight line between the pose before and the one behind, and by the shorter turn.

        None before the first, after the last, and where those two are more than a second apart.
        """
        stamps, rows = self._in_order()
        if not len(stamps):
            return None
        behind = int(np.searchsorted(stamps, stamp_ns))
        if behind < len(stamps) and stamps[behind] == stamp_ns:
            return np.array(rows[behind])
        if behind in (0, len(stamps)) or stamps[behind] - stamps[behind - 1] > GAP_NS:
            return None
        a, b = rows[behind - 1], rows[behind]
        share = (stamp_ns - stamps[behind - 1]) / (stamps[behind] - stamps[behind - 1])
        yaw = se2.wrap(a[2] + share * se2.wrap(b[2] - a[2]))
        return np.array([*(a[:2] + share * (b[:2] - a[:2])), yaw])

    def _in_order(self) -> tuple[npt.NDArray[np.int64], Array]:
        if self._sorted is None:
            stamps, rows = np.array(self._stamps, np.int64), np.array(self._rows).reshape(-1, 3)
            order = np.argsort(stamps, kind="stable")
            self._sorted = stamps[order], rows[order]
        return self._sorted
