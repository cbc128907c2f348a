"""The expected information of a scan about the pose over the whole map, and how well the pose is known there.

A beam along u that hits a surface with normal n measures n·x, because its range changes by -n/(n·u) per metre of x. Its
precision along n is 1 / ((sigma n·u)² + MAP_ERROR_M²): an error of the map displaces the surface along its normal. The
information of a scan is the sum over its beams (Censi 2007). Beams without a return give no information.

A robot at a place p knows its pose by the scans there, or by those at another place q and dead reckoning from there.
Let s(q) be the standard deviation that scans at q leave. The deviation at p is the minimum over q of s(q) plus the
drift from q to p, which is found as the length of a shortest path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from services.controller.policies import expected_free_energy as efe
from services.controller.policies.free_space import Grid
from services.controller.policies.grid_paths import cheapest_paths
from services.controller.policies.motion_model import period_of

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from services.controller.policies.free_space import FreeSpace
    from services.controller.policies.geodesic_field import FreeSpaceGraph

CELL_M = 0.5  # the information of scans changes slowly over the map
MAX_CELLS = 10_000  # a map that would need more gets larger cells, so that the first scan takes about a second at most
DIRECTIONS = 48  # of the rays that stand for a scan, evenly spaced over a full turn
DEFAULT_SIGMA_M = 0.02  # of a range, if neither the scanner nor the estimator states it
MAP_ERROR_M = 0.01  # of a surface along its normal
MIN_INCIDENCE = 0.05  # cosine of the angle between beam and normal, below which the first order no longer holds
MAX_RAY_STEPS = 60  # of sphere tracing
UNKNOWN_VARIANCE = 1e4  # m² and rad², of a pose about which scans give no information


@dataclass(frozen=True)
class ScanInformation:
    """Expected information of scans, and the ambiguity of the pose that they leave."""

    information_grid: Grid  # coarse
    # (cells of information_grid, 3, 3) of one scan about x, y, yaw in map, averaged over headings: 1/m², 1/m, 1/rad²
    information: Array
    ambiguity_grid: Grid  # fine
    ambiguity: Array  # (rows, columns of ambiguity_grid) nats, charged once for each metre driven
    scan_period: float  # s

    @classmethod
    def of(cls, graph: FreeSpaceGraph, scan: Scan, max_speed: float) -> ScanInformation:
        """The expected information of scans by the scanner of ``scan``, whose ranges are not used.

        The ambiguity is that of a robot at its ``max_speed`` m/s, which scans least often on a metre.
        """
        scan_period = period_of(scan)
        grid = _coarse_grid(graph.grid)
        information = _information(graph.free, _places_with_room(graph.free, grid, graph.radius), scan)
        ambiguity = _ambiguity(graph, grid, information / (max_speed * scan_period))
        return cls(grid, information, graph.grid, ambiguity, scan_period)


def _information(free: FreeSpace, places: Array, scan: Scan) -> Array:
    """Expected information (N, 3, 3) of one scan from ``places`` (N, 2) m."""
    angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    start = np.broadcast_to(places[:, None], (len(places), DIRECTIONS, 2))
    distance = ray_lengths(free, start, np.broadcast_to(ray, start.shape), scan.range_max)
    hit = np.isfinite(distance)
    distance = np.where(hit, distance, 0.0)[..., None]
    normal = free.normal_at(start + np.maximum(distance - free.grid.resolution, 0.0) * ray)
    lever = distance[..., 0] * np.sum(normal * np.stack([-ray[:, 1], ray[:, 0]], axis=-1), axis=-1)
    jacobian = np.concatenate([normal, lever[..., None]], axis=-1)
    incidence = np.maximum(np.abs(np.sum(normal * ray, axis=-1)), MIN_INCIDENCE)
    sigma = np.hypot(scan.sigma or DEFAULT_SIGMA_M, scan.sigma_relative * distance[..., 0])
    variance = (sigma * incidence) ** 2 + MAP_ERROR_M**2
    precision = np.where(hit, len(scan.ranges) / DIRECTIONS / variance, 0.0)
    return np.asarray(np.einsum("cd,cdi,cdj->cij", precision, jacobian, jacobian))


def _ambiguity(graph: FreeSpaceGraph, grid: Grid, information: Array) -> Array:
    """Entropy (rows, columns) in nats of the pose beyond `efe.RESOLUTION_COVARIANCE` in each cell of a graph.

    ``information`` (cells of the coarse ``grid``, 3, 3) is that of all scans taken on a metre. The heading, and the
    directions in which the position is known better and worse, are treated separately.
    """
    scan_covariance = np.linalg.inv(information + np.eye(3) / UNKNOWN_VARIANCE)
    scan_variances = np.column_stack([np.linalg.eigvalsh(scan_covariance[:, :2, :2]), scan_covariance[:, 2, 2]])
    motion_variance = efe.DRIFT_PER_METRE**2
    # Each metre adds the motion's variance, and the scans reduce it: stationary variance of a scalar Kalman filter.
    stationary = (np.sqrt(motion_variance**2 + 4 * motion_variance * scan_variances) - motion_variance) / 2
    entropy = np.zeros(graph.grid.cell_count)
    for variance, resolution_variance in zip(stationary.T, np.diag(efe.RESOLUTION_COVARIANCE), strict=True):
        deviation = grid.interpolate(np.sqrt(variance).reshape(grid.shape), graph.grid.centres())
        deviation = _propagate_deviation(graph, deviation)
        entropy += np.log1p(deviation**2 / resolution_variance) / 2
    return entropy.reshape(graph.grid.shape)


def _propagate_deviation(graph: FreeSpaceGraph, deviation: Array) -> Array:
    """The standard deviation (cells,) in each cell of a graph, if the robot may come from any other cell.

    In the other cell, the scans leave the ``deviation`` (cells,) in m or rad; on the way it grows by
    `efe.DRIFT_PER_METRE`.
    """
    # Each cell starts with the length of the drive over which drift alone causes the deviation that scans there leave.
    distance = deviation / efe.DRIFT_PER_METRE
    free = graph.free.clearance >= graph.min_clearance
    cells = np.flatnonzero(free)
    path_lengths, _ = cheapest_paths(np.where(free, graph.grid.resolution, np.inf), cells, distance[cells])
    return np.asarray(efe.DRIFT_PER_METRE * np.minimum(distance, path_lengths))


def _coarse_grid(grid: Grid) -> Grid:
    """A grid over the same area, with cells of `CELL_M`, or larger ones in a large map."""
    size = max(CELL_M, grid.resolution * float(np.sqrt(grid.cell_count / MAX_CELLS)))
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
    length, active = np.zeros(len(start)), np.arange(len(start))  # rays that have not reached a wall
    # At this clearance a ray has reached a wall. Beyond the grid, clearances are those of the outermost cell centres.
    reached = 0.6 * free.grid.resolution
    for _ in range(MAX_RAY_STEPS):
        clearance = free.clearance_at(start[active] + length[active, None] * ray[active])
        length[active] += np.maximum(clearance, 0.0)
        active = active[(clearance > reached) & (length[active] < range_max)]
        if not len(active):
            break
    return np.where(length < range_max, length, np.inf).reshape(shape)
