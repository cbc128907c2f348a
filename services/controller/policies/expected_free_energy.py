"""Expected free energy of candidate motions.

A motion pi, in active inference called a policy, leads to the belief q(s | pi) about the pose; o are the scans on the
way. With preferences p(s) and the sensor model p(o | s), its expected free energy in nats is

    G(pi) = E_q[-ln p(s)] + E_q[H(p(o | s))] - E_q[ln q(s | o, pi) - ln q(s | pi)]
              risk            ambiguity        information gain, about the pose and about the place

and the probability of a motion is softmax(-PROBABILITY_PRECISION G). docs/method.md states the terms, how they differ
from Parr, Pezzulo & Friston 2022, and the approximations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array

NATS_PER_METRE = 0.02  # of -ln p(s) per metre to go: 10 m of driving cost as much as 0.2 nats
PROBABILITY_PRECISION = 5000.0  # a motion that ends 1 cm nearer to the goal is e times as probable
# Covariance of a pose that is known well enough: information beyond it does not count. The standard deviations are half
# of what the estimator calls localised, 0.2 m and 5 degrees.
RESOLUTION_COVARIANCE = np.diag([0.1, 0.1, np.deg2rad(2.5)]) ** 2
# Standard deviation, in m and rad, that a metre without scans adds to a position and a heading. It is as far as the
# robot could have got, which is what an estimator without odometry assumes.
DRIFT_PER_METRE = 1.0
OUTLIER_SHARE = 0.25  # share of the beams that the estimator's likelihood expects to end early
ARRIVAL_ERROR_M = 0.05  # the robot does not stop exactly at the place for which a scan is predicted
INDEPENDENT_SECTORS = 8  # a person, or a displaced edge, spoils a sector of neighbouring beams rather than one beam
MIN_BEAM_OVERLAP = 1e-6  # lower limit of one beam's overlap, so that a product of 50 beams does not underflow


@dataclass(frozen=True)
class ExpectedFreeEnergy:
    """The terms of N motions in nats, (N,) each."""

    risk: Array
    ambiguity: Array  # motions: entropy of the pose along the path; paths to a place: mean entropy of a beam there
    pose_information: Array  # expected gain about where the robot is within a place
    place_information: Array  # expected gain about which of several places it is at

    @property
    def total(self) -> Array:
        """G (N,) in nats."""
        return self.risk + self.ambiguity - self.pose_information - self.place_information

    def of(self, motion: int) -> dict[str, float]:
        """The terms of one motion by name, and its probability among all N."""
        terms = {name: float(values[motion]) for name, values in vars(self).items()}
        return terms | {"probability": motion_probability(float(self.total[motion]), self.total)}


def motion_probability(energy: float, compared: Array) -> float:
    """Probability of a motion with this ``energy`` among N with energies ``compared`` (N,), nats, +inf if excluded."""
    return float(1 / np.exp(-PROBABILITY_PRECISION * (compared - energy)).sum())


def expected_distance(distance: Array, variance: float) -> Array:
    """Distance (...,) m to a point, expected under a belief whose position has this variance, m², over both axes.

    It is the root of the expected square, an upper bound.
    """
    return np.sqrt(distance**2 + variance)


def expected_square(value: Array, deviation: float) -> Array:
    """Expected square of a value (...,), clipped to 0..1, under Gaussian noise; by three points (Gauss-Hermite)."""
    away = np.sqrt(3) * deviation
    low, middle, high = (np.clip(value + offset, 0.0, 1.0) ** 2 for offset in (-away, 0.0, away))
    return np.asarray((low + 4 * middle + high) / 6)


def remaining_entropy(covariance: Array, information: Array) -> Array:
    """Entropy (...,) in nats beyond `RESOLUTION_COVARIANCE`, of a pose after scans with ``information`` (..., 3, 3).

    ``covariance`` (..., 3, 3) is that of the pose before. The result is 0 for a pose known better than the resolution.
    """
    return np.asarray(np.linalg.slogdet(np.eye(3) + _relative_covariance(covariance, information))[1] / 2)


def _relative_covariance(covariance: Array, information: Array) -> Array:
    """Covariance (..., 3, 3) after scans with an ``information`` (..., 3, 3), in units of `RESOLUTION_COVARIANCE`."""
    both = np.broadcast_shapes(covariance.shape, information.shape)
    posterior = np.linalg.solve(np.eye(3) + covariance @ information, np.broadcast_to(covariance, both))
    return np.asarray(posterior / np.diag(RESOLUTION_COVARIANCE)[:, None])


def entropy(weights: Array) -> float:
    """Entropy in nats of weights (K,), which are normalised first."""
    w = np.asarray(weights, float) / np.sum(weights)
    return float(-np.sum(w * np.log(np.where(w > 0, w, 1.0))))


def place_information(weights: Array, ranges: Array, sigma: Array, range_max: float) -> Array:
    """Lower bound (M,) in nats of what one scan after each of M motions tells about which hypothesis is true.

    ``weights`` (K,) belong to the hypotheses; ``ranges`` (K, M, B) m are predicted for each hypothesis after each
    motion, +inf for no return; ``sigma`` (K, M, B) m are their standard deviations. The density of a beam is
    p(o) = (1 - e) N(o; r, s²) + e / R, with e = `OUTLIER_SHARE`; `ARRIVAL_ERROR_M` is added to sigma in quadrature, and
    all beams count as at most `INDEPENDENT_SECTORS` independent ones. With 0.69 nats between two equally likely places,
    3 clearly different beams of 61 gain 0.2 nats, 8 beams 0.4, and 20 beams 0.65.

    The mutual information of hypothesis k and scan has no closed form for a mixture. This is the pairwise bound of
    Kolchinsky & Tracey 2017 ("Estimating mixture entropy with pairwise distances") with the Bhattacharyya coefficient:

        I(k; o) >= -sum_i w_i ln sum_j w_j BC_ij,    BC_ij = integral sqrt(p_i p_j) do

    For independent beams BC is a product over the beams. Each factor is bounded from above, with
    sqrt(a + b) <= sqrt(a) + sqrt(b) and without the term for the ratio of the standard deviations: two predictions that
    differ only in their uncertainty do not tell hypotheses apart.

        BC_b <= (1 - e) exp(-(r_i - r_j)² / (4 (s_i² + s_j²))) + e + sqrt(e (1 - e) / R) sum_k (8 pi s_k²)^(1/4)

    The result lies between 0 (equal scans) and the entropy of the weights.
    """
    w = np.asarray(weights, float) / np.sum(weights)
    r = np.clip(np.asarray(ranges, float), 0.0, range_max)
    variance = np.asarray(sigma, float) ** 2 + ARRIVAL_ERROR_M**2
    tail = OUTLIER_SHARE / 2 + np.sqrt(OUTLIER_SHARE * (1 - OUTLIER_SHARE) / range_max) * (8 * np.pi * variance) ** 0.25
    independent_share = min(1.0, INDEPENDENT_SECTORS / max(r.shape[2], 1))
    overlap = np.ones((len(w), len(w), r.shape[1]))  # BC of whole scans
    for i in range(len(w)):
        for j in range(i):
            core = np.exp(-((r[i] - r[j]) ** 2) / (4 * (variance[i] + variance[j])))
            beams = np.clip((1 - OUTLIER_SHARE) * core + tail[i] + tail[j], MIN_BEAM_OVERLAP, 1.0)
            overlap[i, j] = overlap[j, i] = np.exp(independent_share * _log_product(beams))
    mixed = np.einsum("j,ijm->im", w, overlap)
    gain = -np.einsum("i,im->m", w, np.log(np.where(w[:, None] > 0, mixed, 1.0)))
    return np.asarray(np.clip(gain, 0.0, entropy(w))) + 0.0  # adding 0 turns -0.0 into 0.0


def _log_product(factors: Array) -> Array:
    """Ln of the product over beams (M,) of factors (M, B), each at least `MIN_BEAM_OVERLAP`."""
    if not factors.shape[1]:
        return np.zeros(len(factors))
    parts = np.multiply.reduceat(factors, np.arange(0, factors.shape[1], 50), axis=1)  # fewer logarithms are faster
    return np.asarray(np.log(parts).sum(axis=1))
