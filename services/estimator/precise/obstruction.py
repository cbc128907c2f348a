"""Decides whether unexplained beams contradict a pose or are only blocked.

Something in the way of a beam makes it end early, at the right pose too. A beam ends behind the expected surface only
at a wrong pose (or where something was taken away).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.shared.generative_models import CORNER_ANGLE_RAD

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.shared.generative_models import Expected

BEHIND_SIGMAS = 4.0  # standard deviations behind the expected surface, from which a beam counts as behind it
MIN_ACCOUNTED_SHARE = 0.95


def contradicting_ratio(view: View, expected: Expected) -> float:
    """Share of beams behind the expected surface among those that returned and have one; for one pose."""
    comparable = np.isfinite(view.ranges) & np.isfinite(expected.ranges[0])
    return behind_ratio(view, expected) * len(comparable) / max(1, int(comparable.sum()))


def behind_ratio(view: View, expected: Expected) -> float:
    """Share of all beams that end behind the expected surface; it is small if the model expects few surfaces."""
    return float((np.isfinite(view.ranges) & (view.ranges > _behind_from(view, expected))).mean())


def is_only_blocked(view: View, expected: Expected, max_contradicting_ratio: float) -> bool:
    """Whether nearly all beams are known and none ends behind its surface, so that obstacles can explain the misfit."""
    known = np.isfinite(expected.scale[0])
    accounted = float((known & (view.ranges <= _behind_from(view, expected))).mean())
    return accounted > MIN_ACCOUNTED_SHARE - max_contradicting_ratio


def constraining_beams(view: View, pose: Array, direction: Array) -> float:
    """Expected number of inlier beams on surfaces that face ``direction`` (2,), and so fix ``pose`` (3,) along it."""
    expected = view.model.expect(se2.compose(pose, view.mount)[None], view.angles)
    normal, surface, scale = expected.jacobian[0, :, :2], expected.ranges[0], expected.scale[0]
    facing = np.abs(normal @ direction) > np.sin(CORNER_ANGLE_RAD) * np.hypot(*normal.T)
    used = facing & np.isfinite(view.ranges) & np.isfinite(surface)
    return float(view.likelihood.inlier(view.ranges[used], surface[used], scale[used], view.range_max).sum())


def _behind_from(view: View, expected: Expected) -> Array:
    """Ranges (B,) in m beyond which a beam is clearly behind the expected surface."""
    surface = expected.ranges[0]
    return np.asarray(surface + BEHIND_SIGMAS * np.hypot(expected.scale[0], view.likelihood.deviation(surface)))
