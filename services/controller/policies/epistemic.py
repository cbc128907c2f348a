"""Expected information gain of a motion between hypotheses.

Expected free energy of a motion = its cost - its epistemic value (Friston et al. 2015, "Active inference and epistemic
value"); the epistemic value is the mutual information of hypothesis and next scan. It has no closed form for a mixture;
the pairwise bound of Kolchinsky & Tracey 2017 ("Estimating mixture entropy with pairwise distances") with the
Bhattacharyya distance is never above it:

    I(k; o) >= -sum_i w_i ln sum_j w_j BC_ij,    BC_ij = integral sqrt(p_i p_j) do

It is 0 where the predicted scans are equal, and the entropy of the weights where they differ clearly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

TIE = 1e-9  # nats, expected free energies closer than this are one
LEAST = 1e-6  # a beam's likeness below it is that: fifty of them multiplied are still a number
SAME = 0.5  # m: a hypothesis does not move further between two beliefs, and nearer destinations are one
HEADING = 0.5  # m a radian counts for where two poses are compared
REMEMBERED = 20  # destinations that told nothing


@dataclass(frozen=True)
class Doubt:
    """How little predicted scans are trusted to tell places apart.

    A beam is an outlier with probability ``outliers``, any range is as likely then: p(o) = (1 - e) N(o; r, s²) + e / R.
    Outliers hang together: a person, or an edge predicted a little beside where it is, spoils a sector of the scan and
    not a beam. So B beams count as ``sectors`` independent ones at most: with the defaults, of the 0.69 nats between
    two places alike, 3 beams of 61 that differ clearly tell 0.2, a sector of 8 tells 0.4, 20 beams 0.65.
    """

    outliers: float = 0.25  # as many as the estimator's likelihood expects to end early
    blur: float = 0.05  # m, added to sigma in quadrature: the robot arrives a little beside the place
    sectors: int = 8


def candidate_poses(hypotheses: Array, displacements: Array) -> Array:
    """(K, M, 3) base_link in map after the same motion from each of the hypotheses (K, 3).

    ``displacements`` (M, 3) m, m, rad are destinations in base_link of the first hypothesis, and so of any: the robot
    moves relative to itself, wherever it is.
    """
    hypotheses, displacements = (np.asarray(a, float).reshape(-1, 3) for a in (hypotheses, displacements))
    return se2.compose(hypotheses[:, None, :], displacements[None, :, :])


def entropy(weights: Array) -> float:
    """Nats, of weights (K,) that need not sum to 1."""
    w = np.asarray(weights, float) / np.sum(weights)
    return float(-np.sum(w * np.log(np.where(w > 0, w, 1.0))))


def information_gain(
    weights: Array, ranges: Array, sigma: Array, range_max: float, doubt: Doubt | None = None
) -> Array:
    """(M,) nats by which one scan after each of M motions lowers the entropy of K hypotheses at least, in expectation.

    ``weights`` (K,) of the hypotheses; ``ranges`` (K, M, B) m predicted for them after the motions, +inf no return;
    ``sigma`` (K, M, B) m stated. Between 0 and the entropy of the weights. It is at least 0.8 of the mutual information
    where beams differ by three deviations (of 0.05 m), less where they differ by less: below one they count as alike.

    For independent beams BC is a product. A beam's is bounded from above, so that the gain stays a lower bound
    (sqrt(a + b) <= sqrt(a) + sqrt(b); the log of the ratio of the deviations is left out, for two models that are
    unsure to different degrees predict no different world):

        BC_b <= (1 - e) exp(-(r_i - r_j)² / (4 (s_i² + s_j²))) + e + sqrt(e (1 - e) / R) sum_k (8 pi s_k²)^(1/4)
    """
    doubt = doubt or Doubt()
    w = np.asarray(weights, float) / np.sum(weights)
    r = np.clip(np.asarray(ranges, float), 0.0, range_max)
    variance = np.asarray(sigma, float) ** 2 + doubt.blur**2
    e = doubt.outliers
    tail = e / 2 + np.sqrt(e * (1 - e) / range_max) * (8 * np.pi * variance) ** 0.25
    share = min(1.0, doubt.sectors / max(r.shape[2], 1))
    likeness = np.ones((len(w), len(w), r.shape[1]))  # BC of whole scans
    for i in range(len(w)):
        for j in range(i):
            core = np.exp(-((r[i] - r[j]) ** 2) / (4 * (variance[i] + variance[j])))
            beams = np.clip((1 - e) * core + tail[i] + tail[j], LEAST, 1.0)
            likeness[i, j] = likeness[j, i] = np.exp(share * _log_product(beams))
    mixed = np.einsum("j,ijm->im", w, likeness)
    gain = -np.einsum("i,im->m", w, np.log(np.where(w[:, None] > 0, mixed, 1.0)))
    return np.asarray(np.clip(gain, 0.0, entropy(w))) + 0.0  # no minus zero


def _log_product(factors: Array) -> Array:
    """(M,) ln of the products over beams of (M, B), each at least LEAST; a logarithm for every fifty is quicker."""
    if not factors.shape[1]:
        return np.zeros(len(factors))
    parts = np.multiply.reduceat(factors, np.arange(0, factors.shape[1], 50), axis=1)
    return np.asarray(np.log(parts).sum(axis=1))


def expected_free_energy(gain: Array, length: Array, nats_per_metre: float) -> Array:
    """(M,) nats: cost less epistemic value, of motions that gain (M,) nats and are ``length`` (M,) m long.

    ``nats_per_metre`` is the preference for short ways in units of knowledge. +inf where there is no way (length +inf).
    """
    length, gain = np.asarray(length, float), np.asarray(gain, float)
    there = np.isfinite(length)
    return np.where(there, nats_per_metre * np.where(there, length, 0.0) - gain, np.inf)


def best(energy: Array, length: Array) -> int | None:
    """Index of the least expected free energy (M,); of equals the shortest way, then the first. None: no way at all."""
    energy, length = np.asarray(energy, float), np.asarray(length, float)
    if not np.isfinite(energy).any():
        return None
    equal = np.flatnonzero(energy <= energy.min() + TIE)
    return int(equal[np.argmin(length[equal])])


@dataclass(frozen=True)
class Options:
    """What can be done, as of one belief; the first hypothesis is the best."""

    hypotheses: Array  # (K, 3) base_link in map
    weights: Array  # (K,)
    displacements: Array  # (M, 3) destinations in base_link of the first hypothesis
    lengths: Array  # (M,) m to drive there; +inf: no way

    def poses(self) -> Array:
        """(K * M, 3) in map to ask predictions of, hypothesis after hypothesis; at least one of each."""
        return candidate_poses(self.hypotheses, self.displacements).reshape(-1, 3)


@dataclass(frozen=True)
class Choice:
    """A destination that was chosen."""

    anchors: Array  # (K, 3) the hypotheses, as last seen
    places: Array  # (K, 3) in map: the destination under each of them
    gain: float  # nats expected there when it was chosen
    stamp_ns: int  # when


@dataclass
class Explorer:
    """Keeps to a destination until it is reached, the deadline has passed, or it is no longer worth it.

    It is asked in two steps: `choose` when predictions have come, `follow` at every belief. Two hypotheses of equal
    weight take turns in being the best; the destination moves with the first one, for relative to the robot it is the
    same. A destination that was reached, or not reached in time, and left the hypotheses standing is not chosen again.
    """

    nats_per_metre: float = 0.02  # 10 m of driving for a fifth of a nat
    least: float = 0.05  # nats, for less nobody moves
    margin: float = 0.1  # nats of expected free energy by which another destination must be better
    fell: float = 0.5  # share of the gain at the choice below which it is given up
    reach: float = 0.4  # m
    patience: float = 20.0  # s
    doubt: Doubt = field(default_factory=Doubt)

    def __post_init__(self) -> None:
        """Nothing chosen, nothing tried."""
        self.choice: Choice | None = None
        self._tried: list[Array] = []  # (K, 3) each

    def forget(self) -> None:
        """The place is known, or the goal has changed: begin anew the next time."""
        self.__post_init__()

    def choose(self, stamp_ns: int, options: Options, ranges: Array, sigma: Array, range_max: float) -> Array | None:
        """The destination (3,) in map under the options' first hypothesis; None where no way is worth it.

        ``ranges``, ``sigma`` (K, M, B) m are predicted for `Options.poses`. One that was chosen before is kept where no
        other is better by ``margin``, unless its gain fell.
        """
        gain = information_gain(options.weights, ranges, sigma, range_max, self.doubt)
        places = candidate_poses(options.hypotheses, options.displacements)  # (K, M, 3)
        energy = expected_free_energy(gain, options.lengths, self.nats_per_metre)
        energy = np.where(gain < self.least, np.inf, energy)
        fresh = np.where(self._told_nothing(places[0]), np.inf, energy)
        if not np.isfinite(fresh).any():  # all that is left was tried: perhaps somebody stood there
            self._tried, fresh = [], energy
        index, kept = best(fresh, options.lengths), self._kept(places[0], gain, options)
        if kept is not None and (index is None or fresh[index] > energy[kept] - self.margin):
            return self.follow(stamp_ns, options.hypotheses, options.weights)
        self.choice = None
        if index is None:
            return None
        anchors = np.array(options.hypotheses, float)
        self.choice = Choice(anchors, places[:, index], float(gain[index]), stamp_ns)
        return np.array(places[0, index])

    def follow(self, stamp_ns: int, hypotheses: Array, weights: Array) -> Array | None:
        """The destination (3,) in map under the first of the hypotheses (K, 3) now; None: none is kept, choose anew."""
        choice, hypotheses = self.choice, np.asarray(hypotheses, float).reshape(-1, 3)
        if choice is None:
            return None
        late = stamp_ns - choice.stamp_ns > self.patience * 1e9
        off = _apart(choice.anchors[:, None, :], hypotheses[None, :, :])  # (anchors, hypotheses)
        own = int(off[:, 0].argmin())
        began_anew = stamp_ns < choice.stamp_ns  # the simulation
        if late or began_anew or off[own, 0] > SAME or entropy(weights) < self.fell * choice.gain:
            self._give_up(tried=late)
            return None
        near = off.min(axis=1) < SAME
        moved = np.where(near[:, None], hypotheses[off.argmin(axis=1)], choice.anchors)
        self.choice = replace(choice, anchors=moved)
        if np.hypot(*(choice.places[own] - hypotheses[0])[:2]) < self.reach:
            self._give_up(tried=True)
            return None
        return np.array(choice.places[own])

    def displacement(self, hypothesis: Array) -> Array | None:
        """(3,) the destination kept, in base_link of the first hypothesis (3,): a candidate for the next `choose`."""
        if self.choice is None:
            return None
        own = int(_apart(self.choice.anchors, hypothesis).argmin())
        return se2.between(hypothesis, self.choice.places[own])

    def _give_up(self, *, tried: bool) -> None:
        if tried and self.choice is not None:
            self._tried = [*self._tried, self.choice.places][-REMEMBERED:]
        self.choice = None

    def _kept(self, places: Array, gain: Array, options: Options) -> int | None:
        """The candidate (M, 3) that stands for the destination kept, where that still gains about what it did."""
        now = self.choice
        if now is None or not len(places):
            return None
        own = int(_apart(now.anchors, np.asarray(options.hypotheses, float)[0]).argmin())
        off = np.hypot(*(places - now.places[own])[:, :2].T)
        nearest = int(off.argmin())
        alive = off[nearest] < SAME and np.isfinite(options.lengths[nearest])
        return nearest if alive and gain[nearest] >= self.fell * now.gain else None

    def _told_nothing(self, places: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(M,) whether a candidate (M, 3) was gone to in vain."""
        if not self._tried:
            return np.zeros(len(places), bool)
        tried = np.concatenate(self._tried)
        off = np.hypot(*np.moveaxis(places[:, None, :2] - tried[None, :, :2], -1, 0))
        return np.asarray((off < SAME).any(axis=1))


def _apart(a: Array, b: Array) -> Array:
    """M between poses (..., 3), a difference of heading counted in."""
    off = a - b
    return np.asarray(np.hypot(np.hypot(off[..., 0], off[..., 1]), HEADING * se2.wrap(off[..., 2])))
