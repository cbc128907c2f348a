"""What remains of a scan when people stand around the scanner: does it contradict the place, does it still hold it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common import se2
from services.estimator.generative import CORNER

if TYPE_CHECKING:
    from common.se2 import Array
    from services.estimator.generative import Expected
    from services.estimator.precise.gauss_newton import View

CLEARLY = 4.0  # standard deviations


def contradicted(view: View, expected: Expected) -> float:
    """Share of the ranges that end clearly behind the surface ``expected`` (of one pose) there.

    Whatever stands in the way ends a beam early, at the right place too; nothing but a wrong place (or a thing that was
    taken away) ends it late.
    """
    surface = expected.ranges[0]
    both = np.isfinite(view.ranges) & np.isfinite(surface)
    deviation = np.hypot(expected.scale[0], view.likelihood.deviation(surface))
    late = view.ranges[both] > (surface + CLEARLY * deviation)[both]
    return float(late.mean()) if late.size else 0.0


def held(view: View, pose: Array, direction: Array) -> float:
    """Beams on surfaces turned towards ``direction`` (2,), by how far they are explained: they hold ``pose`` there."""
    expected = view.model.expect(se2.compose(pose, view.mount)[None], view.angles)
    normal, surface, scale = expected.jacobian[0, :, :2], expected.ranges[0], expected.scale[0]
    turned = np.abs(normal @ direction) > np.sin(CORNER) * np.hypot(*normal.T)
    there = turned & np.isfinite(view.ranges) & np.isfinite(surface)
    return float(view.likelihood.inlier(view.ranges[there], surface[there], scale[there], view.range_max).sum())
