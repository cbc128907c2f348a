"""The expected information of a scan about the pose, over the whole map.

A beam along u that hits a surface with normal n measures n·x, because its range changes by -n/(n·u) per metre of x. Its
precision along n is 1 / ((sigma n·u)² + MAP_ERROR_M²): an error of the map displaces the surface along its normal. The
information of a scan is the sum over its beams (Censi 2007). Beams without a return count as without information.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from services.controller.policies import expected_free_energy as efe
from services.controller.policies.free_space import Grid

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from services.controller.policies.free_space import FreeSpace

CELL_M = 0.5
MAX_CELLS = 10_000  # a map that would need more gets larger cells, so that the first scan takes about a second at most
DIRECTIONS = 48
DEFAULT_SIGMA_M = 0.02  # of a range, if the scanner does not state it
MAP_ERROR_M = 0.01  # of a surface along its normal
MIN_INCIDENCE = 0.05  # cosine of the angle between beam and normal, below which the first order no longer holds
MAX_RAY_STEPS = 60


@dataclass(frozen=True)
class ScanInformation:
    """Expected information of one scan in each cell of a coarse grid, on average over the headings."""

    grid: Grid
    matrix: Array  # (cells, 3, 3) information about x, y, yaw in map: 1/m², 1/m, 1/rad²
    ambiguity: Array  # (rows, columns) nats per metre, expected entropy of what a scan says about the pose
    loss: Array  # (rows, columns) nats per metre, information about the pose that motion loses and scans do not regain

    @classmethod
    def of(cls, free: FreeSpace, radius: float, scan: Scan, scans_per_metre: float) -> ScanInformation:
        """The expected information of scans like ``scan``, of which only the scanner matters.

        A cell stands for the place nearest to its centre where a robot with this ``radius`` m has room. Scans a metre
        apart count as independent, so the ambiguity is that of one scan per metre.
        """
        grid = _coarse_grid(free.grid)
        places = _places_with_room(free, grid, radius)
        angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
        ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        start = np.broadcast_to(places[:, None], (grid.cells, DIRECTIONS, 2))
        distance = ray_lengths(free, start, np.broadcast_to(ray, start.shape), scan.range_max)
        hit = np.isfinite(distance)
        distance = np.where(hit, distance, 0.0)[..., None]
        normal = free.normal_at(start + np.maximum(distance - free.grid.resolution, 0.0) * ray)
        lever = distance[..., 0] * np.sum(normal * np.stack([-ray[:, 1], ray[:, 0]], axis=-1), axis=-1)
        measured = np.concatenate([normal, lever[..., None]], axis=-1)
        incidence = np.maximum(np.abs(np.sum(normal * ray, axis=-1)), MIN_INCIDENCE)
        sigma = np.hypot(scan.sigma or DEFAULT_SIGMA_M, scan.sigma_relative * distance[..., 0])
        variance = (sigma * incidence) ** 2 + MAP_ERROR_M**2
        precision = np.where(hit, len(scan.ranges) / DIRECTIONS / variance, 0.0)
        matrix = np.einsum("cd,cdi,cdj->cij", precision, measured, measured)
        ambiguity = efe.remaining_entropy(efe.RESOLUTION, matrix).reshape(grid.shape)
        return cls(grid, matrix, ambiguity, efe.information_loss(scans_per_metre * matrix).reshape(grid.shape))

    @property
    def metre_cost(self) -> Array:
        """Nats (rows, columns) that a metre costs in each cell."""
        return self.ambiguity + self.loss


def _coarse_grid(grid: Grid) -> Grid:
    """A grid over the same area, with cells of `CELL_M`, or larger ones in a large map."""
    size = max(CELL_M, grid.resolution * float(np.sqrt(grid.cells / MAX_CELLS)))
    rows, columns = (int(np.ceil(n * grid.resolution / size)) for n in grid.shape)
    return Grid(grid.origin, size, (rows, columns))


def _places_with_room(free: FreeSpace, grid: Grid, radius: float) -> Array:
    """For each cell of a grid, the place (2,) m nearest to its centre where a robot of ``radius`` m has room."""
    nearest = distance_transform_edt(free.clearance < radius, return_distances=False, return_indices=True)
    row, column = nearest.reshape(2, -1)[:, free.grid.cell_of(grid.centres())]
    return free.grid.centres(row * free.grid.shape[1] + column)


def ray_lengths(free: FreeSpace, start: Array, ray: Array, range_max: float) -> Array:
    """Distance (...,) m along unit vectors ``ray`` (..., 2) from ``start`` (..., 2) to a wall; +inf beyond the range.

    Each step is as long as the clearance, so it passes no wall (sphere tracing).
    """
    shape, start, ray = start.shape[:-1], start.reshape(-1, 2), ray.reshape(-1, 2)
    length, on_the_way = np.zeros(len(start)), np.arange(len(start))
    reached = 0.6 * free.grid.resolution  # of a wall; beyond the grid clearances are those of the outermost centres
    for _ in range(MAX_RAY_STEPS):
        clearance = free.clearance_at(start[on_the_way] + length[on_the_way, None] * ray[on_the_way])
        length[on_the_way] += np.maximum(clearance, 0.0)
        on_the_way = on_the_way[(clearance > reached) & (length[on_the_way] < range_max)]
        if not len(on_the_way):
            break
    return np.where(length < range_max, length, np.inf).reshape(shape)
