"""Special values of ranges (REP-117): no return, too close, not measured.

0 < range     distance to a surface
+inf          no surface within range_max
-inf          a surface too close to measure: an obstacle, but not used for localisation
0             not measured: not used at all. LaserScan has no other value for it, and drivers send 0
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Numbers = TypeVar("Numbers", np.float32, np.float64)
NOT_MEASURED = 0.0  # m


def normalise_driver_ranges(ranges: npt.NDArray[Numbers], range_min: float, range_max: float) -> npt.NDArray[Numbers]:
    """Converts a driver's ranges of any shape to those of a scan message; all in m.

    ``range_max`` and larger values become +inf, because drivers report them when there is no return. Values above 0 and
    below ``range_min`` become -inf (too close). NaN, 0 and negative values become 0 (not measured), because drivers
    report them for no return as well as for dark, transparent or close surfaces.
    """
    # Compared in single precision, as in messages, so that a range equal to the limit 8.3 m is recognised.
    single = ranges.astype(np.float32)
    unmeasured = np.isnan(ranges) | ((ranges <= 0) & ~np.isneginf(ranges))
    far, near = single >= np.float32(range_max), (single < np.float32(range_min)) & ~unmeasured
    dtype = ranges.dtype.type
    known = np.where(far, dtype(np.inf), np.where(near, dtype(-np.inf), ranges))
    return np.where(unmeasured, dtype(NOT_MEASURED), known)


def is_surface(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Mask, of the same shape, of the ranges that are distances to a surface."""
    return np.asarray(np.isfinite(ranges) & (ranges > 0))


def ranges_for_localisation(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Ranges in m as estimators use them: -inf replaces those that are too close or not measured."""
    return np.where(is_surface(ranges) | np.isposinf(ranges), ranges, -np.inf).astype(np.float64)
