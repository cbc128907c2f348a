"""Learns the distance field from posed scans.

1. The end points of beams are pooled in cells; their covariance gives a surface element (mean, normal) for each cell.
2. Near surfaces, phi is the weighted distance to the elements around (implicit moving least squares, Kolluri 2008);
   elsewhere it is the distance to the nearest surface.
3. Gradient descent: where beams end, phi is corrected along the gradient of the squared prediction error (diagonal
   Gauss-Newton steps), in the same way as perception corrects the belief.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from common.geometry.se2 import Array, compose
from common.robot.stray_beams import has_neighbours
from services.estimator.precise.field import CLASSES, DistanceField, Floats
from services.estimator.precise.global_seeds import SEED_SPACING_M, thin_places
from services.estimator.precise.learning.beam_cells import count_at_nodes, mark_seen_cells
from services.estimator.precise.learning.surfaces import (
    PASSED_DEPTH_M,
    Beams,
    are_mostly_passed,
    field_of_surfaces,
)
from services.estimator.shared.seen_cells import SEEN_CELL_M, SeenCells

CARVED_DISTANCE_CELLS = 0.5  # minimum of phi at a node through which beams pass
PASSING_CELLS = 0.25  # a beam passes a node within this distance
EM_STEPS = 15  # of expectation maximisation
OUTLIER_SHARE, OUTLIER_RANGE_M = 0.1, 25.0  # weight and width of the uniform part of the density
MAX_ERROR_M = 0.1  # a larger error means that the beam ended at another surface
MIN_COS_INCIDENCE = 0.15  # minimum |n . u| of a beam that shapes the field: cosine of its angle of incidence
PRIOR_COUNT, PRIOR_SCALE_M = 20, 0.05  # pseudo-count of each class, and its error, for classes that are seldom seen
MIN_SCALE_M = 1e-3
SEED_CLEARANCE_M = 0.1  # minimum distance from surfaces of a place where a search begins


@dataclass(frozen=True)
class Recipe:
    """Parameters of learning."""

    resolution: float = 0.04  # m
    sweeps: int = 10  # steps of gradient descent, each on a sample of the beams
    beams_per_sweep: int = 2_000_000
    seed: int = 0


def learn_field(
    beams: Beams,
    recipe: Recipe,
    report: Callable[[str, float], None] = lambda _title, _done: None,
    threads: int = 1,
) -> DistanceField:
    """Learns the field that predicts the beams; calls ``report`` with the name of the stage and the share done.

    The result does not depend on the number of ``threads``.
    """
    report("surfaces", 0.0)
    beams = beams.part(has_neighbours(beams.ends()))
    field = field_of_surfaces(beams, recipe.resolution)
    rng = np.random.default_rng(recipe.seed)
    phi = _clear_passed_nodes(field, beams, threads)
    for sweep in range(recipe.sweeps):
        report("prediction errors", sweep / recipe.sweeps)
        # Sorted, because neighbouring beams of a scan need the same part of the field: a third less time.
        sample = np.sort(rng.integers(0, len(beams.ranges), min(recipe.beams_per_sweep, len(beams.ranges))))
        rate = 1 / (1 + sweep / 2)  # decreases, so that the noise averages out in the last steps
        phi = _descend(DistanceField(phi, field.origin, field.resolution), beams, sample, rate, threads)
    return DistanceField(phi, field.origin, field.resolution)


def seen_cells(beams: Beams) -> SeenCells:
    """The cells in which the beams passed or ended."""
    low, high = beams.bounds()
    low = low - SEEN_CELL_M
    shape = np.ceil((high - low) / SEEN_CELL_M).astype(int)[::-1] + 1
    cells = np.zeros(shape, np.bool_)
    mark_seen_cells(beams.starts - low, beams.unit(), beams.ranges, SEEN_CELL_M, cells)
    return SeenCells(cells, (float(low[0]), float(low[1])))


def seed_places(field: DistanceField, visited: Array, seen: SeenCells | None = None) -> Array:
    """Places (K, 2), m in map, where a search for the laser begins: visited ones, and those `reachable` from them."""
    return thin_places(np.concatenate([visited, reachable(field, visited, seen)]), SEED_SPACING_M)


def reachable(field: DistanceField, visited: Array, seen: SeenCells | None = None) -> Array:
    """Places (K, 2), m in map, that are connected with the visited places (N, 2) through free space.

    They are the nodes of the field at least `SEED_CLEARANCE_M` from surfaces, and within the cells ``seen`` if given.
    """
    free = field.phi > SEED_CLEARANCE_M
    if seen is not None:
        free &= field.nodes_in(seen)
    region, _ = ndimage.label(free)
    column, row = np.round((visited - field.origin) / field.resolution).astype(int).T
    i, j = np.nonzero(free & np.isin(region, region[row, column]))
    return np.asarray(np.array(field.origin) + field.resolution * np.column_stack([j, i]))


def _clear_passed_nodes(field: DistanceField, beams: Beams, threads: int) -> Floats:
    """Phi, made positive at the nodes that most beams near them pass.

    Beside an outer corner, noise along the beams resembles a surface, and its plane may reach into free space.
    """
    h = field.resolution

    def count(part: Beams) -> Array:
        counts = np.zeros((2, *field.phi.shape))
        starts = part.starts - field.origin
        count_at_nodes(starts, part.unit(), part.ranges, h, PASSING_CELLS * h, PASSED_DEPTH_M, *counts)
        return counts

    total = np.zeros((2, *field.phi.shape))
    for part in beams.parts():
        total += sum(_map_parts(count, part, threads))
    ended, passed = total
    return np.where(are_mostly_passed(ended, passed), np.maximum(field.phi, np.float32(PASSING_CELLS * h)), field.phi)


def _map_parts(function: Callable[[Beams], Any], beams: Beams, threads: int) -> list[Any]:
    """Applies a function to as many parts of the beams as there are threads, each in its own thread."""
    edges = np.linspace(0, len(beams.ranges), threads + 1).astype(int)
    parts = [beams.part(slice(*pair)) for pair in pairwise(edges)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, parts))


def _descend(field: DistanceField, beams: Beams, sample: npt.NDArray[np.intp], rate: float, threads: int) -> Floats:
    """One step of gradient descent on a sample of the beams.

    Since dr = dphi / |n . u|, an error e = o - r requires dphi = e |n . u| where the beam ends, with weight
    1 / |n . u|². Surfaces that most beams passed through are removed: planes extended past an edge, objects that moved.
    """
    ended, passed, up, norm = np.zeros((4, field.phi.size))
    for part in beams.parts(sample):
        _add_errors(field, part, ended, passed, up, norm, threads)
    absent = are_mostly_passed(ended, passed)
    phi = np.where(absent, np.maximum(field.phi.ravel(), CARVED_DISTANCE_CELLS * field.resolution), field.phi.ravel())
    step = np.divide(up, norm + 1.0, out=np.zeros_like(up))
    return np.asarray(phi.astype(np.float32) + rate * step, np.float32).reshape(field.phi.shape)


def _add_errors(
    field: DistanceField, beams: Beams, ended: Array, passed: Array, up: Array, norm: Array, threads: int
) -> None:
    """Adds to each node (ny * nx,) the beams that ended and passed there, their weighted errors and their weights."""

    def trace(part: Beams) -> Array:
        traced = field.trace(np.column_stack([part.starts, part.directions]), np.zeros(1))
        return np.column_stack([traced.ranges, traced.cos_incidence])

    ranges, cos_incidence = np.concatenate(_map_parts(trace, beams, threads)).T
    unit = beams.unit()
    error = beams.ranges - ranges
    good = np.isfinite(ranges) & (np.abs(error) < MAX_ERROR_M) & (cos_incidence > MIN_COS_INCIDENCE)
    behind = np.where(np.isfinite(ranges), error, 0.0) * cos_incidence  # m, perpendicular to the surface
    ny, nx = field.phi.shape
    for counts, which in ((ended, good), (passed, np.isfinite(ranges) & (behind > PASSED_DEPTH_M))):
        where = (beams.starts[which] + ranges[which, None] * unit[which] - field.origin) / field.resolution
        node = np.clip(np.round(where).astype(int), 0, [nx - 1, ny - 1])
        np.add(counts, np.bincount(node[:, 1] * nx + node[:, 0], minlength=ny * nx), out=counts)
    cos_incidence = cos_incidence[good]
    where = (beams.starts[good] + ranges[good, None] * unit[good] - field.origin) / field.resolution
    node = np.minimum(np.maximum(where.astype(int), 0), [nx - 2, ny - 2])
    u, v = (where - node).T
    for di, dj, w in ((0, 0, (1 - u) * (1 - v)), (0, 1, u * (1 - v)), (1, 0, (1 - u) * v), (1, 1, u * v)):
        index = (node[:, 1] + di) * nx + node[:, 0] + dj
        up += np.bincount(index, w * error[good] / cos_incidence, ny * nx)
        norm += np.bincount(index, w / cos_incidence**2, ny * nx)


def learn_scales(field: DistanceField, poses: Array, mount: Array, angles: Array, ranges: Array, sigma: float) -> Array:
    """Standard deviation (m) of the model's error in each class of beams, the learned precision.

    Fitted by expectation maximisation to scans ``ranges`` (N, B) from which the model has not learned; a uniform
    density takes the outliers.
    """
    traced = field.trace(compose(poses, mount), angles)
    both = np.isfinite(ranges) & np.isfinite(traced.ranges)
    square, kind = (ranges[both] - traced.ranges[both]) ** 2, traced.classes()[both]
    size = int(np.prod(CLASSES))
    variance = np.full(size, PRIOR_SCALE_M**2)
    for _ in range(EM_STEPS):
        s2 = variance[kind] + sigma**2
        core = (1 - OUTLIER_SHARE) * np.exp(-0.5 * square / s2) / np.sqrt(2 * np.pi * s2)
        inlier = core / (core + OUTLIER_SHARE / OUTLIER_RANGE_M)
        count, total = np.bincount(kind, inlier, size), np.bincount(kind, inlier * square, size)
        prior_total = PRIOR_COUNT * (PRIOR_SCALE_M**2 + sigma**2)
        variance = np.maximum((total + prior_total) / (count + PRIOR_COUNT) - sigma**2, MIN_SCALE_M**2)
    return np.asarray(np.sqrt(variance))
