"""Free space on a grid, with distances to walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

RESOLUTION = 0.1  # m, a cell's edge
LARGEST = 2_000_000  # cells; a larger world gets larger cells


@dataclass(frozen=True)
class Grid:
    """Square cells over a rectangle of the map; arrays over it are (rows along y, columns along x)."""

    origin: tuple[float, float]  # m, lower left corner of the first cell, in map
    resolution: float  # m
    shape: tuple[int, int]  # rows, columns

    @classmethod
    def over(cls, world: World, resolution: float = RESOLUTION) -> Grid:
        """The world's bounding box."""
        x0, y0, x1, y1 = world.bounds
        resolution = max(resolution, float(np.sqrt((x1 - x0) * (y1 - y0) / LARGEST)))
        rows, columns = (int(np.ceil(side / resolution - 1e-9)) for side in (y1 - y0, x1 - x0))
        return cls((x0, y0), resolution, (rows, columns))

    @property
    def cells(self) -> int:
        """How many."""
        return self.shape[0] * self.shape[1]

    def centres(self, cells: npt.ArrayLike | None = None) -> Array:
        """(N, 2) m in map of the cells with these flat numbers, or of all, row by row."""
        rows, columns = np.divmod(np.arange(self.cells) if cells is None else np.asarray(cells), self.shape[1])
        return np.stack([columns + 0.5, rows + 0.5], axis=-1) * self.resolution + self.origin

    def cell_of(self, points: Array) -> npt.NDArray[np.intp]:
        """(N,) flat number of the cell each point (N, 2) lies in; outside, of the nearest one."""
        rows, columns = self.shape
        where = np.floor((np.asarray(points) - self.origin) / self.resolution).astype(int)
        row = np.minimum(np.maximum(where[..., 1], 0), rows - 1)  # np.clip is slow on few
        return np.asarray(row * columns + np.minimum(np.maximum(where[..., 0], 0), columns - 1))

    def inside(self, points: Array) -> npt.NDArray[np.bool_]:
        """(N,) bool."""
        where = (np.asarray(points) - self.origin) / self.resolution
        return np.asarray(np.all((where >= 0) & (where < self.shape[::-1]), axis=-1))

    def between(self, values: Array, points: Array) -> Array:
        """(...,) ``values`` (rows, columns) at points (..., 2) m: bilinear between centres, constant beyond them."""
        rows, columns = self.shape
        where = (np.asarray(points) - self.origin) / self.resolution - 0.5
        x = np.minimum(np.maximum(where[..., 0], 0), columns - 1)
        y = np.minimum(np.maximum(where[..., 1], 0), rows - 1)
        i, j = np.minimum(y.astype(int), max(rows - 2, 0)), np.minimum(x.astype(int), max(columns - 2, 0))
        u, v = x - j, y - i
        flat, here = values.ravel(), i * columns + j
        right, up = (1 if columns > 1 else 0), (columns if rows > 1 else 0)
        return np.asarray(
            (1 - v) * ((1 - u) * flat[here] + u * flat[here + right])
            + v * ((1 - u) * flat[here + up] + u * flat[here + up + right])
        )


@dataclass(frozen=True)
class FreeSpace:
    """What the map knows."""

    grid: Grid
    clearance: Array  # (rows, columns) m from a cell's centre to the nearest wall; negative inside

    @classmethod
    def of(cls, world: World, resolution: float = RESOLUTION) -> FreeSpace:
        """Of a world, exactly at the cells' centres."""
        grid = Grid.over(world, resolution)
        middles = grid.centres().reshape(*grid.shape, 2)
        return cls(grid, world.clearances(middles[0, :, 0], middles[:, 0, 1]))

    def clear(self, points: Array) -> Array:
        """(...,) m from points (..., 2) to the nearest wall, interpolated."""
        return self.grid.between(self.clearance, points)
