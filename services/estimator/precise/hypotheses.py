"""Creates, moves, merges, weighs and drops hypotheses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.estimator.precise.gauss_newton import MAX_STEP, Prior, difference, limit_steps, position_information
from services.estimator.precise.motion_model import smooth_velocity

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.motion_model import Fused
    from services.estimator.precise.settings import Settings

SAME_POSITION_M, SAME_HEADING_RAD = 0.1, 0.1  # hypotheses nearer to one another than this are merged
ENERGY_MEMORY = 0.8  # weight of earlier scans: the model's error repeats, so evidence must not add up without limit
# A direction counts as unobserved if its information is less than this share of the information across it; a learned
# field adds a multiple of its squared ripple to the share.
MIN_INFORMATION_RATIO, RIPPLE_FACTOR = 1e-4, 7.0
MIN_RIVAL_SCANS = 10  # age in scans at which a rival with a good inlier ratio may replace the tracked hypothesis
MIN_WEIGHT = 1e-4  # hypotheses with less weight are dropped


@dataclass(frozen=True)
class Mode:
    """One hypothesis about the pose (a mode of the posterior), and the evidence of the last scan."""

    pose: Array  # (3,) base_link in map
    noise_covariance: Array  # (3, 3) caused by scanner noise and motion: fusion of scans reduces it
    model_covariance: Array  # (3, 3) caused by the model's error, for independent beams: fusion does not reduce it
    inlier_ratio: float  # of the last scan
    accuracy: float  # nats, of the last scan
    complexity: float  # nats
    energy: float  # nats, F averaged over the last scans, from which weights are computed
    xi: Array  # (3,)
    curvature: Array  # (3, 3)
    velocity: Array | None = None  # (3,) in base_link; None while unknown
    weight: float = 1.0
    unobserved_scans: int = 0  # number of consecutive scans without information along some direction
    age: int = 0  # scans since it was found
    tracked: bool = False  # tracking was reported here, or the robot was started here, and no rival has replaced it

    def covariance(self, inflation: float) -> Array:
        """Covariance (3, 3) of x, y, yaw in map."""
        return np.asarray(inflation * (self.noise_covariance + self.model_covariance))


def observed_directions(curvature: Array, ripple: float) -> tuple[Array, Array | None]:
    """Returns a projection (3, 3) onto what a scan observes, and the direction (2,) it does not observe, if any.

    In a corridor without features a learned field still has ripples: walls tilted by about ``ripple`` rad, which add
    along the corridor about ripple² of the curvature across it. Information that does not clearly exceed this counts
    as none.
    """
    values, vectors = np.linalg.eigh(position_information(curvature))
    if values[0] >= (MIN_INFORMATION_RATIO + RIPPLE_FACTOR * ripple**2) * values[1] and values[1] > 0:
        return np.eye(3), None
    projection, unobserved = np.eye(3), vectors[:, 0]
    projection[:2, :2] -= np.outer(unobserved, unobserved)
    return projection, unobserved


def project_evidence(evidence: Evidence, k: int, projection: Array) -> None:
    """Applies a projection from `observed_directions` to the k-th evidence, in place."""
    evidence.xi[k] = projection @ evidence.xi[k]
    for matrix in (evidence.curvature, evidence.xi_noise_covariance, evidence.xi_model_covariance):
        matrix[k] = projection @ matrix[k] @ projection


def mode_from_search(
    pose: Array, evidence: Evidence, k: int, prior: Prior | None, volume: float, unknown: Array, ripple: float
) -> Mode:
    """A hypothesis found by a search, from the k-th evidence at ``pose`` (3,).

    Without a prior every pose in ``volume`` m² rad was equally likely, and complexity is the Kullback-Leibler
    divergence from that. ``unknown`` (3, 3), the covariance of an unknown pose, remains along unobserved directions.
    """
    projection, _ = observed_directions(evidence.curvature[k], ripple)
    project_evidence(evidence, k, projection)
    information = prior.information[k] if prior else np.linalg.inv(unknown)
    inverse = np.linalg.inv(evidence.curvature[k] + information)
    slope = evidence.xi[k] + (prior.information[k] @ difference(prior.mean[k : k + 1], pose[None])[0] if prior else 0)
    pose = pose + limit_steps(inverse @ slope, MAX_STEP)
    pose[2] = se2.wrap(pose[2])
    accuracy = float(evidence.accuracy[k])
    logdet = float(np.linalg.slogdet(evidence.curvature[k] + information)[1])
    if prior:
        off = difference(pose[None], prior.mean[k : k + 1])[0]
        complexity = 0.5 * float(np.trace(information @ inverse) - 3 + off @ information @ off + logdet)
        complexity -= 0.5 * float(np.linalg.slogdet(information)[1])
    else:
        complexity = float(np.log(volume)) + 0.5 * (logdet - 3 * np.log(2 * np.pi * np.e))
    return Mode(
        pose=pose,
        noise_covariance=inverse @ (evidence.xi_noise_covariance[k] + information) @ inverse,
        model_covariance=inverse @ evidence.xi_model_covariance[k] @ inverse,
        inlier_ratio=float(evidence.inlier_ratio[k]),
        accuracy=accuracy,
        complexity=complexity,
        energy=accuracy + complexity,
        xi=evidence.xi[k],
        curvature=evidence.curvature[k],
    )


def update_mode(mode: Mode, fused: Fused, evidence: Evidence, k: int, period: float, *, unobserved: bool) -> Mode:
    """The hypothesis after a scan, from its fused prior and the k-th evidence.

    The scan's information reduces the noise covariance; the model covariance is that of this scan alone. ``unobserved``
    is true if the scan has no information along some direction.
    """
    inverse = np.linalg.inv(fused.information)
    information = fused.information - evidence.curvature[k]
    inverse_of_scan = np.linalg.inv(evidence.curvature[k] + np.eye(3))
    accuracy = float(evidence.accuracy[k])
    # A velocity that is not observed in every direction is not carried on.
    velocity = None
    if not unobserved and not mode.unobserved_scans:
        velocity = smooth_velocity(mode.velocity, se2.between(mode.pose, fused.mean) / period, period)
    return Mode(
        pose=fused.mean,
        noise_covariance=inverse @ (evidence.xi_noise_covariance[k] + information) @ inverse,
        model_covariance=inverse_of_scan @ evidence.xi_model_covariance[k] @ inverse_of_scan,
        inlier_ratio=float(evidence.inlier_ratio[k]),
        accuracy=accuracy,
        complexity=fused.complexity,
        energy=ENERGY_MEMORY * mode.energy + (1 - ENERGY_MEMORY) * (accuracy + fused.complexity),
        xi=evidence.xi[k],
        curvature=evidence.curvature[k],
        velocity=velocity,
        unobserved_scans=mode.unobserved_scans + 1 if unobserved else 0,
        age=mode.age + 1,
        tracked=mode.tracked,
    )


def clip_to_map(modes: list[Mode], bounds: tuple[float, float, float, float]) -> list[Mode]:
    """The hypotheses with their positions clipped to the map's bounds x0, y0, x1, y1 (m)."""
    x0, y0, x1, y1 = bounds
    low, high = np.array([x0, y0, -np.inf]), np.array([x1, y1, np.inf])
    return [replace(mode, pose=np.clip(mode.pose, low, high)) for mode in modes]


def same_place(poses: Array, pose: Array) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the poses (N, 3) that are so near to ``pose`` (3,) that both are one hypothesis."""
    off = np.abs(difference(poses, pose))
    return np.asarray((off[:, :2] < SAME_POSITION_M).all(axis=1) & (off[:, 2] < SAME_HEADING_RAD))


def select_distinct(poses: Array, energy: Array, count: int) -> list[int]:
    """Indices of up to ``count`` poses with the least energy, no two at the same place."""
    kept: list[int] = []
    for k in np.argsort(energy, kind="stable"):
        if not same_place(poses[kept], poses[k]).any():
            kept.append(int(k))
        if len(kept) == count:
            break
    return kept


def weigh(modes: list[Mode], evidence_error: float, count: int) -> list[Mode]:
    """Merges hypotheses, weighs them by energy, sorts them best first, and drops those of negligible weight.

    Differences in F between places are known only up to the model's error, a few beams of about 9 nats each: up to
    ``evidence_error`` nats. A tracked hypothesis stays first; `rank_hypotheses` decides when another replaces it.
    """
    energy = np.array([mode.energy for mode in modes])
    tracked = next((k for k, mode in enumerate(modes) if mode.tracked), None)
    if tracked is not None:
        energy = np.maximum(energy, energy[tracked])
        energy[tracked] = np.nextafter(energy[tracked], -np.inf)
    kept = select_distinct(np.array([mode.pose for mode in modes]), energy, count)
    ordered = [modes[k] for k in kept]
    weights = np.exp(-(energy[kept] - energy[kept[0]]) / evidence_error)
    weights /= weights.sum()
    return [
        replace(mode, weight=float(weight / weights[weights > MIN_WEIGHT].sum()))
        for mode, weight in zip(ordered, weights, strict=True)
        if weight > MIN_WEIGHT
    ]


def rank_hypotheses(modes: list[Mode], settings: Settings) -> list[Mode]:
    """Sorts hypotheses by weight, but keeps the tracked one first until a rival has better evidence for long enough."""
    tracked = next((mode for mode in modes if mode.tracked), None)
    if tracked is not None and any(_replaces_tracked(mode, tracked, settings) for mode in modes):
        modes = [replace(mode, tracked=False) for mode in modes]
    return weigh(modes, settings.evidence_error_nats, settings.max_hypotheses)


def _replaces_tracked(rival: Mode, tracked: Mode, settings: Settings) -> bool:
    """Whether the robot was carried to the rival's pose, as opposed to a change of its surroundings.

    One scan of a changed place may fit another place better by hundreds of nats; scans from several poses do not.
    """
    is_good = rival.inlier_ratio >= settings.good_inlier_ratio
    scans_needed = MIN_RIVAL_SCANS if is_good else settings.rival_probation_scans
    proven = rival.age >= scans_needed or rival.inlier_ratio >= settings.conclusive_inlier_ratio
    return proven and rival.energy < tracked.energy - 3 * settings.evidence_error_nats
