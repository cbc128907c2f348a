"""Global and local search: descent from many starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise import hypotheses as mixture
from services.estimator.precise.gauss_newton import NARROW, WIDE, WIDEST, Prior, View, descending, polishing
from services.estimator.precise.global_seeds import Ranking
from services.estimator.precise.hypotheses import Mode
from services.estimator.shared.asking import Conversation

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.settings import Settings


def anywhere(view: View, seeds: Seeds, settings: Settings, *, thorough: bool) -> Conversation[list[Mode]]:
    """What fits best of all places; a second, ``thorough`` round where the first explains too little."""
    modes: list[Mode] = []
    for count in (settings.seeds, *([settings.more_seeds] if thorough else [])):
        starts = yield Ranking(seeds, view, count)
        modes = yield from _refine(view, starts, None, seeds, settings)
        if modes[0].explained >= settings.satisfied:
            break
    return modes


def near(
    view: View, pose: Array, covariance: Array, seeds: Seeds, settings: Settings, rng: np.random.Generator
) -> Conversation[list[Mode]]:
    """What fits best near ``pose`` (3,), given with ``covariance`` (3, 3)."""
    starts = rng.multivariate_normal(pose, covariance, settings.seeds)
    starts[0] = pose
    return (yield from _refine(view, starts, Prior.alike(len(starts), pose, covariance), seeds, settings))


def further(view: View, starts: Array, prior: Prior, around: Array) -> Conversation[tuple[Array, Evidence]]:
    """Poses and evidence of hypotheses at ``starts`` (N, 3), by wider steps; the first also from ``around`` (K, 3)."""
    count = len(starts)
    first = np.concatenate([np.arange(count), np.zeros(len(around), np.int64)])
    starts, wider = np.concatenate([starts, around]), Prior(prior.mean[first], prior.information[first])
    for widen in (WIDEST, WIDE, NARROW):
        starts, _ = yield from descending(view, starts, wider, widen, 5)
    poses, evidence = yield from polishing(view, starts, wider)
    own = np.flatnonzero(first == 0)
    keep = np.array([own[np.argmin(evidence.accuracy[own] + wider.energy(poses)[own])], *range(1, count)])
    return poses[keep], evidence.part(keep)


def _refine(
    view: View, starts: Array, prior: Prior | None, seeds: Seeds, settings: Settings
) -> Conversation[list[Mode]]:
    """Descend from all starts with few beams and wide deviations, then from the best with all and none."""
    few = view.thinned(settings.beams)
    poses, evidence = yield from descending(few, starts, prior, WIDEST, 5)
    poses, evidence = yield from descending(few, poses, prior, WIDE, 4)
    keep = mixture.distinct(poses, evidence.accuracy, 2 * settings.hypotheses)
    part = Prior(prior.mean[keep], prior.information[keep]) if prior else None
    poses, evidence = yield from descending(view, poses[keep], part, NARROW, 4)
    poses, evidence = yield from polishing(view, poses, part)
    keep = mixture.distinct(poses, evidence.accuracy, settings.hypotheses)
    modes = [mixture.found(poses[k], evidence, k, part, seeds.volume, seeds.spread, view.model.ripple) for k in keep]
    return mixture.weigh(modes, settings.evidence_error, settings.hypotheses)
