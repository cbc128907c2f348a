"""Resamples scans whose number of beams changes."""

from __future__ import annotations

import numpy as np

from common.geometry.se2 import Array, wrap
from common.robot.ranges import NOT_MEASURED, surfaces

SAME = 1e-4  # rad, by which a beam may be off and is the same
COARSEST = 4.0  # times the first scan's spacing, as in services/estimator/paper/beam_fitting.py
ONE_SURFACE = 0.1  # of the nearer range, by which two neighbours differ at most


def resampled(ranges: Array, angles: Array, wanted: Array) -> Array | None:
    """Ranges (B,) m at ``wanted`` (B,) rad, from a scan (S,) m at ``angles`` (S,) rad, ascending; see `ranges`.

    Between two beams on one surface linearly, else as the nearer of the two says; where none is within the scan's own
    spacing: not measured. None of a scan that cannot stand for it: too coarse, or it looks at less than half of that.
    """
    if len(angles) == len(wanted) and float(np.abs(wrap(angles - wanted)).max()) < SAME:
        return ranges
    spacing = float(np.median(np.diff(angles)))
    if spacing > COARSEST * float(np.median(np.diff(wanted))):
        return None
    order = np.argsort(around := wrap(angles))
    # Once more on either side, for views that go all round.
    ring = np.concatenate([around[order] - 2 * np.pi, around[order], around[order] + 2 * np.pi])
    values = np.tile(ranges[order], 3)
    at = wrap(wanted)
    after = np.searchsorted(ring, at)
    a, b = values[after - 1], values[after]
    gap = ring[after] - ring[after - 1]
    share = (at - ring[after - 1]) / np.maximum(gap, 1e-12)
    found = np.where(share < 0.5, a, b)
    one = surfaces(a) & surfaces(b) & (gap < 2 * spacing)
    one[one] = np.abs(a[one] - b[one]) < ONE_SURFACE * np.minimum(a[one], b[one])
    found[one] = a[one] + share[one] * (b[one] - a[one])
    seen = np.minimum(share, 1 - share) * gap <= spacing
    return np.where(seen, found, NOT_MEASURED) if 2 * seen.sum() >= len(wanted) else None
