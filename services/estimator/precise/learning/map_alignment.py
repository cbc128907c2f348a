"""Aligns key scans, as one rigid body, to a map that is known only roughly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.special import ndtr

from common.geometry import se2
from services.estimator.precise.learning.field_learning import MAX_ERROR_M
from services.estimator.precise.learning.surfaces import Beams, SurfaceCells
from services.estimator.shared.generative_models import RayCaster

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.precise.learning.calibration import ReferenceDrive
    from services.estimator.shared.generative_models import GenerativeModel

Model = TypeVar("Model", bound="GenerativeModel")

STEPS = 5  # of Gauss-Newton
# The following are for maps that are grids.
EDGE_M = 0.005  # standard deviation of a surface's distance from the edge of its cell
MISSING_SHARE = 0.1  # share of the surfaces that the grid does not have
CELL_M, MAX_ELEMENTS = 0.05, 3000  # size and maximum number of the surface elements that are compared with the grid
OFFSET_SCANS = 500  # maximum number of scans from which the distance of the surfaces from the grid's is learned
FIRST_STEP_M, LAST_STEP_M = 0.008, 0.0005  # of the compass search


def align_to_map(original: GenerativeModel, keys: ReferenceDrive) -> ReferenceDrive:
    """Moves the key scans, as one rigid whole, to where they fit the ``original`` model best.

    Minimises the squared distances of all beams' ends to the surfaces, so that errors of a rough map average out. If
    the map is a grid, the surfaces are then moved into its occupied cells.
    """
    poses = keys.poses
    middle = np.array([*poses[:, :2].mean(axis=0), 0.0])
    for _ in range(STEPS):
        lasers = se2.compose(poses, keys.mount)
        expected = original.expect(lasers, keys.angles)
        by_x, by_y, by_yaw = np.moveaxis(expected.jacobian, -1, 0)
        slope = expected.slope
        with np.errstate(invalid="ignore", divide="ignore"):
            distance = (keys.ranges - expected.ranges) / slope
            used = (np.abs(distance) < MAX_ERROR_M) & np.isfinite(expected.scale)
        x, y = ((lasers[:, axis] - middle[axis])[:, None] for axis in (0, 1))
        J = np.stack([by_x, by_y, by_yaw - y * by_x + x * by_y], axis=-1)[used] / slope[used, None]
        step = np.linalg.lstsq(J.T @ J, J.T @ distance[used])[0]
        poses = se2.compose(middle + step, se2.between(middle, poses))
    keys = replace(keys, poses=poses)
    if isinstance(original, RayCaster) and original.world.grid is not None:
        keys = replace(keys, poses=move_into_cells(original.world, keys))
    return keys


def with_offset(model: Model, keys: ReferenceDrive) -> Model:
    """Returns the model; that of a grid with its surfaces moved back to where the key scans measured them.

    A grid's rays end at the front of its occupied cells, but the real surfaces are somewhere inside them.
    """
    if not isinstance(model, RayCaster) or model.world.grid is None:
        return model
    keys = keys.part(np.arange(0, len(keys.poses), 1 + len(keys.poses) // OFFSET_SCANS))
    expected = model.expect(se2.compose(keys.poses, keys.mount), keys.angles)
    with np.errstate(invalid="ignore"):
        behind = (keys.ranges - expected.ranges) / expected.slope
        used = np.abs(behind) < MAX_ERROR_M
    return replace(model, offset=float(np.median(behind[used]))) if used.any() else model


def move_into_cells(world: World, keys: ReferenceDrive) -> Array:
    """Returns the poses (N, 3) of key scans, moved as a whole so that the surfaces seen lie in a grid's occupied cells.

    In a grid, a surface may be anywhere in its cell with equal probability; the model's rays end at the edge.
    """
    cells = SurfaceCells.of(Beams.of(keys.poses, keys.mount, keys.angles, keys.ranges), CELL_M)
    elements = np.stack([cells.mx[cells.is_surface], cells.my[cells.is_surface]], axis=-1) + cells.low
    elements = elements[:: 1 + len(elements) // MAX_ELEMENTS]
    middle = np.array([*elements.mean(axis=0), 0.0])
    radius = float(np.hypot(*(elements - middle[:2]).T).mean())

    def cost(move: Array) -> float:
        inside = ndtr(-world.surface_distance(se2.transform(middle + move, elements - middle[:2])) / EDGE_M)
        return -float(np.log(MISSING_SHARE + (1 - MISSING_SHARE) * inside).sum())

    # Compass search (Kolda, Lewis & Torczon 2003)
    move, lowest, step = np.zeros(3), cost(np.zeros(3)), FIRST_STEP_M
    directions = np.concatenate([np.eye(3), -np.eye(3)]) / [1.0, 1.0, radius]
    while step >= LAST_STEP_M:
        costs = [cost(move + step * direction) for direction in directions]
        best = int(np.argmin(costs))
        if costs[best] < lowest:
            move, lowest = move + step * directions[best], costs[best]
        else:
            step /= 2
    return se2.compose(middle + move, se2.between(middle, keys.poses))
