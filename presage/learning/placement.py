"""Places a drive in the frame of an existing map, in which an estimator finds the poses of its key scans.

In a rough map, each wall and therefore each of these poses is wrong by some centimetres. The drive is placed by their
median, which is wrong by about a centimetre. If the map is a grid, it is then aligned to all surfaces together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World
from presage.learning.train_drive import enough_scans, simulated_beams
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.field_learning import Recipe, learn_field
from services.estimator.precise.learning.map_alignment import align_to_map, with_offset
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Observation, Posterior
from services.mapper.slam.pose_graph import PoseLink, optimise

MAX_KEYS = 60  # key scans that are searched for in a rough map; more do not improve a rigid placement
SAME_M = 0.3  # poses found in the map agree if they differ by less
MIN_FOUND = 0.5  # share of the key scans that must agree
# Standard deviations, m, m, rad: of the drive between two key scans, and of the poses found, because of model errors.
DRIFT, MODEL = np.array([0.003, 0.003, 0.001]), np.array([0.002, 0.002, 0.001])


@dataclass(frozen=True)
class Placement:
    """The pose of a drive in a map."""

    poses: Array  # (N, 3) of the key scans in map
    found: float  # share of the key scans that the estimator found there
    deviation: float  # m, median distance between the poses found and those of the placed drive
    scale: float  # size of the map relative to the drive; 1 if the difference is less than the map's other errors


def place_drive(world: World, keys: ReferenceDrive, model: Path | None = None) -> Placement:
    """Finds the poses in the map ``world`` of key scans, whose poses in the frame of their drive are given.

    The drive is moved as a whole. If the map has a ``model``, which is exact to some millimetres, the drive is also
    deformed to fit it. Raises UserError if too few key scans are found in the map at places that agree.

    The estimator gets the motion of the drive, so in any map its poses agree with the drive. A key scan counts as found
    if the estimator is also `tracking`. If too few are, each key scan is searched for on its own.
    """
    searched = np.arange(len(keys.poses))
    if model is None:
        searched = np.unique(np.linspace(0, len(keys.poses) - 1, MAX_KEYS).round().astype(int))
    search = _KeyScanSearch(world, keys.part(searched), model)
    # The drive is turned about its middle, so that it hardly moves.
    middle = np.array([*keys.poses[:, :2].mean(axis=0), 0.0])
    local = se2.between(middle, keys.poses[searched])
    found, covariances, tracking = search.in_sequence()
    origin, agreeing = _common_origin(found, local)
    share = float((agreeing & tracking).mean())
    if share < MIN_FOUND:
        found, covariances = search.one_by_one()
        origin, agreeing = _common_origin(found, local)
        share = float(agreeing.mean())
    if share < MIN_FOUND:
        raise UserError(
            f"only {share:.0%} of the drive was found in the map {world.name}: is it a map of the same place?"
        )
    placed = se2.compose(origin, se2.between(middle, keys.poses))
    scale = _relative_scale(local[agreeing, :2], found[agreeing, :2])
    if model is not None:
        placed = _fit_to_found_poses(placed, found, covariances)
    elif world.grid is not None:
        keys = replace(keys, poses=placed)
        placed = align_to_map(with_offset(RayCaster(world), keys), keys).poses
    return Placement(placed, share, float(np.median(_distance(placed[searched], found))), scale)


def _common_origin(found: Array, local: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """The origin (3,) in map of a drive on which most of the poses ``found`` agree, and which of them (N,) do.

    ``found`` (N, 3) are poses in map, ``local`` (N, 3) the same in the frame of the drive.
    """
    origins = se2.compose(found, se2.inverse(local))  # according to each pose
    agreeing = [_distance(se2.compose(origin, local), found) < SAME_M for origin in origins]
    best = int(np.argmax([np.count_nonzero(each) for each in agreeing]))
    differences = se2.between(origins[best], origins[agreeing[best]])
    return np.asarray(se2.compose(origins[best], np.median(differences, axis=0))), agreeing[best]


def _relative_scale(local: Array, found: Array) -> float:
    """Scale of the similarity (Umeyama 1991) that moves positions ``local`` (N, 2) of a drive to those ``found``.

    Returns 1 if the scale moves most positions by less than the similarity leaves over.
    """
    drive, positions = ((each - each.mean(axis=0)) @ [1, 1j] for each in (local, found))
    if not np.any(drive):
        return 1.0
    similarity = np.vdot(drive, positions) / np.vdot(drive, drive)
    scale = float(np.abs(similarity))
    left_over = np.median(np.abs(positions - similarity * drive))
    return scale if np.median(np.abs((scale - 1) * drive)) > left_over else 1.0


def _fit_to_found_poses(placed: Array, found: Array, covariances: Array) -> Array:
    """Poses (N, 3) of key scans that fit both their relative poses and those ``found``, some of which are wrong."""
    drift = np.diag(1 / DRIFT**2)
    steps = se2.between(placed[:-1], placed[1:])
    links = [PoseLink(k + 1, k + 2, step, drift) for k, step in enumerate(steps)]
    for k, (pose, covariance) in enumerate(zip(found, covariances, strict=True)):
        links.append(PoseLink(0, k + 1, pose, np.linalg.inv(covariance + np.diag(MODEL**2)), robust=True))
    return optimise(np.concatenate([np.zeros((1, 3)), placed]), links)[1:]


class _KeyScanSearch:
    """Finds the poses of key scans in a map; some are wrong, at first and where much has changed."""

    def __init__(self, world: World, keys: ReferenceDrive, model: Path | None) -> None:
        self._keys = keys
        if model is not None:
            options = EstimatorOptions(world, model=str(model))
        else:  # a learned field, because the cells of oblique walls are staircases, which would bias the headings
            beams = simulated_beams(RayCaster(world), keys, enough_scans(world), seed=0)
            options = EstimatorOptions(world, generative_model=FieldModel(learn_field(beams, Recipe(0.05))))
        self._make_estimator = prepare_factory(options)
        self._geometry = ScannerGeometry(keys.angles, keys.mount, keys.range_max)

    def in_sequence(self) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Poses (N, 3) found with the motion of the drive, covariances, and whether the estimator was `tracking`."""
        keys, estimator = self._keys, self._make_estimator(self._geometry)
        found = [
            estimator.update(Observation(ranges, keys.angles, keys.range_max, float(stamp), pose))
            for ranges, stamp, pose in zip(keys.ranges, keys.stamps, keys.poses, strict=True)
        ]
        return *_poses(found), np.array([each.state == "tracking" for each in found])

    def one_by_one(self) -> tuple[Array, Array]:
        """Poses (N, 3) found from one scan each, and covariances."""
        keys = self._keys
        observations = [Observation(ranges, keys.angles, keys.range_max) for ranges in keys.ranges]
        return _poses([self._make_estimator(self._geometry).update(each) for each in observations])


def _poses(found: list[Posterior]) -> tuple[Array, Array]:
    """The poses (N, 3) and covariances (N, 3, 3) of beliefs."""
    covariances = [np.eye(3) if each.covariance is None else each.covariance for each in found]
    return np.array([each.pose for each in found]), np.array(covariances)


def _distance(poses: Array, others: Array) -> Array:
    return np.asarray(np.hypot(*(poses - others)[:, :2].T))
