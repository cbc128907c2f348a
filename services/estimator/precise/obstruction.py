"""Decides whether unexplained beams contradict a pose or are only blocked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.shared.generative_models import CORNER

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.shared.generative_models import Expected

CLEARLY = 4.0  # standard deviations


def contradicted(view: View, expected: Expected) -> float:
    """Share of the ranges that end clearly behind the surface ``expected`` (of one pose) there.

    Whatever stands in the way ends a beam early, at the right place too; nothing but a wrong place (or a thing that was
    taken away) ends it late.
    """
    both = np.isfinite(view.ranges) & np.isfinite(expected.ranges[0])
    return late(view, expected) * len(both) / max(1, int(both.sum()))


def late(view: View, expected: Expected) -> float:
    """The same as a share of all beams: where little is expected, little can contradict."""
    return float((np.isfinite(view.ranges) & (view.ranges > _behind(view, expected))).mean())


def crowded(view: View, expected: Expected, contradicted: float) -> bool:
    """Whether what stands in the way is all that the model does not explain: (nearly) every beam is expected to end."""
    known = np.isfinite(expected.scale[0])
    return float((known & (view.ranges <= _behind(view, expected))).mean()) > 0.95 - contradicted


def held(view: View, pose: Array, direction: Array) -> float:
    """Beams on surfaces turned towards ``direction`` (2,), by how far they are explained: they hold ``pose`` there."""
    expected = view.model.expect(se2.compose(pose, view.mount)[None], view.angles)
    normal, surface, scale = expected.jacobian[0, :, :2], expected.ranges[0], expected.scale[0]
    turned = np.abs(normal @ direction) > np.sin(CORNER) * np.hypot(*normal.T)
    there = turned & np.isfinite(view.ranges) & np.isfinite(surface)
    return float(view.likelihood.inlier(view.ranges[there], surface[there], scale[there], view.range_max).sum())


def _behind(view: View, expected: Expected) -> Array:
    """(B,) m: what is seen beyond is clearly behind the surface expected."""
    surface = expected.ranges[0]
    return np.asarray(surface + CLEARLY * np.hypot(expected.scale[0], view.likelihood.deviation(surface)))
