"""What a range value means (REP-117): distance, no return, too close, not measured.

0 < range     a surface at that distance
+inf          nothing within range_max
-inf          something too close to measure: in the way of the robot, and no help to tell where it is
0             not measured: says nothing. LaserScan has no sign for it but "outside the limits", and drivers send it
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Numbers = TypeVar("Numbers", np.float32, np.float64)
NOT_MEASURED = 0.0  # m


def normalise_driver_ranges(ranges: npt.NDArray[Numbers], range_min: float, range_max: float) -> npt.NDArray[Numbers]:
    """A driver's numbers (...) m as a scan message has them; limits in m.

    From ``range_max`` on nothing is within it: drivers give that very number, or a greater one, where nothing came
    back. Above 0 but below ``range_min`` something is too close. NaN, 0 and what is negative are no measurements:
    drivers mean "nothing there" by them, and "too dark", "of glass" and "too close" as well.
    """
    # In single precision, as messages have both: a limit of 8.3 m is not missed by a ten-millionth.
    single = ranges.astype(np.float32)
    none = np.isnan(ranges) | ((ranges <= 0) & ~np.isneginf(ranges))
    far, near = single >= np.float32(range_max), (single < np.float32(range_min)) & ~none
    kind = ranges.dtype.type
    return np.where(none, kind(NOT_MEASURED), np.where(far, kind(np.inf), np.where(near, kind(-np.inf), ranges)))


def surfaces(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """(...) which of a scan's ranges (...) are distances to a surface."""
    return np.asarray(np.isfinite(ranges) & (ranges > 0))


def ranges_for_localisation(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """(...) m as estimators take them: whatever says nothing about the place, too close or not measured, is -inf."""
    return np.where(surfaces(ranges) | np.isposinf(ranges), ranges, -np.inf).astype(np.float64)
