"""Aligns key scans, as one rigid body, to a map that is known only roughly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from common.geometry import se2
from services.estimator.precise.learning.field_learning import MAX_ERROR_M
from services.estimator.shared.generative_models import RayCaster

if TYPE_CHECKING:
    from services.estimator.precise.learning.calibration import ReferenceDrive
    from services.estimator.shared.generative_models import GenerativeModel

Model = TypeVar("Model", bound="GenerativeModel")

STEPS = 5  # of Gauss-Newton
OFFSET_SCANS = 500  # maximum number of scans from which the offset in a grid is learned


def align_to_map(original: GenerativeModel, key_scans: ReferenceDrive) -> ReferenceDrive:
    """Moves the key scans, as one rigid whole, to where they fit the ``original`` model best.

    Minimises the squared distances to the surfaces of all beams' ends within `MAX_ERROR_M` of them, so that errors of a
    rough map average out.
    """
    poses = key_scans.poses
    middle = np.array([*poses[:, :2].mean(axis=0), 0.0])
    for _ in range(STEPS):
        lasers = se2.compose(poses, key_scans.mount)
        expected = original.expect(lasers, key_scans.angles)
        by_x, by_y, by_yaw = np.moveaxis(expected.jacobian, -1, 0)
        slope = expected.slope
        with np.errstate(invalid="ignore", divide="ignore"):
            distance = (key_scans.ranges - expected.ranges) / slope
            used = (np.abs(distance) < MAX_ERROR_M) & np.isfinite(expected.scale)
        x, y = ((lasers[:, axis] - middle[axis])[:, None] for axis in (0, 1))
        J = np.stack([by_x, by_y, by_yaw - y * by_x + x * by_y], axis=-1)[used] / slope[used, None]
        step = np.linalg.lstsq(J, distance[used], rcond=None)[0]
        poses = se2.compose(middle + step, se2.between(middle, poses))
    return replace(key_scans, poses=poses)


def with_offset(model: Model, key_scans: ReferenceDrive) -> Model:
    """Returns a grid's model with the offset at which its surfaces are where the key scans measured them.

    A grid's rays end at the front of its occupied cells, but the real surfaces are somewhere inside them. Returns the
    model unchanged if it is not that of a grid, or if no beam ends within `MAX_ERROR_M` of its surfaces.
    """
    if not isinstance(model, RayCaster) or model.world.grid is None:
        return model
    count = len(key_scans.poses)
    used_scans = key_scans.part(np.arange(0, count, 1 + count // OFFSET_SCANS))
    expected = model.expect(se2.compose(used_scans.poses, used_scans.mount), used_scans.angles)
    with np.errstate(invalid="ignore", divide="ignore"):
        behind = (used_scans.ranges - expected.ranges) / expected.slope
        used = (np.abs(behind) < MAX_ERROR_M) & np.isfinite(expected.scale)
    return replace(model, offset=model.offset + float(np.median(behind[used]))) if used.any() else model
