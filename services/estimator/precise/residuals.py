"""Statistics of the differences between a scan and its prediction, from which the map's errors are learned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.noise import NORMAL_MAD

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

DAMPING = 1e-9  # in m; keeps the inverse finite where a direction is not observed


def segment_ids(surface_ids: npt.NDArray[np.intp], lengths: Array, segment_length: float) -> npt.NDArray[np.intp]:
    """Cuts surfaces into segments of ``segment_length`` m.

    Returns the segment (K,) on which each beam ends, from its surface (K,) and the ``lengths`` (K,) in m that beams
    cover, in the order of the scan.
    """
    along = np.floor(np.cumsum(lengths) / segment_length)
    return np.cumsum((np.diff(surface_ids, prepend=surface_ids[:1]) != 0) | (np.diff(along, prepend=along[:1]) != 0))


def error_covariance(errors: Array, segments: npt.NDArray[np.intp], weights: Array) -> float:
    """Weighted covariance in m² of the errors (K,) of two different beams on the same segment; 0 if there are none."""
    pairs = sum_over_pairs(segments, weights)
    return sum_over_pairs(segments, weights * errors) / pairs if pairs > 0 else 0.0


def variance_by_noise(segments: npt.NDArray[np.intp], weights: Array, noise_variance: Array) -> float:
    """Variance in m⁴ of `error_covariance` if the errors are independent noise with ``noise_variance`` (K,) m²."""
    return 2 * sum_over_pairs(segments, weights**2 * noise_variance) / sum_over_pairs(segments, weights) ** 2


def sum_over_pairs(segments: npt.NDArray[np.intp], values: Array) -> float:
    """Sum of the products of the ``values`` (K,) of two different beams on the same segment."""
    return float((np.bincount(segments, values) ** 2 - np.bincount(segments, values**2)).sum())


def robust_covariance(errors: Array, segments: npt.NDArray[np.intp]) -> float:
    """Robust covariance in m² of the errors (K,) of consecutive beams on the same segment; outliers hardly matter.

    Gnanadesikan and Kettenring 1972. Returns 0 if there are no such beams.
    """
    first = np.flatnonzero(np.diff(segments) == 0)
    if not len(first):
        return 0.0
    a, b = errors[first], errors[first + 1]
    deviation_of_sum, deviation_of_difference = (NORMAL_MAD * float(np.median(np.abs(each))) for each in (a + b, a - b))
    return (deviation_of_sum**2 - deviation_of_difference**2) / 4


@dataclass(frozen=True)
class LeastSquares:
    """The weighted least squares fit of P parameters, such as the pose, to the errors of K beams."""

    design: Array  # (K, P) derivative of the errors by the parameters
    weights: Array  # (K,) of the beams
    inverse: Array  # (P, P) of the normal equations
    gain: Array  # (P, K) derivative of the fitted parameters by the errors

    @classmethod
    def of(cls, design: Array, weights: Array) -> LeastSquares:
        """The fit for ``design`` (K, P), the derivative of the errors by the parameters, and ``weights`` (K,)."""
        weighted = design * weights[:, None]
        inverse = np.linalg.inv(design.T @ weighted + DAMPING * np.eye(design.shape[1]))
        return cls(design, weights, inverse, inverse @ weighted.T)

    def residuals(self, errors: Array) -> Array:
        """What remains (K, ...) of ``errors`` (K, ...) after the fit."""
        return np.asarray(errors - self.design @ (self.gain @ errors))

    def expected_covariance(
        self, segments: npt.NDArray[np.intp], long_segments: npt.NDArray[np.intp], noise_variance: Array
    ) -> tuple[float, float]:
        """The values of `error_covariance` that are expected for the residuals.

        The first is for errors of the map with variance 1 that are equal on each of the ``long_segments`` (K,) and
        independent between them, the second for independent noise with ``noise_variance`` (K,) m². Without a fit, they
        would be 1 (if each segment lies in a long one) and 0.

        For errors with covariance C, the value is tr(W R C R') / sum(W). W has the products of the weights of all pairs
        of beams on the same segment, and the residuals are R = I - design gain times the errors.
        """
        weights, design, pairs = self.weights, self.design, sum_over_pairs(segments, self.weights)
        on_segment = _sums(weights[:, None] * design, segments)
        shift = _sums(self.gain.T, long_segments)  # of the fitted parameters by an error of 1 m on each long segment
        gram = shift.T @ shift
        # Beams that share both a segment and a long one
        shared = np.cumsum((np.diff(segments, prepend=0) != 0) | (np.diff(long_segments, prepend=0) != 0))
        first = np.flatnonzero(np.diff(shared, prepend=-1))
        weight = np.bincount(shared, weights)
        cross = (on_segment[segments[first]] * shift[long_segments[first]]).sum(axis=1)
        of_map = float((weight**2 - 2 * weight * cross).sum() + ((on_segment @ gram) * on_segment).sum())
        # Less the products of each beam with itself
        variance = 1 - 2 * (design * shift[long_segments]).sum(axis=1) + ((design @ gram) * design).sum(axis=1)
        of_map -= float((weights**2 * variance).sum())
        w_design = weights[:, None] * (on_segment[segments] - weights[:, None] * design)  # W times the design
        noise = self.gain * noise_variance
        of_noise = ((design.T @ w_design) * (noise @ self.gain.T)).sum() - 2 * (noise * w_design.T).sum()
        return of_map / pairs, float(of_noise / pairs)


def _sums(values: Array, ids: npt.NDArray[np.intp]) -> Array:
    """Sums (N, P) of ``values`` (K, P) with the same one of the sorted ``ids`` (K,) from 0 to N - 1."""
    return np.add.reduceat(values, np.flatnonzero(np.diff(ids, prepend=-1)), axis=0)
