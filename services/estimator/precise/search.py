"""Global and local search: descent from many starts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.gauss_newton import (
    ANNEALING_SCHEDULE_M,
    COARSE_SIGMA_M,
    FINE_SIGMA_M,
    FOLLOWING_SCHEDULE_M,
    MEDIUM_SIGMA_M,
    Prior,
    View,
    follow,
)
from services.estimator.precise.hypotheses import Mode, mode_from_search, select_distinct

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.settings import Settings


# Added in quadrature to every beam's standard deviation, step by step, from poses that may be half a metre off.
NEAR_SCHEDULE_M = (COARSE_SIGMA_M, COARSE_SIGMA_M, MEDIUM_SIGMA_M, MEDIUM_SIGMA_M, *FOLLOWING_SCHEDULE_M)


def search_everywhere(view: View, seeds: Seeds, settings: Settings, *, thorough: bool) -> list[Mode]:
    """Returns the hypotheses that fit best in the whole map, best first.

    If the first round explains too little and ``thorough`` is set, a second round descends from more seeds.
    """
    modes: list[Mode] = []
    for count in (settings.search_seeds, *([settings.thorough_search_seeds] if thorough else [])):
        modes = _refine(view, seeds.rank(view, count), seeds, settings)
        if modes[0].explained >= settings.conclusive_share:
            break
    return modes


def search_near(
    view: View, pose: Array, covariance: Array, seeds: Seeds, settings: Settings, rng: np.random.Generator
) -> list[Mode]:
    """Returns the hypotheses that fit best near ``pose`` (3,), which is known within ``covariance`` (3, 3)."""
    starts = rng.multivariate_normal(pose, covariance, settings.search_seeds)
    starts[0] = pose
    prior = Prior.repeated(len(starts), pose, covariance)
    poses, evidence = follow(view, starts, prior, NEAR_SCHEDULE_M)
    return _best_modes(view, poses, evidence, prior, seeds, settings)


def search_around(view: View, starts: Array, prior: Prior, extra_starts: Array) -> tuple[Array, Evidence]:
    """Descends from ``starts`` (N, 3), one per hypothesis, over a wider area than `polish`.

    The first hypothesis also descends from ``extra_starts`` (K, 3). Returns one pose (N, 3) per hypothesis and the
    evidence there.
    """
    count = len(starts)
    hypothesis = np.concatenate([np.arange(count), np.zeros(len(extra_starts), np.int64)])
    starts = np.concatenate([starts, extra_starts])
    repeated_prior = Prior(prior.mean[hypothesis], prior.information[hypothesis])
    for extra_sigma in ANNEALING_SCHEDULE_M:
        starts, _ = view.descend(starts, repeated_prior, extra_sigma, 5)
    poses, evidence = view.polish(starts, repeated_prior)
    own = np.flatnonzero(hypothesis == 0)
    keep = np.array([own[np.argmin(evidence.accuracy[own] + repeated_prior.energy(poses)[own])], *range(1, count)])
    return poses[keep], evidence.part(keep)


def _refine(view: View, starts: Array, seeds: Seeds, settings: Settings) -> list[Mode]:
    """Descends from all starts with few beams and wide deviations, then from the best ones with all beams."""
    few = view.thinned(settings.search_beams)
    poses, evidence = few.descend(starts, None, COARSE_SIGMA_M, 5)
    poses, evidence = few.descend(poses, None, MEDIUM_SIGMA_M, 4)
    keep = select_distinct(poses, evidence.accuracy, 3 * settings.max_hypotheses)
    poses, _ = view.descend(poses[keep], None, FINE_SIGMA_M, 4)
    poses, evidence = follow(view, poses, None)
    return _best_modes(view, poses, evidence, None, seeds, settings)


def _best_modes(
    view: View, poses: Array, evidence: Evidence, prior: Prior | None, seeds: Seeds, settings: Settings
) -> list[Mode]:
    """The hypotheses with most evidence by surfaces among ``poses`` (N, 3), best first."""
    surfaces = view.surface_evidence(poses, skip=view.surfaces.small)
    log_prior = -prior.energy(poses) if prior else np.zeros(len(poses))
    modes = []
    for k in select_distinct(poses, -surfaces.log_likelihood - log_prior, settings.max_hypotheses):
        mode = mode_from_search(poses[k], evidence, k, prior, seeds.volume, seeds.spread, view.model.ripple)
        modes.append(
            replace(
                mode,
                explained=float(surfaces.explained[k]),
                log_evidence=mode.log_evidence + float(log_prior[k]),
                present=float(surfaces.log_likelihood[k]),
            )
        )
    return modes
