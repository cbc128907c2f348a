"""Global and local search: descent from many starts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.gauss_newton import COARSE_SIGMA_M, MEDIUM_SIGMA_M, TRACKING_SCHEDULE_M, Prior
from services.estimator.precise.hypotheses import (
    MAX_HYPOTHESES,
    TrackedHypothesis,
    hypothesis_from_search,
    project_evidence,
    select_best,
    unobserved_directions,
)
from services.estimator.precise.scan_likelihood import ScanLikelihood

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.precise.likelihood import Evidence

RANKED_SEEDS = 300  # seeds at which the evidence by surfaces is computed
SEARCH_STARTS = 48  # the best of them, from which a search of the whole map descends
SEARCH_BEAMS = 100  # or more, used by these descents
SEARCH_RESULTS = 12  # of a search's first descents: the best, from which it descends with all beams
NEAR_STARTS = 48  # poses from which a search near a given pose descends
SEED_EVIDENCE_BEAMS = 75  # or more, for the evidence at the ranked poses
# Typical error of a range there, added in quadrature to every beam's deviation. Of the values tried, 0.05 to 0.15 m,
# this keeps most true poses among moved furniture.
SEED_SIGMA_M = 0.1
# Added in the same way, at each step of a descent: from a seed, where larger deviations would match moved furniture to
# the map's, and from a pose that may be half a metre off
SEED_SCHEDULE_M = (MEDIUM_SIGMA_M, MEDIUM_SIGMA_M, 0.05, 0.05)
NEAR_SCHEDULE_M = (COARSE_SIGMA_M, COARSE_SIGMA_M, MEDIUM_SIGMA_M, MEDIUM_SIGMA_M)


def search_everywhere(likelihoods: list[ScanLikelihood], seeds: Seeds) -> list[TrackedHypothesis]:
    """Returns the hypotheses that fit best in the whole map, best first.

    ``likelihoods`` are those of the same scan with different errors of the map. Ranks the seeds by their panoramas, and
    the best by their evidence by surfaces. Descends from the best of these with few beams, and from the best results
    with all beams, once for each of the likelihoods.
    """
    scan = likelihoods[0]
    starts = seeds.rank(scan, RANKED_SEEDS)
    fit = scan.thinned(SEED_EVIDENCE_BEAMS).surface_evidence(starts, SEED_SIGMA_M).log_likelihood
    starts = starts[np.argsort(-fit, kind="stable")[:SEARCH_STARTS]]
    few = scan.thinned(SEARCH_BEAMS)
    poses, _ = few.descend(starts, None, SEED_SCHEDULE_M)
    fit = few.surface_evidence(poses, SEED_SCHEDULE_M[-1]).log_likelihood
    starts = poses[select_best(poses, fit, SEARCH_RESULTS)]
    return _best_first([_best_hypotheses(each, *each.descend(starts), None, seeds) for each in likelihoods])


def search_near(
    likelihoods: list[ScanLikelihood],
    pose: Array,
    covariance: Array,
    seeds: Seeds,
    rng: np.random.Generator,
) -> list[TrackedHypothesis]:
    """Returns the hypotheses that fit best near ``pose`` (3,), which is known within ``covariance`` (3, 3).

    ``likelihoods`` are those of the same scan with different errors of the map.
    """
    starts = rng.multivariate_normal(pose, covariance, NEAR_STARTS)
    starts[0] = pose
    prior = Prior.repeated(len(starts), pose, covariance)
    # A sigma larger than the spread of the starts would merge all minima into one, perhaps a wrong one.
    largest = max(MEDIUM_SIGMA_M, _range_deviation(likelihoods[0], covariance))
    schedule = tuple(min(each, largest) for each in NEAR_SCHEDULE_M)
    poses, _ = likelihoods[0].descend(starts, prior, schedule)
    fit = likelihoods[0].surface_evidence(poses, schedule[-1]).log_likelihood - prior.energy(poses)
    starts = poses[select_best(poses, fit, SEARCH_RESULTS)]
    prior = Prior.repeated(len(starts), pose, covariance)
    return _best_first([_best_hypotheses(each, *each.descend(starts, prior), prior, seeds) for each in likelihoods])


def _range_deviation(scan: ScanLikelihood, covariance: Array) -> float:
    """Standard deviation in m of the ranges that are expected from a pose with ``covariance`` (3, 3)."""
    position = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    typical_range = np.median(scan.ranges[scan.returned]) if scan.returned.any() else 0.0
    return float(np.hypot(position, np.sqrt(covariance[2, 2]) * typical_range))


def search_around(scan: ScanLikelihood, starts: Array, prior: Prior, extra_starts: Array) -> tuple[Array, Evidence]:
    """Descends from ``starts`` (N, 3), one per hypothesis, over a wider area than usual.

    The first hypothesis also descends from ``extra_starts`` (K, 3). Returns one pose (N, 3) per hypothesis, of those
    found for the first the one with the most evidence by surfaces, and the evidence there.
    """
    count = len(starts)
    hypothesis = np.concatenate([np.arange(count), np.zeros(len(extra_starts), np.int64)])
    starts = np.concatenate([starts, extra_starts])
    repeated_prior = Prior(prior.mean[hypothesis], prior.information[hypothesis])
    poses, evidence = scan.descend(starts, repeated_prior, (*NEAR_SCHEDULE_M, *TRACKING_SCHEDULE_M))
    of_first = np.flatnonzero(hypothesis == 0)
    log_likelihood = scan.surface_evidence(poses).log_likelihood
    best = of_first[np.argmax((log_likelihood - repeated_prior.energy(poses))[of_first])]
    keep = np.array([best, *range(1, count)])
    return poses[keep], evidence.part(keep)


def _best_hypotheses(
    scan: ScanLikelihood, poses: Array, evidence: Evidence, prior: Prior | None, seeds: Seeds
) -> list[TrackedHypothesis]:
    """The hypotheses with most evidence by surfaces among ``poses`` (N, 3), best first."""
    surface_evidence = scan.surface_evidence(poses)
    log_likelihood = surface_evidence.without(scan.surfaces.small)
    log_pose_prior = -prior.energy(poses) if prior else np.zeros(len(poses))
    hypotheses, kept = [], select_best(poses, log_likelihood + log_pose_prior, MAX_HYPOTHESES)
    for k, unobserved in zip(kept, unobserved_directions(scan, poses[kept], evidence.curvature[kept]), strict=True):
        observed, prior_at = project_evidence(evidence.at(k), unobserved), prior.at(k) if prior else None
        hypothesis = hypothesis_from_search(poses[k], observed, prior_at, seeds.volume, seeds.spread)
        hypotheses.append(
            replace(
                hypothesis,
                explained=float(surface_evidence.explained[k]),
                log_evidence=scan.log_map_error_prior + hypothesis.log_evidence + float(log_pose_prior[k]),
                scan_log_likelihood=float(log_likelihood[k]),
            )
        )
    return hypotheses


def _best_first(found: list[list[TrackedHypothesis]]) -> list[TrackedHypothesis]:
    return sorted((each for hypotheses in found for each in hypotheses), key=lambda each: -each.log_weight)
