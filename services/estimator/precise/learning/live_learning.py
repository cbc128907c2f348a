"""Learns a new version of the field while driving, from key scans and from what the original model predicts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from common.geometry import se2
from services.estimator.precise.field import FieldModel
from services.estimator.precise.gauss_newton import Prior
from services.estimator.precise.global_seeds import Seeds
from services.estimator.precise.learning.drive_learning import (
    absolute_range_errors,
    free_places,
    hold_out,
    learn_model,
    remove_contradicted,
    replay_model,
)
from services.estimator.precise.learning.field_learning import (
    MAX_ERROR_M,
    Recipe,
    learn_scales,
    seed_places,
    seen_cells,
)
from services.estimator.precise.learning.map_alignment import align_to_map, with_offset
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.noise import estimate_noise, robust_excess
from services.estimator.precise.scan_likelihood import ScanLikelihood

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.learning.calibration import ReferenceDrive
    from services.estimator.shared.generative_models import GenerativeModel

RECIPE = Recipe(resolution=0.05, sweeps=6, beams_per_sweep=500_000)
MAX_REPLAYED_SCANS = 2000  # predicted by the original model; at most one for each place
PRECISE_M = 1e-3  # error of an original model whose replayed scans count as much as measured ones
LASTING_S, LASTING_CELL_M = 3.0, 0.1  # a surface is learned if beams end in or beside its cell this long apart
MAX_WORSENING = 1.1  # factor (a guess) on the mean error where both models predict a surface
EPOCHS = 4  # parts of the key scans, of which each may contradict those before it
ALIGNMENTS = 3  # times that the key scans are matched to the field learned from them
ALIGNMENT_SCHEDULE_M = (0.02, 0.0, 0.0)  # added to the deviation of every beam, step by step
ALIGNMENT_DEVIATION = np.array([0.05, 0.05, 0.02])  # m, m, rad: of the poses of key scans, in a rough map


@dataclass(frozen=True)
class ModelVersion:
    """A new version of a model."""

    model: FieldModel
    seeds: Seeds
    key_poses: Array  # (N, 3) poses in map at which the key scans agree best
    test_scans: int  # held-out key scans that were new to both models
    errors: Array  # (K,) m, of their ranges, where the model that was in use predicts them as well
    present_errors: Array  # (K,) m, the same with the model that was in use


def learn_version(
    original: GenerativeModel,
    places: Array,
    present: GenerativeModel,
    keys: ReferenceDrive,
    recipe: Recipe = RECIPE,
    learned_until: float = -np.inf,
) -> ModelVersion | None:
    """Learns a field from key scans and the ``original`` model, which knows the surroundings of ``places`` (S, 2) m.

    Returns None if the new field predicts held-out key scans no better than the model in use, ``present``, which was
    learned from key scans up to the stamp ``learned_until`` s: only later ones are new to both, and if there are none,
    it also returns None. The field may predict them better by predicting more surfaces, if it is not much worse at
    those that both predict.
    """
    tracked = remove_moving_objects(keys)
    test_scans = hold_out(tracked)[1]
    test_scans = test_scans.part(test_scans.stamps > learned_until)
    if not len(test_scans.poses):
        return None
    sigma = estimate_noise(tracked.ranges, tracked.angles)
    original, present = (with_offset(model, tracked) for model in (original, present))
    error = _estimate_map_error(original, tracked, sigma)
    replayed = replay_model(original, places, tracked, min(len(places), MAX_REPLAYED_SCANS), recipe.seed)
    overlapping, elsewhere = _split_replayed_beams(replayed, tracked, error, recipe.seed)
    aligned = tracked
    for _ in range(ALIGNMENTS):
        aligned = _match_key_scans(_learn(aligned, overlapping, recipe, 1), aligned, tracked.poses, sigma)
    aligned = align_to_map(original, aligned)
    # A trial field, learned without the held-out key scans, shows whether learning is an improvement.
    others, held_out = hold_out(aligned)
    trial = _learn(others, overlapping, recipe, EPOCHS)
    errors, present_errors = (
        absolute_range_errors(model, _match_key_scans(model, test_scans, test_scans.poses, sigma))[
            np.isfinite(test_scans.ranges)
        ]
        for model in (trial, present)
    )
    if mean_error(errors) >= mean_error(present_errors):
        return None
    common = np.isfinite(errors + present_errors)
    errors, present_errors = errors[common], present_errors[common]
    if mean_error(errors) > MAX_WORSENING * mean_error(present_errors):
        return None
    scales = learn_scales(trial.field, held_out.poses, held_out.mount, held_out.angles, held_out.ranges, sigma)
    final = _learn(aligned, overlapping.joined(elsewhere), recipe, EPOCHS)
    visited = se2.compose(aligned.poses, aligned.mount)[:, :2]
    starts = seed_places(final.field, np.concatenate([visited, free_places(final, places)]), final.seen)
    starts, scales = (values.astype(np.float32).astype(np.float64) for values in (starts, scales))  # as published
    model = replace(final, field=final.field.with_solids(starts), scales=scales)
    seeds = Seeds.at(model, starts)
    return ModelVersion(model, seeds, aligned.poses, len(test_scans.poses), errors, present_errors)


def remove_moving_objects(keys: ReferenceDrive) -> ReferenceDrive:
    """Removes the beams that end where no beam ended `LASTING_S` earlier or later, as at a person passing by.

    Objects that stay longer before they leave are removed when the field is learned: later beams pass through them.
    """
    row, column = np.nonzero(np.isfinite(keys.ranges) & (keys.ranges > 0))
    if not len(row):
        return keys
    ends = Beams.of(keys.poses, keys.mount, keys.angles, keys.ranges).ends()
    cell = tuple(np.floor((ends - ends.min(axis=0)) / LASTING_CELL_M).astype(int).T)
    shape = tuple(int(each.max()) + 1 for each in cell)
    first, last = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(first, cell, keys.stamps[row])
    np.maximum.at(last, cell, keys.stamps[row])
    lasting = ndimage.maximum_filter(last, 3) - ndimage.minimum_filter(first, 3) >= LASTING_S
    ranges = keys.ranges.copy()
    fleeting = ~lasting[cell]
    ranges[row[fleeting], column[fleeting]] = -np.inf
    return replace(keys, ranges=ranges)


def mean_error(errors: Array) -> float:
    """Mean of errors (K,) in m, each clipped at `MAX_ERROR_M`, because larger ones are due to changed surroundings.

    A surface that was measured, but not predicted (NaN), counts as much.
    """
    return float(np.fmin(errors, MAX_ERROR_M).mean()) if len(errors) else MAX_ERROR_M


def _estimate_map_error(model: GenerativeModel, keys: ReferenceDrive, sigma: float) -> float:
    """Estimates the standard deviation in m of the model's own errors, without the scanner's noise ``sigma`` m."""
    errors = absolute_range_errors(model, keys)
    errors = errors[errors < MAX_ERROR_M]  # not NaN either
    variance = robust_excess(errors, np.array(sigma**2)) if len(errors) else 0.0
    return float(np.sqrt(max(variance, PRECISE_M**2)))


def _split_replayed_beams(replayed: Beams, keys: ReferenceDrive, error: float, seed: int) -> tuple[Beams, Beams]:
    """Splits the beams replayed from the original model: those that end in cells seen by key scans, and all others.

    The rougher the model, the fewer of the first are kept: the ``error`` of the model, in m, does not average out over
    many beams, as the noise of measured beams does.
    """
    seen = seen_cells(Beams.of(keys.poses, keys.mount, keys.angles, keys.ranges)).contains(replayed.ends())
    chosen = np.random.default_rng(seed).random(len(seen)) < (PRECISE_M / error) ** 2
    return replayed.part(seen & chosen), replayed.part(~seen)


def _learn(keys: ReferenceDrive, replayed: Beams, recipe: Recipe, epochs: int) -> FieldModel:
    """Learns a model from key scans in ``epochs`` parts, each with the earlier beams that it does not contradict."""
    beams = replayed
    for part in np.array_split(np.arange(len(keys.poses)), epochs):
        measured = Beams.of(keys.poses[part], keys.mount, keys.angles, keys.ranges[part])
        beams = measured.joined(remove_contradicted(measured, beams, recipe.resolution))
    return learn_model(beams, recipe)


def _match_key_scans(model: GenerativeModel, keys: ReferenceDrive, priors: Array, sigma: float) -> ReferenceDrive:
    """Matches each key scan to the model, near its prior pose in ``priors`` (N, 3)."""
    information, likelihood = np.diag(ALIGNMENT_DEVIATION**-2.0)[None], Likelihood(sigma)
    poses = []
    for pose, prior, ranges in zip(keys.poses, priors, keys.ranges, strict=True):
        scan = ScanLikelihood(model, likelihood, keys.mount, keys.angles, ranges.astype(float), keys.range_max)
        poses.append(scan.descend(pose[None], Prior(prior[None], information), ALIGNMENT_SCHEDULE_M)[0][0])
    return replace(keys, poses=np.array(poses))
