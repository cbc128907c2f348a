"""Expected information gain of a motion between hypotheses.

The expected free energy of a motion is its cost minus its epistemic value (Friston et al. 2015, "Active inference and
epistemic value"). The epistemic value is the mutual information of hypothesis and next scan. For a mixture it has no
closed form; this module computes a lower bound, the pairwise bound of Kolchinsky & Tracey 2017 ("Estimating mixture
entropy with pairwise distances") with the Bhattacharyya coefficient BC:

    I(k; o) >= -sum_i w_i ln sum_j w_j BC_ij,    BC_ij = integral sqrt(p_i p_j) do

The bound is 0 if the predicted scans are equal, and the entropy of the weights if they differ clearly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

ENERGY_TOLERANCE_NATS = 1e-9  # expected free energies closer than this count as equal
MIN_BEAM_OVERLAP = 1e-6  # lower limit of one beam's BC, so that a product of 50 beams does not underflow
SAME_PLACE_M = 0.5  # a hypothesis moves less than this between two beliefs; closer destinations count as one
HEADING_WEIGHT_M_PER_RAD = 0.5  # weight of a difference in heading when two poses are compared
MAX_TRIED_DESTINATIONS = 20


@dataclass(frozen=True)
class PredictionTrust:
    """Parameters that limit how much evidence differences between predicted scans can give.

    A beam is an outlier with probability e = ``outliers``; every range is then equally likely:
    p(o) = (1 - e) N(o; r, s²) + e / R.

    Outliers are correlated: a person, or an edge predicted slightly off its true place, spoils a sector of the scan
    rather than one beam. B beams therefore count as at most ``sectors`` independent ones. With the defaults, and 0.69
    nats between two equally likely places, 3 clearly different beams of 61 gain 0.2 nats, 8 beams 0.4, and 20 beams
    0.65.
    """

    outliers: float = 0.25  # the share of beams that the estimator's likelihood expects to end early
    blur: float = 0.05  # m, added to sigma in quadrature, because the robot does not stop exactly at the destination
    sectors: int = 8


def candidate_poses(hypotheses: Array, displacements: Array) -> Array:
    """Poses (K, M, 3) of base_link in map after each of M motions from each of the hypotheses (K, 3).

    ``displacements`` (M, 3) m, m, rad are destinations in base_link, so the same motion applies to every hypothesis.
    """
    hypotheses, displacements = (np.asarray(a, float).reshape(-1, 3) for a in (hypotheses, displacements))
    return se2.compose(hypotheses[:, None, :], displacements[None, :, :])


def entropy(weights: Array) -> float:
    """Entropy in nats of weights (K,), which are normalised first."""
    w = np.asarray(weights, float) / np.sum(weights)
    return float(-np.sum(w * np.log(np.where(w > 0, w, 1.0))))


def information_gain(
    weights: Array, ranges: Array, sigma: Array, range_max: float, trust: PredictionTrust | None = None
) -> Array:
    """Lower bound (M,) in nats of the expected gain of information by one scan after each of M motions.

    ``weights`` (K,) belong to the hypotheses; ``ranges`` (K, M, B) m are predicted for each hypothesis after each
    motion, +inf for no return; ``sigma`` (K, M, B) m are their standard deviations.

    The result lies between 0 and the entropy of the weights. It is at least 0.8 of the mutual information if beams
    differ by three standard deviations (of 0.05 m). Beams that differ by less than one count as equal.

    For independent beams BC is a product over the beams. Each factor is bounded from above, so that the gain remains a
    lower bound. This uses sqrt(a + b) <= sqrt(a) + sqrt(b), and leaves out the term for the ratio of the standard
    deviations: two predictions that differ only in their uncertainty do not tell hypotheses apart.

        BC_b <= (1 - e) exp(-(r_i - r_j)² / (4 (s_i² + s_j²))) + e + sqrt(e (1 - e) / R) sum_k (8 pi s_k²)^(1/4)
    """
    trust = trust or PredictionTrust()
    w = np.asarray(weights, float) / np.sum(weights)
    r = np.clip(np.asarray(ranges, float), 0.0, range_max)
    variance = np.asarray(sigma, float) ** 2 + trust.blur**2
    e = trust.outliers
    tail = e / 2 + np.sqrt(e * (1 - e) / range_max) * (8 * np.pi * variance) ** 0.25
    independent_share = min(1.0, trust.sectors / max(r.shape[2], 1))
    overlap = np.ones((len(w), len(w), r.shape[1]))  # BC of whole scans
    for i in range(len(w)):
        for j in range(i):
            core = np.exp(-((r[i] - r[j]) ** 2) / (4 * (variance[i] + variance[j])))
            beams = np.clip((1 - e) * core + tail[i] + tail[j], MIN_BEAM_OVERLAP, 1.0)
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


def expected_free_energy(gain: Array, length: Array, nats_per_metre: float) -> Array:
    """Expected free energy (M,) in nats: cost minus epistemic value, for gains (M,) nats and path lengths (M,) m.

    ``nats_per_metre`` is the cost of driving in units of information. The result is +inf where ``length`` is +inf,
    which means that there is no path.
    """
    length, gain = np.asarray(length, float), np.asarray(gain, float)
    reachable = np.isfinite(length)
    return np.where(reachable, nats_per_metre * np.where(reachable, length, 0.0) - gain, np.inf)


def best_index(energy: Array, length: Array) -> int | None:
    """Index of the lowest expected free energy (M,), or None if none is finite.

    Among equal ones, the shortest path is preferred, then the first.
    """
    energy, length = np.asarray(energy, float), np.asarray(length, float)
    if not np.isfinite(energy).any():
        return None
    equal = np.flatnonzero(energy <= energy.min() + ENERGY_TOLERANCE_NATS)
    return int(equal[np.argmin(length[equal])])


@dataclass(frozen=True)
class CandidateMotions:
    """Possible motions under one belief. The first hypothesis is the best one."""

    hypotheses: Array  # (K, 3) base_link in map
    weights: Array  # (K,)
    displacements: Array  # (M, 3) destinations in base_link of the first hypothesis
    lengths: Array  # (M,) m to drive there; +inf if there is no path

    def poses(self) -> Array:
        """Poses (K * M, 3) in map for which scans must be predicted, grouped by hypothesis."""
        return candidate_poses(self.hypotheses, self.displacements).reshape(-1, 3)


@dataclass(frozen=True)
class ChosenDestination:
    """A destination, with the hypotheses under which it was chosen."""

    hypotheses: Array  # (K, 3) in map, updated with every belief
    places: Array  # (K, 3) in map, the destination under each hypothesis
    gain: float  # nats expected when it was chosen
    stamp_ns: int  # of the belief for which it was chosen


@dataclass
class DestinationSelector:
    """Selects a destination that tells hypotheses apart, and keeps it.

    Call `choose` when predictions are available, and `follow` with every belief. A destination is kept until it is
    reached, its time is up, or its expected gain has dropped. One that was reached, or not reached in time, and did not
    resolve the ambiguity is not chosen again while there are others.

    Two hypotheses of equal weight may alternate as the first one. The destination then moves with the first one:
    relative to the robot it stays the same.
    """

    nats_per_metre: float = 0.02  # 10 m of driving cost as much as 0.2 nats
    min_gain: float = 0.05  # nats; destinations with less are not considered
    switch_margin: float = 0.1  # nats of expected free energy by which another destination must be better
    min_gain_ratio: float = 0.5  # a destination is dropped when its gain falls below this share of the original gain
    arrival_radius: float = 0.4  # m
    timeout: float = 20.0  # s
    trust: PredictionTrust = field(default_factory=PredictionTrust)

    def __post_init__(self) -> None:
        self.chosen: ChosenDestination | None = None
        self._tried: list[Array] = []  # places (K, 3) of destinations that did not resolve the ambiguity

    def reset(self) -> None:
        """Forget the destination and the tried ones. Call it when the pose is known, or the goal has changed."""
        self.__post_init__()

    def choose(
        self, stamp_ns: int, motions: CandidateMotions, ranges: Array, sigma: Array, range_max: float
    ) -> Array | None:
        """The destination (3,) in map under the first hypothesis, or None if no motion gains enough.

        ``ranges`` and ``sigma`` (K, M, B) m are the predictions for `CandidateMotions.poses`. The previous destination
        is kept unless another one is better by ``switch_margin`` or its gain has dropped.
        """
        gain = information_gain(motions.weights, ranges, sigma, range_max, self.trust)
        places = candidate_poses(motions.hypotheses, motions.displacements)  # (K, M, 3)
        energy = expected_free_energy(gain, motions.lengths, self.nats_per_metre)
        energy = np.where(gain < self.min_gain, np.inf, energy)
        untried = np.where(self._was_tried(places[0]), np.inf, energy)
        if not np.isfinite(untried).any():  # try all of them again: a person may have blocked the view
            self._tried, untried = [], energy
        index, kept = best_index(untried, motions.lengths), self._index_of_chosen(places[0], gain, motions)
        if kept is not None and (index is None or untried[index] > energy[kept] - self.switch_margin):
            return self.follow(stamp_ns, motions.hypotheses, motions.weights)
        self.chosen = None
        if index is None:
            return None
        hypotheses = np.array(motions.hypotheses, float)
        self.chosen = ChosenDestination(hypotheses, places[:, index], float(gain[index]), stamp_ns)
        return np.array(places[0, index])

    def follow(self, stamp_ns: int, hypotheses: Array, weights: Array) -> Array | None:
        """The kept destination (3,) in map under the first of the present hypotheses (K, 3).

        Returns None if there is none, or if it has just been reached or dropped; `choose` then selects another one.
        """
        chosen, hypotheses = self.chosen, np.asarray(hypotheses, float).reshape(-1, 3)
        if chosen is None:
            return None
        timed_out = stamp_ns - chosen.stamp_ns > self.timeout * 1e9
        distance = _pose_distance(chosen.hypotheses[:, None, :], hypotheses[None, :, :])  # (chosen, present)
        matching = int(distance[:, 0].argmin())  # the hypothesis that is first now
        was_reset = stamp_ns < chosen.stamp_ns  # the simulation started again
        hypothesis_jumped = distance[matching, 0] > SAME_PLACE_M
        if timed_out or was_reset or hypothesis_jumped or entropy(weights) < self.min_gain_ratio * chosen.gain:
            self._drop(tried=timed_out)
            return None
        near = distance.min(axis=1) < SAME_PLACE_M
        moved = np.where(near[:, None], hypotheses[distance.argmin(axis=1)], chosen.hypotheses)
        self.chosen = replace(chosen, hypotheses=moved)
        if np.hypot(*(chosen.places[matching] - hypotheses[0])[:2]) < self.arrival_radius:
            self._drop(tried=True)
            return None
        return np.array(chosen.places[matching])

    def displacement(self, hypothesis: Array) -> Array | None:
        """The kept destination (3,) in base_link of a hypothesis (3,), as a candidate for the next `choose`.

        Returns None if there is none.
        """
        if self.chosen is None:
            return None
        matching = int(_pose_distance(self.chosen.hypotheses, hypothesis).argmin())
        return se2.between(hypothesis, self.chosen.places[matching])

    def _drop(self, *, tried: bool) -> None:
        if tried and self.chosen is not None:
            self._tried = [*self._tried, self.chosen.places][-MAX_TRIED_DESTINATIONS:]
        self.chosen = None

    def _index_of_chosen(self, places: Array, gain: Array, motions: CandidateMotions) -> int | None:
        """Index of the candidate (M, 3) at the kept destination, or None if there is none or its gain has dropped."""
        chosen = self.chosen
        if chosen is None or not len(places):
            return None
        matching = int(_pose_distance(chosen.hypotheses, np.asarray(motions.hypotheses, float)[0]).argmin())
        distance = np.hypot(*(places - chosen.places[matching])[:, :2].T)
        nearest = int(distance.argmin())
        available = distance[nearest] < SAME_PLACE_M and np.isfinite(motions.lengths[nearest])
        return nearest if available and gain[nearest] >= self.min_gain_ratio * chosen.gain else None

    def _was_tried(self, places: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether each candidate (M, 3) is close to a destination that was tried; (M,) bool."""
        if not self._tried:
            return np.zeros(len(places), bool)
        tried = np.concatenate(self._tried)
        distance = np.hypot(*np.moveaxis(places[:, None, :2] - tried[None, :, :2], -1, 0))
        return np.asarray((distance < SAME_PLACE_M).any(axis=1))


def _pose_distance(a: Array, b: Array) -> Array:
    """Distance in m between poses (..., 3), including the weighted difference in heading."""
    offset = a - b
    heading = HEADING_WEIGHT_M_PER_RAD * se2.wrap(offset[..., 2])
    return np.asarray(np.hypot(np.hypot(offset[..., 0], offset[..., 1]), heading))
