"""Converts a polygon world to an occupancy grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shapely

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

CELL, MAX_CELLS = 0.05, 4_000_000  # m; larger worlds get larger cells


def classify_points(world: World, x: Array, y: Array, cell: float) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Which places x, y (rows, columns) m are free, and which are drawn as walls and furniture."""
    if world.grid is not None:
        values = world.grid.at(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(x.shape)
        covered = shapely.contains_xy(world.furniture, x, y)
        return (values == FREE) & ~covered, (values == OCCUPIED) | covered
    free = shapely.contains_xy(world.free_space, x, y)
    around = shapely.Polygon(world.boundary).buffer(1.5 * cell, join_style="mitre")
    return free, shapely.contains_xy(around, x, y) & ~free


def cell_centres(world: World, finest: float = CELL) -> tuple[tuple[float, float], float, Array, Array]:
    """Lower left corner (m), edge of a cell (m), and x, y (rows, columns) m of cells all over a world and its walls."""
    x0, y0, x1, y1 = world.bounds
    cell = max(finest, float(np.sqrt((x1 - x0) * (y1 - y0) / MAX_CELLS)))
    x0, y0 = x0 - 2 * cell, y0 - 2 * cell
    columns, rows = int(np.ceil((x1 - x0) / cell)) + 2, int(np.ceil((y1 - y0) / cell)) + 2
    x, y = np.meshgrid(x0 + cell * (np.arange(columns) + 0.5), y0 + cell * (np.arange(rows) + 0.5))
    return (x0, y0), cell, x, y


def rasterise(world: World, cell: float = CELL) -> OccupancyGrid:
    """A ROS map's own cells, with what furniture covers of them; else a map of the polygons, unknown outside them.

    Nothing is too thin for a cell: what lies within half a cell of a middle is there.
    """
    if world.grid is not None:
        grid = world.grid
        if not world.obstacles:
            return grid
        columns, rows = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
        x, y = grid.to_map(np.stack([columns, rows], axis=-1).reshape(-1, 2) * grid.resolution).T
        covered = _covered(world, x, y, grid.resolution).reshape(columns.shape)
        return OccupancyGrid.of(np.where(covered, OCCUPIED, grid.values), grid.resolution, grid.origin)
    (x0, y0), cell, x, y = cell_centres(world, cell)
    free, wall = classify_points(world, x, y, cell)
    values = np.select([_covered(world, x, y, cell), free, wall], [OCCUPIED, FREE, OCCUPIED], UNKNOWN)
    return OccupancyGrid.of(values, cell, (x0, y0, 0.0))


def _covered(world: World, x: Array, y: Array, cell: float) -> npt.NDArray[np.bool_]:
    return np.asarray(shapely.contains_xy(shapely.buffer(world.furniture, cell / 2), x, y))
