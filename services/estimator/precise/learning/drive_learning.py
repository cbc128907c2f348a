"""Learns the field from a drive with reference poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import SPACING, thin_places
from services.estimator.precise.learning.calibration import Calibration, Drive, calibrate, learn_motion, noise_of
from services.estimator.precise.learning.field_learning import (
    Recipe,
    learn_field,
    learn_ripple,
    learn_scales,
    looked_into,
    reachable,
)
from services.estimator.precise.learning.surfaces import Beams

HELD_OUT = 5  # one scan in so many tells of the precision
LEAST_SCANS = 50
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Learned:
    """What a drive has taught."""

    model: FieldModel
    places: Array  # (S, 2) m, where a laser may be
    calibration: Calibration
    errors: Array  # (K,) m, of ranges of the scans held out, where a surface is expected and met


def learn_drive(drive: Drive, recipe: Recipe, simulated: Beams | None, report: Report) -> Learned:
    """The model of a drive; ``simulated``: beams in a map of the place besides, for where the drive has not looked.

    Twice: once without the scans held out, which say how far the model is to be trusted; then from all.
    """
    sigma = noise_of(drive.ranges, drive.angles)
    numbers = np.arange(len(drive.ranges))
    held_out = numbers % HELD_OUT == HELD_OUT // 2
    held = drive.part(numbers[held_out])
    report("without the scans held out", 0.0)
    trial = _fields(drive.part(numbers[~held_out]), recipe, simulated, lambda done: report("trial field", 0.4 * done))
    lasers = se2.compose(held.poses, held.mount)
    scales = learn_scales(trial.field, held.poses, held.mount, held.angles, held.ranges, sigma)
    trial = replace(trial, scales=scales, ripple=learn_ripple(trial.field, lasers, held.angles))
    report("calibration", 0.45)
    motion = learn_motion(drive.stamps, drive.poses, drive.odom)
    calibration = calibrate(trial, held, motion, sigma)
    expected = trial.expect(lasers, held.angles)
    both = np.isfinite(held.ranges) & np.isfinite(expected.ranges) & np.isfinite(expected.scale)
    final = _fields(drive, recipe, simulated, lambda done: report("field", 0.55 + 0.4 * done))
    final = replace(final, scales=scales, ripple=trial.ripple)
    visited = se2.compose(drive.poses, drive.mount)[:, :2]
    places = thin_places(np.concatenate([visited, reachable(final.field, visited, seen=final.seen)]), SPACING)
    report("learned", 1.0)
    return Learned(final, places, calibration, np.abs(held.ranges[both] - expected.ranges[both]))


def _fields(drive: Drive, recipe: Recipe, simulated: Beams | None, report: Callable[[float], None]) -> FieldModel:
    own = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges)
    beams = own if simulated is None else own.joined(_beyond(own, simulated))
    field = learn_field(beams, recipe, lambda _, done: report(done))
    # As it will be read, in half precision.
    field = replace(field, phi=field.phi.astype(np.float16).astype(np.float32))
    return FieldModel(field, seen=looked_into(beams))


def _beyond(own: Beams, simulated: Beams) -> Beams:
    """Of the simulated beams those that end where the drive has not looked: a map's walls are as thick as its cells."""
    return simulated.part(~looked_into(own).contains(simulated.ends()))
