"""Exhaustive correlative scan matching (Olson, ICRA 2009) by branch and bound (Hess et al., ICRA 2016).

The whole map is searched for the cell and heading at which a likelihood field explains a scan best; Gauss-Newton steps
refine it. While the match is good, the next scan is matched nearby.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.estimator.particle_filter.sensor import ScanFit, Sensor
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.shared.interface import Hypothesis, Observation, Posterior, Predicted

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

CELL_M = 0.05
LEVELS = 5  # of the pyramid of maxima: the search begins with squares of 2^(LEVELS - 1) cells
SEARCH_BEAMS = 150
SEARCH_SIGMA_M = 0.05  # of a hit
CLEARANCE_M = 0.1  # of the laser from surfaces
MIN_FIT = 0.6  # Cartographer's least score for global localisation
NEARBY_SIGMAS_M = (0.2, 0.2, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05)  # of a hit, step by step
FINAL_SIGMAS_M = (0.05, 0.05, 0.05, 0.05)
MAX_STEP = np.array([0.1, 0.1, 0.1])  # m, m, rad

Single = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


class CorrelativeMatcher:
    """The pose at which a scan fits the map best; scan by scan, without a filter."""

    name = "correlative"

    def __init__(self, world: World, mount: tuple[float, float, float]) -> None:
        """``mount`` (3,) is the laser in base_link, m, m, rad."""
        self.world, self.mount = world, np.array(mount, float)
        self._sensor = Sensor(world, ParticleFilterSettings.tuned())
        x0, y0, x1, y1 = world.bounds
        margin = self._sensor.settings.laser_likelihood_max_dist
        self._low = np.array([x0, y0]) - margin
        columns, rows = np.ceil((np.array([x1, y1]) + margin - self._low) / CELL_M).astype(int)
        x, y = (start + CELL_M * (np.arange(n) + 0.5) for start, n in zip(self._low, (columns, rows), strict=True))
        distance = self._sensor.field.field(*np.meshgrid(x, y))
        self._free = pyramid((distance > CLEARANCE_M).astype(np.float32)) > 0
        self._scores = pyramid(np.exp(-0.5 * (distance / SEARCH_SIGMA_M) ** 2))
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Begins at ``pose`` (3,), or with a search of the whole map."""
        del covariance  # the search nearby has a fixed reach
        self._pose = None if pose is None or len(pose) < 3 else np.array(pose, float)
        self._odom: Array | None = None

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans by exact rays in the map."""
        ranges = self.world.ray_distances(se2.compose(poses, self.mount), angles)
        return Predicted(ranges, np.full(ranges.shape, FINAL_SIGMAS_M[-1]))

    def update(self, observation: Observation) -> Posterior:
        """Matches one more scan: near the last pose, and in the whole map if little fits there."""
        pose, odom = self._pose, self._odom
        if pose is not None and odom is not None and observation.odom is not None:
            pose = se2.compose(pose, se2.between(odom, observation.odom))
        self._odom = observation.odom
        found = None if pose is None else self._refine(pose, observation, NEARBY_SIGMAS_M)
        if found is None or found[1].fit < MIN_FIT:
            found = self._refine(self._search(observation), observation, FINAL_SIGMAS_M)
        pose, scan_fit = found
        good = scan_fit.fit >= MIN_FIT
        self._pose = pose if good else None
        covariance = np.asarray(np.linalg.inv(scan_fit.curvature + 1e-3 * np.eye(3)), float)
        laser = se2.compose(pose, self.mount)
        return Posterior(
            state="tracking" if good else "lost",
            hypotheses=(Hypothesis(pose, covariance, 1.0),),
            accuracy=scan_fit.accuracy,
            complexity=0.0,
            xi=scan_fit.xi,
            curvature=scan_fit.curvature,
            predicted=self.world.ray_distances(laser, observation.angles)[0],
        )

    def _refine(self, pose: Array, observation: Observation, sigmas: tuple[float, ...]) -> tuple[Array, ScanFit]:
        """The pose (3,) after a Gauss-Newton step for each of ``sigmas`` m, and what it explains."""
        pose = np.array(pose, float)
        for sigma in sigmas:
            found = self._sensor.explain(pose, self.mount, observation, sigma)
            step = np.linalg.solve(found.curvature + 1e-3 * np.eye(3), found.xi)
            pose = pose + np.clip(step, -MAX_STEP, MAX_STEP)
            pose[2] = se2.wrap(pose[2])
        return pose, self._sensor.explain(pose, self.mount, observation, sigmas[-1])

    def _search(self, observation: Observation) -> Array:
        """The best pose (3,) of base_link in the whole map."""
        used = np.flatnonzero(np.isfinite(observation.ranges) & (observation.ranges < observation.range_max))
        used = used[np.linspace(0, len(used) - 1, min(len(used), SEARCH_BEAMS)).astype(int)]
        ranges, angles = observation.ranges[used], observation.angles[used]
        turn = CELL_M / max(float(ranges.max(initial=1.0)), 1.0)
        headings = np.arange(0.0, 2 * np.pi, turn)
        directions = headings[:, None] + angles
        # The laser is in the middle of a cell.
        columns = np.floor(ranges * np.cos(directions) / CELL_M + 0.5).astype(np.int32)
        rows = np.floor(ranges * np.sin(directions) / CELL_M + 0.5).astype(np.int32)
        heading, row, column = best_cell(self._scores, self._free, rows, columns)
        place = self._low + CELL_M * (np.array([column, row]) + 0.5)
        laser = np.array([*place, se2.wrap(headings[heading])])
        return np.asarray(se2.compose(laser, se2.inverse(self.mount)))


def pyramid(values: Single) -> Single:
    """(LEVELS, rows, columns): at each level the maximum of the square of 2^level cells that begins at a cell."""
    levels = [np.asarray(values, np.float32)]
    for level in range(LEVELS - 1):
        below, half = levels[-1], 2**level
        padded = np.pad(below, ((0, half), (0, half)), mode="edge")
        parts = (below, padded[half:, :-half], padded[:-half, half:], padded[half:, half:])
        levels.append(np.maximum.reduce(parts))
    return np.stack(levels)


@numba.njit(cache=True, nogil=True)
def _score(level: Single, rows: npt.NDArray[np.int32], columns: npt.NDArray[np.int32], i: int, j: int) -> float:
    """Sum of the map at the ends (B,) of a scan whose laser is in cell i, j."""
    height, width = level.shape
    total = np.float32(0.0)
    for b in range(len(rows)):
        row, column = i + rows[b], j + columns[b]
        # Beyond the margin the map is as empty as at its corner.
        total += level[row, column] if 0 <= row < height and 0 <= column < width else level[0, 0]
    return float(total)


@numba.njit(cache=True, nogil=True)
def best_cell(
    scores: Single, free: Mask, rows: npt.NDArray[np.int32], columns: npt.NDArray[np.int32]
) -> tuple[int, int, int]:
    """Heading, row and column with the highest score, of ends (K, B) of a scan in cells, for K headings.

    ``scores`` and ``free`` are pyramids. A square of cells is divided only if its bound exceeds the best score so far.
    """
    roots, bounds = _roots(scores[-1], free[-1], rows, columns, 2 ** (len(scores) - 1))
    best, found = -np.inf, (0, 0, 0)
    for root in np.argsort(-bounds):
        if bounds[root] <= best:
            break
        k, i, j = roots[root]
        best, row, column = _best_within(scores, free, rows[k], columns[k], i, j, bounds[root], best)
        if row >= 0:
            found = (k, row, column)
    return found


@numba.njit(cache=True, nogil=True)
def _roots(
    score: Single, free: Mask, rows: npt.NDArray[np.int32], columns: npt.NDArray[np.int32], size: int
) -> tuple[npt.NDArray[np.int32], Single]:
    """Heading, row and column (N, 3) of the largest squares with free cells, and their bounds (N,)."""
    height, width = score.shape
    count = len(rows) * ((height + size - 1) // size) * ((width + size - 1) // size)
    roots, bounds, n = np.empty((count, 3), np.int32), np.empty(count, np.float32), 0
    for k in range(len(rows)):
        for i in range(0, height, size):
            for j in range(0, width, size):
                if free[i, j]:
                    roots[n, 0], roots[n, 1], roots[n, 2] = k, i, j
                    bounds[n] = _score(score, rows[k], columns[k], i, j)
                    n += 1
    return roots[:n], bounds[:n]


@numba.njit(cache=True, nogil=True)
def _best_within(
    scores: Single,
    free: Mask,
    rows: npt.NDArray[np.int32],
    columns: npt.NDArray[np.int32],
    i: int,
    j: int,
    bound: float,
    best: float,
) -> tuple[float, int, int]:
    """Depth first through one of the largest squares: the best score, with its cell, or -1 if it is not in here."""
    height, width = scores.shape[1:]
    found_row, found_column, depth = -1, -1, 1
    stack, stacked = np.empty((4 * len(scores), 3), np.int32), np.empty(4 * len(scores), np.float32)
    stack[0, 0], stack[0, 1], stack[0, 2], stacked[0] = len(scores) - 1, i, j, bound
    while depth:
        depth -= 1
        level, i, j, bound = stack[depth, 0], stack[depth, 1], stack[depth, 2], stacked[depth]
        if bound <= best:
            continue
        if level == 0:
            best, found_row, found_column = bound, i, j
            continue
        half, first = 2 ** (level - 1), depth
        for part in range(4):
            row, column = i + half * (part // 2), j + half * (part % 2)
            if row >= height or column >= width or not free[level - 1, row, column]:
                continue
            score = _score(scores[level - 1], rows, columns, row, column)
            place = depth  # keep the best part on top of the stack
            while place > first and stacked[place - 1] > score:
                stack[place], stacked[place] = stack[place - 1], stacked[place - 1]
                place -= 1
            stack[place, 0], stack[place, 1], stack[place, 2], stacked[place] = level - 1, row, column, score
            depth += 1
    return best, found_row, found_column
