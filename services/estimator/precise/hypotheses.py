"""Creates, updates, weighs and drops hypotheses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.estimator.precise.gauss_newton import MAX_STEP, Prior, limit_steps, position_information
from services.estimator.precise.likelihood import Evidence
from services.estimator.precise.motion_model import smooth_velocity

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.motion_model import FusedMotion
    from services.estimator.precise.scan_likelihood import ScanLikelihood
    from services.estimator.precise.swept_scan import Displacement

NEAR_POSITION_M, NEAR_HEADING_RAD = 0.2, math.radians(5)  # a pose with a larger error is wrong
SAME_POSITION_M, SAME_HEADING_RAD = 0.1, 0.1  # of hypotheses nearer to one another, the best is kept
# A scan observes a direction if a step of `PROBE_DISTANCE_M` along it, either way, lowers the log likelihood by more
# than `MIN_LOG_LIKELIHOOD_DROP` nats. Poses within the map's error fit equally well, so `PROBE_MAP_DEVIATIONS` standard
# deviations of it are added to the step (guesses).
MIN_LOG_LIKELIHOOD_DROP, PROBE_DISTANCE_M, PROBE_MAP_DEVIATIONS = math.log(100), 0.1, 2.0
WEAK_PRIOR = np.eye(3)  # 1/m², 1/rad²: keeps the covariance finite along unobserved directions
# Probabilities (guesses): the least that the robot is at none of the hypotheses; and if it is at none, that it is at a
# place that no search of the map finds
UNKNOWN_PROBABILITY, OFF_MAP_PROBABILITY = 1e-5, 0.01
MAX_HYPOTHESES = 8
MIN_WEIGHT = 1e-9  # hypotheses with less weight are dropped
# A hidden Markov model: the surfaces that a key scan shows for the first time are as the map predicts (0), clutter (1),
# or in a room that the map lacks (2). The transitions are from one key scan (row) to the next (column). All of these
# probabilities are guesses, by which clutter lasts two key scans on average, and a room fifty.
SURROUNDINGS_PRIOR = np.array([0.7, 0.3, 0.0])
SURROUNDINGS_TRANSITIONS = np.array([[0.784, 0.214, 0.002], [0.498, 0.5, 0.002], [0.014, 0.006, 0.98]])


@dataclass(frozen=True)
class TrackedHypothesis:
    """One hypothesis about the pose (a mode of the posterior), and the evidence of the present scan."""

    pose: Array  # (3,) base_link in map
    noise_covariance: Array  # (3, 3) caused by scanner noise and motion: fusion of scans reduces it
    model_covariance: Array  # (3, 3) caused by the model's error: fusion does not reduce it
    accuracy: float  # nats, -ln p of the present scan: smaller is better
    complexity: float  # nats, Kullback-Leibler divergence of the posterior from the prior
    xi: Array  # (3,) gradient of ln p by the pose
    curvature: Array  # (3, 3) Gauss-Newton Hessian of -ln p
    explained: float = 0.0  # fraction of the present scan's beams that end at surfaces of the map
    log_evidence: float = 0.0  # nats, of the key scans and the prior; unnormalised
    # nats, of the present scan; in the result of a search absolute, in the estimator relative to `_log_reference`
    scan_log_likelihood: float = 0.0
    surroundings: Array = field(default_factory=lambda: SURROUNDINGS_PRIOR)  # (3,) probabilities at the last key scan
    scan_surroundings: Array = field(default_factory=lambda: SURROUNDINGS_PRIOR)  # (3,) at the present scan
    motion_cost: float = 0.0  # nats, of the motion since the previous scan, see `motion_model.motion_cost`
    motion_complexity: float = 0.0  # nats, see `motion_model.motion_complexity`
    velocity: Array | None = None  # (3,) in base_link; None while unknown
    # (3, 3) covariance of the pose with the scale errors of odometry, as in `MotionCandidate`
    pose_slip_cross_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    weight: float = 1.0
    displacement: Displacement | None = None  # of a swept scan; None if it stands, or was not corrected
    # number of consecutive scans at which neither the map nor the local map showed the motion along some direction
    unobserved_scans: int = 0

    @property
    def log_weight(self) -> float:
        """Unnormalised, in nats."""
        return self.log_evidence + self.scan_log_likelihood

    def covariance(self, inflation: float) -> Array:
        """Covariance (3, 3) of x, y, yaw in map."""
        return np.asarray(inflation * (self.noise_covariance + self.model_covariance))


@dataclass
class UnknownPlace:
    """The hypothesis that the robot is at none of the tracked hypotheses. Evidence in nats, unnormalised as theirs."""

    log_evidence: float = 0.0  # of the key scans and the prior
    # the part of it for places that are not on the map; after a search of the whole map, only this part remains
    log_off_map: float = 0.0
    scan_log_likelihood: float = 0.0  # of the present scan
    weight: float = 1.0  # probability

    def restart(self, probability: float, off_map_probability: float) -> None:
        """Starts with the ``probability`` that the robot is at no hypothesis.

        It contains ``off_map_probability``, that the robot is off the map.
        """
        self.log_evidence, self.log_off_map = float(np.log(probability)), float(np.log(off_map_probability))

    def raise_evidence(self, log_evidence: float) -> None:
        """Raises the evidence to at least this value, after a kidnapping or a match at a wrong place."""
        self.log_evidence = max(self.log_evidence, log_evidence)

    def add_kidnapping_off_map(self, log_kidnapped: float, log_new: float) -> None:
        """Adds the possibility that the robot was carried off the map just before the present scan.

        ``log_kidnapped`` is the evidence that it was carried anywhere. ``log_new`` is the scan's log likelihood off the
        map, where all of its surfaces are new.
        """
        log_off_map = log_kidnapped + float(np.log(OFF_MAP_PROBABILITY)) + log_new - self.scan_log_likelihood
        self.log_off_map = max(self.log_off_map, log_off_map)

    @property
    def log_arrival(self) -> float:
        """Evidence that the robot is at a place of the map from the next key scan on, but was at none before it.

        It was at a place that the search has not found, or it enters the map from a place that is not on it.
        """
        log_enter = self.log_off_map + math.log(SURROUNDINGS_TRANSITIONS[2, 0])
        if self.log_evidence <= self.log_off_map:
            return log_enter
        # The logarithm of exp(log_evidence) - exp(log_off_map)
        log_on_map = self.log_evidence + math.log(-math.expm1(self.log_off_map - self.log_evidence))
        return float(np.logaddexp(log_on_map, log_enter))

    def add_key_scan(self) -> None:
        """Adds the evidence of the present scan, which becomes a key scan."""
        self.log_evidence += self.scan_log_likelihood
        self.log_off_map += self.scan_log_likelihood
        self.scan_log_likelihood = 0.0

    def exclude_mapped_places(self) -> None:
        """Removes the places on the map, after a search of the whole map has made hypotheses of them."""
        self.log_evidence = self.log_off_map


def unobserved_directions(scan: ScanLikelihood, poses: Array, curvatures: Array) -> list[Array]:
    """The unit vectors (K, 3) of x, y, yaw that a scan does not observe at each of the ``poses`` (N, 3).

    ``curvatures`` (N, 3, 3) are those of its accuracy. There are usually none, and one along a corridor: that in which
    the curvature is weakest. If the scan does not show the position across it either, it observes nothing, not even the
    heading. Curvature alone cannot decide this, because it is local: ripples of a learned wall and rounded corners have
    some at every pose. So the scan must be less probable a bit farther along.
    """
    axes = np.array([np.linalg.eigh(position_information(curvature))[1].T for curvature in curvatures])
    weakest, strongest = axes[:, 0], axes[:, 1]
    unobserved = [np.zeros((0, 3))] * len(poses)
    rows = np.flatnonzero(~_are_observed(scan, poses, curvatures, weakest))
    if len(rows):
        across = _are_observed(scan, poses[rows], curvatures[rows], strongest[rows])
        for k, observed in zip(rows, across, strict=True):
            unobserved[k] = np.array([[*weakest[k], 0.0]]) if observed else np.eye(3)
    return unobserved


def _are_observed(scan: ScanLikelihood, poses: Array, curvatures: Array, directions: Array) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the poses whose position along ``directions`` (N, 2) a scan shows, with the best heading there."""
    turns = -np.einsum("ni,ni->n", curvatures[:, 2, :2], directions) / np.maximum(curvatures[:, 2, 2], 1e-12)
    distance = PROBE_DISTANCE_M + PROBE_MAP_DEVIATIONS * scan.map_error
    steps = distance * np.column_stack([directions, turns])
    here = scan.surface_evidence(poses).log_likelihood
    away = scan.surface_evidence(np.concatenate([poses + steps, poses - steps])).log_likelihood
    return np.asarray(here - away.reshape(2, -1).max(axis=0) > MIN_LOG_LIKELIHOOD_DROP)


def project_evidence(evidence: Evidence, unobserved: Array) -> Evidence:
    """The evidence at one pose, set to 0 along the unobserved directions: unit vectors (K, 3) of x, y, yaw."""
    if not len(unobserved):
        return evidence
    projection = np.eye(3) - unobserved.T @ unobserved
    curvature, noise, model = (
        (projection @ matrix[0] @ projection)[None]
        for matrix in (evidence.curvature, evidence.xi_noise_covariance, evidence.xi_model_covariance)
    )
    return Evidence(evidence.accuracy, (projection @ evidence.xi[0])[None], curvature, noise, model)


def hypothesis_from_search(
    pose: Array, evidence: Evidence, prior: Prior | None, volume: float, spread: Array
) -> TrackedHypothesis:
    """A hypothesis found by a search: one more step from ``pose`` (3,), where the scan has this ``evidence``.

    The ``prior`` is that of this hypothesis alone. Without one, all poses in ``volume`` m² rad were equally likely, and
    ``spread`` (3, 3), the covariance of an unknown pose, remains along the directions in which the evidence is zero.
    """
    information = prior.information[0] if prior else np.linalg.inv(spread)
    inverse = np.linalg.inv(evidence.curvature[0] + information)
    slope = evidence.xi[0] + (information @ se2.difference(prior.mean[0], pose) if prior else 0)
    pose = pose + limit_steps(inverse @ slope, MAX_STEP)
    pose[2] = se2.wrap(pose[2])
    logdet = float(np.linalg.slogdet(evidence.curvature[0] + information)[1])
    if prior:
        off = se2.difference(pose, prior.mean[0])
        complexity = 0.5 * float(np.trace(information @ inverse) - 3 + off @ information @ off + logdet)
        complexity -= 0.5 * float(np.linalg.slogdet(information)[1])
    else:
        complexity = float(np.log(volume)) + 0.5 * (logdet - 3 * np.log(2 * np.pi * np.e))
    return TrackedHypothesis(
        pose=pose,
        noise_covariance=inverse @ (evidence.xi_noise_covariance[0] + information) @ inverse,
        model_covariance=inverse @ evidence.xi_model_covariance[0] @ inverse,
        accuracy=float(evidence.accuracy[0]),
        complexity=complexity,
        xi=evidence.xi[0],
        curvature=evidence.curvature[0],
        log_evidence=0.0 if prior else float(_log_volume_of_place(evidence.curvature[0]) - np.log(volume)),
    )


def _log_volume_of_place(curvature: Array) -> float:
    """Logarithm of the volume in m² rad of the poses that fit a scan with this ``curvature`` (3, 3) at one place.

    Poses that are farther away belong to other hypotheses.
    """
    place = np.diag([SAME_POSITION_M**-2, SAME_POSITION_M**-2, SAME_HEADING_RAD**-2])
    return float(1.5 * np.log(2 * np.pi) - 0.5 * float(np.linalg.slogdet(curvature + place)[1]))


def update_hypothesis(
    hypothesis: TrackedHypothesis, fused: FusedMotion, evidence: Evidence, period: float, *, unobserved: bool
) -> TrackedHypothesis:
    """The hypothesis after a scan, from its motion fused with the scan, and from the evidence at its pose.

    The scan's information reduces the noise covariance. The model's errors are alike from scan to scan, so their
    standard deviations are averaged instead of their variances, weighted by each scan's information. ``unobserved`` is
    true if neither the scan nor the local map shows the motion along some direction. The scale errors of odometry are
    not estimated, but their covariance with the pose shrinks.
    """
    inverse = np.linalg.inv(fused.information)
    prior_information = fused.information - evidence.curvature[0]
    inverse_of_scan = np.linalg.inv(evidence.curvature[0] + WEAK_PRIOR)
    deviation_before = _root(hypothesis.model_covariance)
    scan_deviation = _root(inverse_of_scan @ evidence.xi_model_covariance[0] @ inverse_of_scan)
    model_deviation = deviation_before + inverse @ evidence.curvature[0] @ (scan_deviation - deviation_before)
    # A velocity is dropped unless it was observed in every direction, at this scan and the one before.
    velocity = None
    if not unobserved and not hypothesis.unobserved_scans:
        velocity = smooth_velocity(hypothesis.velocity, se2.between(hypothesis.pose, fused.mean) / period, period)
    return TrackedHypothesis(
        pose=fused.mean,
        noise_covariance=inverse @ (evidence.xi_noise_covariance[0] + prior_information) @ inverse,
        model_covariance=model_deviation @ model_deviation.T,
        accuracy=float(evidence.accuracy[0]),
        complexity=fused.complexity,
        xi=evidence.xi[0],
        curvature=evidence.curvature[0],
        log_evidence=hypothesis.log_evidence,
        surroundings=hypothesis.surroundings,
        velocity=velocity,
        pose_slip_cross_covariance=inverse @ prior_information @ fused.candidate.pose_slip_cross_covariance,
        unobserved_scans=hypothesis.unobserved_scans + 1 if unobserved else 0,
    )


def _root(covariance: Array) -> Array:
    """Symmetric square root of a covariance (3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def clip_to_map(
    hypotheses: list[TrackedHypothesis], bounds: tuple[float, float, float, float]
) -> list[TrackedHypothesis]:
    """The hypotheses with their positions clipped to the map's bounds x0, y0, x1, y1 (m)."""
    x0, y0, x1, y1 = bounds
    low, high = np.array([x0, y0, -np.inf]), np.array([x1, y1, np.inf])
    return [replace(each, pose=np.clip(each.pose, low, high)) for each in hypotheses]


def same_place(poses: Array, pose: Array) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the poses (N, 3) so near to ``pose`` (3,) that they are the same hypothesis."""
    off = np.abs(se2.difference(poses, pose))
    return np.asarray((off[:, :2] < SAME_POSITION_M).all(axis=1) & (off[:, 2] < SAME_HEADING_RAD))


def select_best(poses: Array, log_weights: Array, count: int) -> list[int]:
    """Indices of up to ``count`` poses with the largest weights, best first, no two at the same place."""
    kept: list[int] = []
    for k in np.argsort(-log_weights, kind="stable"):
        if not same_place(poses[kept], poses[k]).any():
            kept.append(int(k))
        if len(kept) == count:
            break
    return kept


def weigh(hypotheses: list[TrackedHypothesis], log_unknown: float) -> tuple[list[TrackedHypothesis], float]:
    """Normalises the weights of the best hypothesis at each place, and drops those of negligible weight.

    Returns up to `MAX_HYPOTHESES` hypotheses, best first, whose weights sum to 1, and the probability that the robot is
    at none of them. ``log_unknown`` is its unnormalised log weight.
    """
    logs = np.array([each.log_weight for each in hypotheses])
    best = select_best(np.array([each.pose for each in hypotheses]), logs, MAX_HYPOTHESES)
    log_known = np.logaddexp.reduce(logs[best])
    weights = np.exp(logs[best] - log_known)
    kept = weights > MIN_WEIGHT
    weights /= weights[kept].sum()
    weighted = [replace(hypotheses[k], weight=float(w)) for k, w, keep in zip(best, weights, kept, strict=True) if keep]
    return weighted, float(np.exp(log_unknown - np.logaddexp(log_known, log_unknown)))


def probability_of_being_near(covariance: Array) -> float:
    """Probability that a pose with ``covariance`` (3, 3) is within 0.2 m and 5 degrees of the truth; never too high."""
    variance = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    position = 1 - math.exp(-0.5 * NEAR_POSITION_M**2 / max(variance, 1e-12))
    heading = math.erf(NEAR_HEADING_RAD / math.sqrt(2 * max(float(covariance[2, 2]), 1e-12)))
    return position * heading
