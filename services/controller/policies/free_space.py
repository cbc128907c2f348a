"""Free space on a grid, with distances to walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry.floors import place_text
from common.geometry.occupancy_grid import OCCUPIED, UNKNOWN

if TYPE_CHECKING:
    from common.geometry.floors import Floor
    from common.geometry.occupancy_grid import OccupancyGrid
    from common.geometry.se2 import Array
    from common.geometry.world import World

RESOLUTION_M = 0.1  # cell size for planning
MAX_CELLS = 2_000_000  # a world that would need more cells gets larger ones
MAX_CLEARANCE_M = 3.0  # in a growing map; computing larger ones would take long


@dataclass(frozen=True)
class Grid:
    """Square cells over a rectangle of the map. Arrays over it are (rows along y, columns along x)."""

    origin: tuple[float, float]  # m in map, lower left corner of the first cell
    resolution: float  # m
    shape: tuple[int, int]  # rows, columns

    @classmethod
    def over(cls, world: World, resolution: float = RESOLUTION_M) -> Grid:
        """Grid over the world's bounding box."""
        x0, y0, x1, y1 = world.bounds
        resolution = max(resolution, float(np.sqrt((x1 - x0) * (y1 - y0) / MAX_CELLS)))
        rows, columns = (int(np.ceil(side / resolution - 1e-9)) for side in (y1 - y0, x1 - x0))
        return cls((x0, y0), resolution, (rows, columns))

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    def centres(self, cells: npt.ArrayLike | None = None) -> Array:
        """Centres (N, 2) m in map of the cells with these flat indices. Defaults to all cells, row by row."""
        rows, columns = np.divmod(np.arange(self.cell_count) if cells is None else np.asarray(cells), self.shape[1])
        return np.stack([columns + 0.5, rows + 0.5], axis=-1) * self.resolution + self.origin

    def cell_of(self, points: Array) -> npt.NDArray[np.intp]:
        """Flat index (N,) of the cell that contains each point (N, 2) m, or of the nearest cell for points outside."""
        rows, columns = self.shape
        position = np.floor((np.asarray(points) - self.origin) / self.resolution).astype(int)
        row = np.minimum(np.maximum(position[..., 1], 0), rows - 1)  # np.clip is slow on small arrays
        return np.asarray(row * columns + np.minimum(np.maximum(position[..., 0], 0), columns - 1))

    def cells_near(self, point: Array, within: float) -> npt.NDArray[np.intp]:
        """Flat indices (N,) of the cells of a square around a point (2,) m, with all whose centres are ``within`` m."""
        rows, columns = self.shape
        lowest = np.floor((np.asarray(point) - within - self.origin) / self.resolution).astype(int)
        highest = np.floor((np.asarray(point) + within - self.origin) / self.resolution).astype(int)
        column = np.arange(max(lowest[0], 0), min(highest[0], columns - 1) + 1)
        row = np.arange(max(lowest[1], 0), min(highest[1], rows - 1) + 1)
        return np.asarray((row[:, None] * columns + column).ravel())

    def inside(self, points: Array) -> npt.NDArray[np.bool_]:
        """Whether each point (N, 2) m lies on the grid; (N,) bool."""
        position = (np.asarray(points) - self.origin) / self.resolution
        return np.asarray(np.all((position >= 0) & (position < self.shape[::-1]), axis=-1))

    def interpolate(self, values: Array, points: Array) -> Array:
        """Bilinear interpolation of ``values`` (rows, columns) at points (..., 2) m; returns (...,).

        Beyond the outermost cell centres the values are constant.
        """
        rows, columns = self.shape
        position = (np.asarray(points) - self.origin) / self.resolution - 0.5
        x = np.minimum(np.maximum(position[..., 0], 0), columns - 1)
        y = np.minimum(np.maximum(position[..., 1], 0), rows - 1)
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
    """Distances to the walls of the map on a grid."""

    grid: Grid
    clearance: Array  # (rows, columns) m from a cell's centre to the nearest wall; negative inside walls
    unknown: npt.NDArray[np.bool_]  # (rows, columns) whether nothing is known about a cell
    floors: tuple[Floor, ...] = ()  # of the building

    @classmethod
    def of(cls, world: World, resolution: float = RESOLUTION_M) -> FreeSpace:
        """Free space of a world; clearances are exact at the cell centres."""
        grid = Grid.over(world, resolution)
        centres = grid.centres().reshape(*grid.shape, 2)
        clearance = world.clearance_on_lattice(centres[0, :, 0], centres[:, 0, 1])
        return cls(grid, clearance, np.zeros(grid.shape, bool), tuple(world.floors))

    @classmethod
    def of_map(cls, cells: OccupancyGrid) -> FreeSpace:
        """Free space of a map that is still growing. Only occupied cells are walls; its yaw must be 0.

        A cell of the result is a square of cells of the map, and unknown if none of these is known.
        """
        factor = max(1, round(RESOLUTION_M / cells.resolution))
        values = np.pad(
            cells.values,
            [(0, -cells.height % factor), (0, -cells.width % factor)],
            constant_values=UNKNOWN,
        )
        shape = (values.shape[0] // factor, values.shape[1] // factor)
        grid = Grid(cells.origin[:2], factor * cells.resolution, shape)
        known = (values != UNKNOWN).reshape(shape[0], factor, shape[1], factor).any(axis=(1, 3))
        centres = grid.centres().reshape(*shape, 2)
        clearance = cells.geometry.lattice_distances(OCCUPIED, centres[0, :, 0], centres[:, 0, 1], MAX_CLEARANCE_M)
        return cls(grid, clearance, ~known)

    def place_text(self, place: Array, decimals: int = 2) -> str:
        """A point (2,) in map for messages to users, on a floor in its frame."""
        return place_text(self.floors, place, decimals)

    def clearance_at(self, points: Array) -> Array:
        """Interpolated distance (...,) m from points (..., 2) m in map to the nearest wall."""
        return self.grid.interpolate(self.clearance, points)

    def normal_at(self, points: Array) -> Array:
        """Direction (..., 2) in which the clearance grows at points (..., 2) m: near a wall, its normal."""
        step = self.grid.resolution / 2 * np.eye(2)
        slope = np.stack([self.clearance_at(points + e) - self.clearance_at(points - e) for e in step], axis=-1)
        return np.asarray(slope / np.maximum(np.hypot(slope[..., 0], slope[..., 1]), 1e-9)[..., None])


# Stands for the map before the first one arrives: no cell is free.
NO_MAP = FreeSpace(Grid((0.0, 0.0), RESOLUTION_M, (1, 1)), np.full((1, 1), -1.0), np.zeros((1, 1), bool))
