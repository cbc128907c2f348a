"""Places a drive in the frame of an existing map, in which an estimator finds its key scans.

In a rough map each of these poses is wrong by some centimetres, because each wall is; of the whole drive, with all the
walls that it saw, the median is wrong by a few millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World
from presage.learning.train_drive import simulated_beams
from services.estimator.factory import EstimatorOptions, Geometry, prepare
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import Drive
from services.estimator.precise.learning.field_learning import Recipe, learn_field
from services.estimator.shared.interface import Observation

SIMULATED_SCANS = 2000  # in the map
SAME_M = 0.3  # poses found in the map that differ by less agree
MIN_FOUND = 0.5  # share of the key scans that must agree


@dataclass(frozen=True)
class Placement:
    """Where a drive is in a map."""

    origin: Array  # (3,) frame of the drive in map
    found: float  # share of the key scans that the estimator found there
    deviation: float  # m, median distance between the poses found and those of the placed drive


def place(world: World, keys: Drive) -> Placement:
    """Where key scans, with poses in the frame of their drive, are in the map ``world``.

    Raises UserError if too few are found in the map at places that agree.
    """
    found = _localise(world, keys)
    middle = np.array([*keys.poses[:, :2].mean(axis=0), 0.0])  # turned about it, a drive hardly moves
    local = se2.between(middle, keys.poses)
    origins = se2.compose(found, se2.inverse(local))  # the middle in map, according to each key scan
    agreeing = [_distance(se2.compose(origin, local), found) < SAME_M for origin in origins]
    best = int(np.argmax([np.count_nonzero(each) for each in agreeing]))
    share = float(agreeing[best].mean())
    if share < MIN_FOUND:
        raise UserError(
            f"only {share:.0%} of the drive were found in the map {world.name}: is it a map of the same place?"
        )
    off = se2.between(origins[best], origins[agreeing[best]])
    centre = se2.compose(origins[best], np.median(off, axis=0))
    deviation = float(np.median(_distance(se2.compose(centre, local), found)))
    return Placement(se2.compose(centre, se2.inverse(middle)), share, deviation)


def _localise(world: World, keys: Drive) -> Array:
    """Poses (N, 3) of key scans in the map; some are wrong, at first and where much has changed."""
    # In a learned field, oblique walls are no staircases, which would bias the headings.
    beams = simulated_beams(world, keys, SIMULATED_SCANS, seed=0)
    options = EstimatorOptions(world, generative_model=FieldModel(learn_field(beams, Recipe(0.05))))
    estimator = prepare(options)(Geometry(keys.angles, keys.mount, keys.range_max))
    observations = [
        Observation(ranges, keys.angles, keys.range_max, float(stamp), pose)
        for ranges, stamp, pose in zip(keys.ranges, keys.stamps, keys.poses, strict=True)
    ]
    return np.array([estimator.update(observation).pose for observation in observations])


def _distance(poses: Array, others: Array) -> Array:
    return np.asarray(np.hypot(*(poses - others)[:, :2].T))
