"""Density of a beam, and a scan's free energy with its derivatives.

    p(o | g) = (1 - unseen) ((1 - short - random) N(o; g, sigma² + m²) + short [o < g] / g + random / range_max)

o is the measured range and g the expected one. sigma is the scanner's noise (sigma² + (relative g)² if it grows with
the range), m the error that the model states. `short` is the fraction of beams that end early at something the model
lacks (people, moved furniture), `random` the fraction of all other outliers (for example, something was taken away).
The density is proper and has tails, so that outliers do not move the estimate (Thrun, Burgard & Fox 2005, section 6.3,
without tuned gains).

A beam without return has the probability `unseen` if a surface is expected. If none is expected, a beam without return
has the probability 1 - unseen, and all measured ranges are equally likely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from common.errors import UserError
from services.estimator.precise import beam_sums
from services.estimator.shared.generative_models import Expected

if TYPE_CHECKING:
    from collections.abc import Sequence

    from common.geometry.se2 import Array


@dataclass(frozen=True)
class Evidence:
    """Accuracy of one scan at N poses, and its derivatives by the pose."""

    accuracy: Array  # (N,) nats, -ln p(o | pose)
    xi: Array  # (N, 3) minus the gradient of accuracy: 1/m, 1/m, 1/rad
    curvature: Array  # (N, 3, 3) Gauss-Newton Hessian
    xi_noise_covariance: Array  # (N, 3, 3) covariance of xi caused by the scanner's noise
    xi_model_covariance: Array  # (N, 3, 3) covariance of xi caused by the model's error, for independent beams

    @classmethod
    def joined(cls, parts: Sequence[Evidence]) -> Evidence:
        """The evidence at the poses of all parts, of which there is at least one."""
        return cls(*(np.concatenate(values) for values in zip(*(vars(part).values() for part in parts), strict=True)))

    def part(self, rows: npt.NDArray[np.integer]) -> Evidence:
        """Returns the evidence at some of the poses."""
        return Evidence(*(values[rows] for values in vars(self).values()))

    def at(self, row: int) -> Evidence:
        """Returns the evidence at one of the poses."""
        return self.part(np.array([row]))

    def scaled(self, factor: float) -> Evidence:
        """Returns the evidence with its derivatives, and the covariances of xi, multiplied by ``factor``."""
        derivatives = (self.xi, self.curvature, self.xi_noise_covariance, self.xi_model_covariance)
        return Evidence(self.accuracy, *(factor * each for each in derivatives))


@dataclass(frozen=True)
class Likelihood:
    """Parameters of the density, as the module describes it.

    A subclass is also a frozen dataclass, whose parameters are fields: it is copied with each noise that is learned.
    """

    sigma: float = 0.02  # m
    short: float = 0.25  # fraction of beams that end early
    random: float = 0.005  # fraction of other outliers
    unseen: float = 0.05  # probability of no return from a surface
    relative: float = 0.0  # standard deviation of the noise that grows with the range, as a fraction of the range

    def evaluate(
        self,
        measured: Array,
        range_max: float,
        expected: Expected,
        extra_sigma: float = 0.0,
        weights: Array | None = None,
    ) -> Evidence:
        """Returns the evidence of a scan, with derivatives by the laser's poses.

        ``measured`` (B,) are ranges in m: +inf is no return, -inf and NaN are not used. ``extra_sigma`` m is added in
        quadrature to every standard deviation. ``weights`` (N, B) scale the derivatives of each beam, by default 1.
        """
        count = len(expected.ranges)
        energy, gradient = np.zeros(count), np.zeros((count, 3))
        matrices = np.zeros((count, 3, 3, 3))
        beam_sums.accumulate(
            measured,
            expected.ranges,
            expected.jacobian,
            expected.scale,
            self.sigma,
            self.relative,
            extra_sigma,
            self.short,
            self.random,
            range_max,
            self.unseen,
            np.zeros((0, 0)) if weights is None else weights,
            energy,
            gradient,
            matrices,
        )
        return Evidence(energy, gradient, matrices[:, 0], matrices[:, 1], matrices[:, 2])

    def deviation(self, expected: Array) -> Array | float:
        """Standard deviation in m of the scanner's noise at ranges ``expected`` m of any shape; +inf counts as 0 m."""
        if not self.relative:
            return self.sigma
        return np.hypot(self.sigma, self.relative * np.where(np.isfinite(expected), expected, 0.0))

    def density(self, measured: Array, expected: float, scale: float, range_max: float) -> Array:
        """Density p(o | g) (K,) in 1/m at measured (K,) m; its integral and the probability of no return sum to 1."""
        if expected >= range_max:
            return np.full(len(measured), self.unseen / range_max)
        variance = self.deviation(np.asarray(expected)) ** 2 + scale**2
        core = np.exp(-0.5 * (measured - expected) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
        outliers = self.short / max(expected, 1e-3) * (measured < expected) + self.random / range_max
        return np.asarray((1 - self.unseen) * ((1 - self.short - self.random) * core + outliers))

    def cumulative(self, measured: Array, expected: Array, scale: Array, range_max: float) -> Array:
        """Probability (K,) of a range of at most ``measured`` (K,) m, given that the beam returns."""
        deviation = np.hypot(self.deviation(expected), scale)
        core = ndtr((measured - expected) / deviation)
        early = np.minimum(measured / np.maximum(expected, 1e-3), 1.0)
        flat = np.minimum(measured / range_max, 1.0)
        return np.asarray((1 - self.short - self.random) * core + self.short * early + self.random * flat)


def check_likelihood(likelihood: Likelihood) -> None:
    """Raises UserError if a likelihood cannot be copied with another noise, or does not return valid Evidence."""
    if not isinstance(likelihood, Likelihood):
        raise UserError(f"likelihood: give an object of a subclass of presage.Likelihood, not {likelihood!r}")
    name = type(likelihood).__name__
    try:
        copy = replace(likelihood, sigma=likelihood.sigma)
    except TypeError as error:
        raise UserError(
            f"likelihood: {name} cannot be copied ({error}): remove its __init__, decorate it with "
            "@dataclass(frozen=True), and make its parameters fields"
        ) from None
    # Two poses and seven beams: as expected, too short, no return, not measured, none expected, unknown to the model.
    ranges, scale = np.full((2, 7), 3.0), np.full((2, 7), 0.01)
    ranges[:, 3:5] = scale[:, 5:] = np.inf
    jacobian = np.where(np.isfinite(ranges + scale), 1.0, 0.0)[..., None] * np.array([1.0, 0.5, 0.1])
    measured = np.array([3.01, 2.0, np.inf, -np.inf, 3.0, np.nan, 3.0])
    for weights in (None, np.full(ranges.shape, 0.5)):
        evidence = copy.evaluate(measured, 25.0, Expected(ranges, scale, jacobian), 0.05, weights)
        if not isinstance(evidence, Evidence):
            raise UserError(f"likelihood: {name}.evaluate must return presage.Evidence, not {type(evidence).__name__}")
        for field, values in vars(evidence).items():
            shape = {"accuracy": (2,), "xi": (2, 3)}.get(field, (2, 3, 3))
            if np.shape(values) != shape:
                raise UserError(
                    f"likelihood: {name}.evaluate must return {field} of shape {shape} for two poses, not "
                    f"{np.shape(values)}"
                )
            if not np.isfinite(values).all():
                raise UserError(
                    f"likelihood: {name}.evaluate returned NaN or infinite {field}, for measured ranges {measured} and "
                    f"expected ranges {ranges[0]} with scale {scale[0]}"
                )
