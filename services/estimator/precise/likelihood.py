"""Density of a beam, and a scan's free energy with its derivatives.

    p(o | g) = (1 - unseen) ((1 - short - random) N(o; g, sigma² + m²) + short [o < g] / g + random / range_max)

sigma is the scanner's noise (sigma² + (relative g)² where it grows with the range), m the model's stated error, `short`
the share of beams that something unknown ends (people, moved furniture), `random` that of all else (something was taken
away): a proper density with tails that no outlier moves (Thrun, Burgard & Fox 2005, section 6.3, without its gains). A
beam without return has the probability `unseen` where a surface is expected; where none is, 1 - unseen, and any range
is as likely as any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from services.estimator.shared import kernels

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.generative_models import Expected


KNOWN = 0.3  # share of the beams of which something must be expected


_erf = np.vectorize(math.erf, otypes=[float])


@dataclass(frozen=True)
class Evidence:
    """What the beams say about N poses; derivatives by the laser's pose."""

    accuracy: Array  # (N,) nats, -ln p(o | pose)
    explained: Array  # (N,) expected share of used beams that the model explains
    xi: Array  # (N, 3) minus the gradient of accuracy: 1/m, 1/m, 1/rad
    curvature: Array  # (N, 3, 3) Gauss-Newton Hessian
    of_noise: Array  # (N, 3, 3) covariance of xi from the scanner's noise
    of_model: Array  # (N, 3, 3) covariance of xi from the model's error, were beams independent

    def part(self, rows: npt.NDArray[np.integer]) -> Evidence:
        """Of some of the poses."""
        return Evidence(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class Likelihood:
    """Parameters of the density."""

    sigma: float = 0.02  # m
    short: float = 0.25
    random: float = 0.005
    unseen: float = 0.05
    relative: float = 0.0  # of the range: the part of the scanner's noise that grows with it

    def evaluate(self, measured: Array, range_max: float, expected: Expected, widen: float = 0.0) -> Evidence:
        """For ranges (B,) m (+inf no return, -inf: not used); ``widen`` m is added to every deviation."""
        count = len(expected.ranges)
        total, gradient = np.zeros((count, 3)), np.zeros((count, 3))
        matrices = np.zeros((count, 3, 3, 3))
        kernels.accumulate(
            measured, expected.ranges, expected.jacobian, expected.scale,
            self.sigma, self.relative, widen, self.short, self.random, range_max, self.unseen,
            total, gradient, matrices,
        )  # fmt: skip
        # A pose from which nearly nothing is known explains nearly nothing.
        least = KNOWN * len(measured) if np.isinf(expected.scale).any() else 1.0
        explained = total[:, 1] / np.maximum(total[:, 2], max(least, 1.0))
        return Evidence(total[:, 0], explained, gradient, matrices[:, 0], matrices[:, 1], matrices[:, 2])

    def deviation(self, expected: Array) -> Array | float:
        """M, the scanner's noise of ``expected`` ranges m of any shape; of +inf that of 0 m."""
        if not self.relative:
            return self.sigma
        return np.hypot(self.sigma, self.relative * np.where(np.isfinite(expected), expected, 0.0))

    def density(self, measured: Array, expected: float, scale: float, range_max: float) -> Array:
        """p(o | g) in 1/m at measured (K,) m; with the probability of no return it sums to one."""
        if expected >= range_max:
            return np.full(len(measured), self.unseen / range_max)
        core, flat = self._parts(measured, expected, scale, range_max)
        return np.asarray((1 - self.unseen) * (core + flat))

    def cumulative(self, measured: Array, expected: Array, scale: Array, range_max: float) -> Array:
        """(K,) probability of a range of at most ``measured`` (K,) m, given that there is one."""
        deviation = np.hypot(self.deviation(expected), scale)
        core = 0.5 * (1 + _erf((measured - expected) / (np.sqrt(2) * deviation)))
        early = np.minimum(measured / np.maximum(expected, 1e-3), 1.0)
        flat = np.minimum(measured / range_max, 1.0)
        return np.asarray((1 - self.short - self.random) * core + self.short * early + self.random * flat)

    def inlier(self, measured: Array, expected: Array, scale: Array, range_max: float) -> Array:
        """(K,) probability that the surface expected ended the beam, and nothing else; finite ranges (K,) m."""
        core, flat = self._parts(measured, expected, scale, range_max)
        return np.asarray(core / (core + flat))

    def _parts(
        self, measured: Array, expected: Array | float, scale: Array | float, range_max: float
    ) -> tuple[Array, Array]:
        variance = self.deviation(np.asarray(expected)) ** 2 + scale**2
        core = np.exp(-0.5 * (measured - expected) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
        flat = self.short / np.maximum(expected, 1e-3) * (measured < expected) + self.random / range_max
        return (1 - self.short - self.random) * core, flat
