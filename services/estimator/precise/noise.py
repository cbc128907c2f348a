"""Estimates the scanner's noise from its scans."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.robot.ranges import is_surface

if TYPE_CHECKING:
    from common.geometry.se2 import Array

MIN_SIGMA_M = 0.003
NORMAL_MAD = 1.4826  # standard deviation of a Gaussian, in median absolute deviations


def estimate_noise(ranges: Array, angles: Array) -> float:
    """The scanner's noise in m, from its scans (N, B) alone.

    Along a straight wall 1/r is a sinusoid of the angle, so u(a - d) + u(a + d) = 2 cos(d) u(a) for u = 1/r; the rest
    is noise. The median absolute deviation is used because the relation does not hold at edges.
    """
    turn = 2 * np.cos(np.diff(angles).mean())
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.where(is_surface(ranges), ranges, np.nan)
        bend = (inverse[:, 2:] - turn * inverse[:, 1:-1] + inverse[:, :-2]) * ranges[:, 1:-1] ** 2
    bend = bend[np.isfinite(bend)]
    if not len(bend):
        return MIN_SIGMA_M
    return max(MIN_SIGMA_M, float(NORMAL_MAD * np.median(np.abs(bend)) / np.sqrt(2 + turn**2)))


def robust_excess(errors: Array, expected_variance: Array) -> float:
    """Variance in m² of errors (K,) beyond ``expected_variance`` (K,) or (), by medians, so outliers hardly matter."""
    return (NORMAL_MAD * float(np.median(np.abs(errors)))) ** 2 - float(np.median(expected_variance))
