"""Resamples scans whose number of beams changes."""

from __future__ import annotations

import numpy as np

from common.geometry.se2 import Array, wrap
from common.robot.ranges import NOT_MEASURED, is_surface

ANGLE_TOLERANCE = 1e-4  # rad, below which two beams have the same angle
# A scan is not resampled if its beams are more than this many times as far apart as the wanted angles: most of the
# ranges would be invented. The same value as in services/estimator/paper/beam_fitting.py.
MAX_SPACING_RATIO = 4.0
# Two neighbouring beams hit the same surface if their ranges differ by less than this share of the smaller one.
SAME_SURFACE_SHARE = 0.1


def resample(ranges: Array, angles: Array, wanted: Array) -> Array | None:
    """Ranges (B,) m at the angles ``wanted`` (B,) rad, from a scan (S,) m at ``angles`` (S,) rad, ascending.

    Interpolates linearly between two beams on the same surface, otherwise takes the nearer beam. Angles without a beam
    within the spacing of the scan are NOT_MEASURED. Returns the scan itself if the angles are the same, and None if the
    scan is too coarse or covers less than half of the wanted angles.
    """
    if len(angles) == len(wanted) and float(np.abs(wrap(angles - wanted)).max()) < ANGLE_TOLERANCE:
        return ranges
    spacing = float(np.median(np.diff(angles)))
    if spacing > MAX_SPACING_RATIO * float(np.median(np.diff(wanted))):
        return None
    order = np.argsort(wrapped := wrap(angles))
    # Copies one turn before and after give every wanted angle a neighbour on both sides.
    ring = np.concatenate([wrapped[order] - 2 * np.pi, wrapped[order], wrapped[order] + 2 * np.pi])
    values = np.tile(ranges[order], 3)
    targets = wrap(wanted)
    after = np.searchsorted(ring, targets)
    left, right = values[after - 1], values[after]
    gap = ring[after] - ring[after - 1]
    share = (targets - ring[after - 1]) / np.maximum(gap, 1e-12)
    result = np.where(share < 0.5, left, right)
    same = is_surface(left) & is_surface(right) & (gap < 2 * spacing)
    same[same] = np.abs(left[same] - right[same]) < SAME_SURFACE_SHARE * np.minimum(left[same], right[same])
    result[same] = left[same] + share[same] * (right[same] - left[same])
    covered = np.minimum(share, 1 - share) * gap <= spacing
    return np.where(covered, result, NOT_MEASURED) if 2 * covered.sum() >= len(wanted) else None
