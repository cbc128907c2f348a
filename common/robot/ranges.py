"""Special values of ranges (REP-117): no return, too close, not measured.

0 < range     distance to a surface
+inf          no surface within range_max
-inf          a surface too close to measure: an obstacle, but not used for localisation
0             not measured: not used at all; drivers send 0 or NaN
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Float = TypeVar("Float", np.float32, np.float64)
NOT_MEASURED = 0.0  # m


def normalise_driver_ranges(ranges: npt.NDArray[Float], range_min: float, range_max: float) -> npt.NDArray[Float]:
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
    measured = np.where(far, dtype(np.inf), np.where(near, dtype(-np.inf), ranges))
    return np.where(unmeasured, dtype(NOT_MEASURED), measured)


def is_surface(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Whether each range is a distance to a surface; same shape."""
    return np.asarray(np.isfinite(ranges) & (ranges > 0))


def ranges_for_localisation(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Ranges in m as estimators use them: those that are too close or not measured become -inf."""
    return np.where(is_surface(ranges) | np.isposinf(ranges), ranges, -np.inf).astype(np.float64)
