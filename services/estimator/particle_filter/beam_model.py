"""The beam model (Thrun et al. 2005, chapter 6.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from common.errors import UserError

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.geometry.world import World

HEADINGS = 360  # of the table; ranges are interpolated between them
MAX_CELLS = 20_000_000  # of the table of expected ranges


@dataclass(frozen=True)
class BeamModel:
    """Mixture of hit, short, max and random measurements; the weights z are normalised to sum to 1."""

    z_hit: float
    z_short: float
    z_max: float
    z_rand: float
    sigma_hit: float  # m
    lambda_short: float  # 1/m

    def log_density(self, ranges: Array, expected: Array, range_max: float) -> Array:
        """Log density (N, B) of ranges (B,) m, given the ranges ``expected`` (N, B) m at each pose.

        For a beam without return (+inf) it is the log of a probability instead. A beam that was not measured (-inf or
        NaN) has 0 for every pose.

        Hit and short are normalised over the ranges that can be measured, [0, range_max] and [0, expected], as in the
        book. Where no return is expected, there is no short component, and a maximum reading takes the place of a hit.
        """
        total = self.z_hit + self.z_short + self.z_max + self.z_rand
        far = expected >= range_max
        mean = np.minimum(expected, range_max)
        not_measured = np.isneginf(ranges) | np.isnan(ranges)
        missed = not_measured | (ranges >= range_max)
        z = np.where(missed, 0.0, np.maximum(ranges, 0.0))
        root = math.sqrt(2) * self.sigma_hit
        # The part of the Gaussian within [0, range_max]: nearly always 1, so it is computed only near the limits.
        edge = (mean < 5 * self.sigma_hit) | (mean > range_max - 5 * self.sigma_hit)
        inside = np.ones_like(mean)
        inside[edge] = ndtr((range_max - mean[edge]) / self.sigma_hit) - ndtr(-mean[edge] / self.sigma_hit)
        hit = np.exp(-(((z - mean) / root) ** 2)) / (root * math.sqrt(math.pi) * inside)
        lam = self.lambda_short
        short = np.where(z <= mean, lam * np.exp(-lam * z) / -np.expm1(-lam * np.maximum(mean, 1e-6)), 0.0)
        random = self.z_rand / range_max
        measured = np.where(far, random, self.z_hit * hit + self.z_short * short + random)
        nothing = np.where(far, self.z_hit + self.z_short + self.z_max, self.z_max)
        log = np.log(np.maximum(np.where(missed, nothing, measured) / total, 1e-300))
        return np.asarray(np.where(not_measured, 0.0, log))


class RangeTable:
    """Ranges in all directions from the cells of a grid, cast when a cell is first needed."""

    def __init__(self, world: World, resolution: float = 0.05) -> None:
        """``resolution`` is the size of a cell in m. Raises UserError if there are too many cells."""
        x0, y0, x1, y1 = world.bounds
        self.world, self.resolution, self.origin = world, resolution, np.array([x0, y0])
        nx, ny = int(np.ceil((x1 - x0) / resolution)), int(np.ceil((y1 - y0) / resolution))
        if nx * ny > MAX_CELLS:
            raise UserError(f"world {world.name!r}: {nx} x {ny} cells of {resolution} m are too many for a table")
        self._limit = np.array([nx - 1, ny - 1])
        self._row = np.full(nx * ny, -1, np.int32)
        self._ranges: npt.NDArray[np.float32] = np.zeros((0, HEADINGS), np.float32)
        self._angles: Array = 2 * np.pi / HEADINGS * np.arange(HEADINGS, dtype=float)

    def ranges(self, poses: Array, angles: Array) -> Array:
        """Approximate ranges (N, B) in m from scanner poses (N, 3) in map along ``angles`` (B,).

        They are those from the middle of each pose's cell.
        """
        ij = np.clip(np.floor((poses[:, :2] - self.origin) / self.resolution).astype(int), 0, self._limit)
        cells = ij[:, 0] * (self._limit[1] + 1) + ij[:, 1]
        self._cast(np.unique(cells[self._row[cells] < 0]))
        direction = ((poses[:, 2:3] + angles) % (2 * np.pi)) * (HEADINGS / (2 * np.pi))
        low = np.floor(direction).astype(int)
        rows, part = self._row[cells][:, None], direction - low
        a, b = self._ranges[rows, low % HEADINGS], self._ranges[rows, (low + 1) % HEADINGS]
        # At a silhouette the nearer heading is used, because interpolated ranges would end in free space.
        with np.errstate(invalid="ignore"):
            smooth = np.abs(a - b) < 0.1 * np.minimum(a, b)
            return np.asarray(np.where(smooth, a + part * (b - a), np.where(part < 0.5, a, b)), float)

    def _cast(self, cells: npt.NDArray[np.int_]) -> None:
        if len(cells) == 0:
            return
        ij = np.stack(np.divmod(cells, self._limit[1] + 1), axis=-1)
        middles = np.column_stack([self.origin + (ij + 0.5) * self.resolution, np.zeros(len(cells))])
        self._row[cells] = len(self._ranges) + np.arange(len(cells), dtype=np.int32)
        found = self.world.ray_distances(middles, self._angles)
        self._ranges = np.concatenate([self._ranges, found.astype(np.float32)])
