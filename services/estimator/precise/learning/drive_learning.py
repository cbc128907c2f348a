"""Learns the field from a drive with reference poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import (
    Calibration,
    ReferenceDrive,
    calibrate,
    learn_motion,
)
from services.estimator.precise.learning.field_learning import (
    MAX_ERROR_M,
    SEED_CLEARANCE_M,
    Recipe,
    learn_field,
    learn_scales,
    seed_places,
    seen_cells,
)
from services.estimator.precise.learning.surfaces import Beams, SurfaceCells, field_of_surfaces
from services.estimator.precise.noise import estimate_noise
from services.estimator.shared.generative_models import GenerativeModel

HELD_OUT_EVERY = 5  # every fifth scan is held out, to measure the precision
MIN_SCANS = 50  # of a drive from which a field can be learned and calibrated
ReportProgress = Callable[[str, float], None]  # called with the present stage and the share done


@dataclass(frozen=True)
class LearningResult:
    """Result of learning from a drive."""

    model: FieldModel
    places: Array  # (S, 2) m, where the laser can be
    calibration: Calibration
    errors: Array  # (K,) m, of the ranges of held-out scans, where a surface is expected and was measured


def learn_drive(
    drive: ReferenceDrive, recipe: Recipe, simulated: Beams | None, report: ReportProgress, *, replayed: bool = False
) -> LearningResult:
    """Learns a model from a drive, and calibrates it.

    ``simulated`` are beams simulated in a map of the place, used where the drive saw nothing. If they are ``replayed``
    from a former model, they are used unless the drive contradicts them.

    The field is learned twice: first without the held-out scans, which measure its precision, then from all scans.
    """
    sigma = estimate_noise(drive.ranges, drive.angles)
    others, held_out = hold_out(drive)
    report("first field, without the held-out scans", 0.0)
    trial = _learn_model(
        others,
        recipe,
        simulated,
        lambda done: report("first field, without the held-out scans", 0.4 * done),
        replayed=replayed,
    )
    scales = learn_scales(trial.field, held_out.poses, held_out.mount, held_out.angles, held_out.ranges, sigma)
    trial = replace(trial, scales=scales)
    report("calibration", 0.45)
    motion = learn_motion(drive.stamps, drive.poses, drive.odom)
    calibration = calibrate(trial, held_out, motion, sigma)
    final = _learn_model(
        drive, recipe, simulated, lambda done: report("final field", 0.55 + 0.4 * done), replayed=replayed
    )
    final = replace(final, scales=scales)
    visited = se2.compose(drive.poses, drive.mount)[:, :2]
    if simulated is not None:  # rooms that the drive did not enter, perhaps because a door was closed
        visited = np.concatenate([visited, free_places(final, np.unique(simulated.starts, axis=0))])
    places = seed_places(final.field, visited, final.seen)
    report("learned", 1.0)
    errors = absolute_range_errors(trial, held_out)
    return LearningResult(final, places, calibration, errors[np.isfinite(errors)])


def hold_out(drive: ReferenceDrive) -> tuple[ReferenceDrive, ReferenceDrive]:
    """Returns the scans to learn from, and those held out."""
    is_held_out = np.arange(len(drive.ranges)) % HELD_OUT_EVERY == HELD_OUT_EVERY // 2
    return drive.part(~is_held_out), drive.part(is_held_out)


def absolute_range_errors(model: GenerativeModel, scans: ReferenceDrive) -> Array:
    """Absolute errors (N, B) in m of predicted ranges; NaN where no surface is expected or was measured."""
    expected = model.expect(se2.compose(scans.poses, scans.mount), scans.angles)
    known = np.isfinite(scans.ranges) & np.isfinite(expected.ranges) & np.isfinite(expected.scale)
    errors = np.full(known.shape, np.nan)
    errors[known] = np.abs(scans.ranges[known] - expected.ranges[known])
    return errors


def _learn_model(
    drive: ReferenceDrive, recipe: Recipe, simulated: Beams | None, report: Callable[[float], None], *, replayed: bool
) -> FieldModel:
    measured = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges)
    measured.check_any()
    beams = measured
    if simulated is not None and replayed:
        beams = measured.joined(remove_contradicted(measured, simulated, recipe.resolution))
    elif simulated is not None:
        beams = measured.joined(_unseen_part(measured, simulated))
    return learn_model(beams, recipe, report)


def learn_model(beams: Beams, recipe: Recipe, report: Callable[[float], None] = lambda _done: None) -> FieldModel:
    """Learns a model that predicts the beams; its scales, the deviations of its errors, are left at their defaults."""
    field = learn_field(beams, recipe, lambda _, done: report(done))
    return FieldModel(field.as_stored(), seen=seen_cells(beams))


def free_places(model: FieldModel, places: Array) -> Array:
    """The places (N, 2) m in map that are in seen free space."""
    free = model.field.value_at(places) > SEED_CLEARANCE_M
    return np.asarray(places[free if model.seen is None else free & model.seen.contains(places)])


def _unseen_part(measured: Beams, simulated: Beams) -> Beams:
    """The simulated beams that end in cells that no measured beam has passed or ended in."""
    return simulated.part(~seen_cells(measured).contains(simulated.ends()))


def replay_model(model: GenerativeModel, places: Array, drive: ReferenceDrive, samples: int, seed: int) -> Beams:
    """Beams that a model predicts for the drive's scanner, at ``samples`` random poses at ``places`` (S, 2) m.

    No place is used twice if there are enough.
    """
    rng = np.random.default_rng(seed)
    chosen = rng.choice(places, samples, replace=samples > len(places))
    lasers = np.column_stack([chosen, rng.uniform(-np.pi, np.pi, samples)])
    expected = model.expect(lasers, drive.angles)
    known = np.isfinite(expected.scale) & (expected.ranges < drive.range_max)
    return Beams.of(lasers, np.zeros(3), drive.angles, np.where(known, expected.ranges, -np.inf))


def remove_contradicted(measured: Beams, replayed: Beams, h: float) -> Beams:
    """The beams replayed from a former model that the measured ones do not contradict.

    A beam is contradicted if it ends at a surface that is gone, or passes through a new one: from either side, or from
    inside it.
    """
    if not len(replayed.ranges):
        return replayed
    cells = SurfaceCells.of(replayed, h)
    gone = cells.at(cells.contradicted_by(measured), replayed.ends())
    present = field_of_surfaces(measured, h)
    reach = present.trace(np.column_stack([replayed.starts, replayed.directions]), np.zeros(1)).ranges[:, 0]
    blocked = (reach < replayed.ranges - MAX_ERROR_M) | (present.value_at(replayed.starts) <= 0)
    return replayed.part(~(gone | blocked))
