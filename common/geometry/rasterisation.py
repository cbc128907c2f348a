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

CELL_M, MAX_CELLS = 0.05, 4_000_000  # worlds that would need more cells get larger ones


def classify_points(
    world: World, x: Array, y: Array, cell: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Masks (rows, columns) of the points x, y in m: those that are free, and those drawn as walls or furniture."""
    if world.grid is not None:
        values = world.grid.values_at(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(x.shape)
        covered = shapely.contains_xy(world.furniture, x, y)
        return (values == FREE) & ~covered, (values == OCCUPIED) | covered
    free = shapely.contains_xy(world.free_space, x, y)
    rooms = shapely.multipolygons([shapely.Polygon(ring) for ring in world.wall_rings])
    around = rooms.buffer(1.5 * cell, join_style="mitre")
    return free, shapely.contains_xy(around, x, y) & ~free


def cell_centres(world: World, min_cell: float = CELL_M) -> tuple[tuple[float, float], float, Array, Array]:
    """A grid over a world and its walls.

    Returns its lower left corner in m, the edge length of a cell in m, and x and y of the cells' centres, (rows,
    columns) in m.
    """
    x0, y0, x1, y1 = world.bounds
    cell = max(min_cell, float(np.sqrt((x1 - x0) * (y1 - y0) / MAX_CELLS)))
    x0, y0 = x0 - 2 * cell, y0 - 2 * cell
    columns, rows = int(np.ceil((x1 - x0) / cell)) + 2, int(np.ceil((y1 - y0) / cell)) + 2
    x, y = np.meshgrid(x0 + cell * (np.arange(columns) + 0.5), y0 + cell * (np.arange(rows) + 0.5))
    return (x0, y0), cell, x, y


def rasterise(world: World, cell: float = CELL_M) -> OccupancyGrid:
    """Occupancy grid of a world; cells outside its walls are unknown.

    A world with a ROS map keeps the map's cells. Furniture occupies all cells with centres within half a cell of it, so
    that thin pieces are not lost.
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
