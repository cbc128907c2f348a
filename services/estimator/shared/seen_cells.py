"""Cells that a map has seen: nothing is known about the others, so a model predicts nothing beyond them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

from common.geometry.grid_values import values_at
from common.geometry.occupancy_grid import UNKNOWN

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.geometry.world import World

SEEN_CELL_M = 0.2  # so large that neighbouring beams leave no gaps
ROWS_AT_ONCE = 256  # of a grid, to limit the memory


@dataclass(frozen=True)
class SeenCells:
    """Cells of a square grid that a beam has passed, or that a map shows; nothing is known about the other cells."""

    cells: npt.NDArray[np.bool_]  # (ny, nx); cell (i, j) begins at origin + SEEN_CELL_M * (j, i)
    origin: tuple[float, float]  # m in map

    @classmethod
    def of_world(cls, world: World) -> SeenCells | None:
        """The cells that contain a known cell of an occupancy grid, or a part of one; None if all is known."""
        grid = world.grid
        if grid is None or not (grid.values == UNKNOWN).any():
            return None
        low, high = np.min(grid.corners(), axis=0), np.max(grid.corners(), axis=0)
        cells = np.zeros(np.ceil((high - low) / SEEN_CELL_M).astype(int)[::-1] + 1, np.bool_)
        parts = math.ceil(2 * grid.resolution / SEEN_CELL_M)  # points per cell and axis
        middles = (np.arange(parts) + 0.5) / parts
        within = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 1, 2)
        for first in range(0, grid.height, ROWS_AT_ONCE):
            row, column = np.nonzero(grid.values[first : first + ROWS_AT_ONCE] != UNKNOWN)
            points = (np.column_stack([column, row + first]) + within).reshape(-1, 2) * grid.resolution
            j, i = np.floor((grid.to_map(points) - low) / SEEN_CELL_M).astype(int).T
            cells[i, j] = True
        return cls(cells, (float(low[0]), float(low[1])))

    def contains(self, points: Array) -> npt.NDArray[np.bool_]:
        """Mask (N,) of the points (N, 2) m in map that lie in seen cells."""
        j, i = np.floor((points - self.origin) / SEEN_CELL_M).astype(int).T
        return values_at(self.cells, i, j, beyond=False)

    def limit(self, lasers: Array, angles: Array, ranges: Array, jacobian: Array, scale: Array) -> None:
        """Ends beams (N, B) in place, with an infinite scale, once they have passed `SEEN_CELL_M` of unseen cells.

        Less is ignored, as where a beam cuts the corner of a cell.
        """
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        _end_in_unseen_cells(self.cells, *self.origin, SEEN_CELL_M, lasers, angles, ranges, jacobian, scale)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _end_in_unseen_cells(
    seen: npt.NDArray[np.bool_],
    ox: float,
    oy: float,
    h: float,
    lasers: Array,
    angles: Array,
    ranges: Array,
    jacobian: Array,
    scale: Array,
) -> None:
    """Ends each beam where it has passed more than ``h`` m, the edge length, of unseen cells, with infinite scale."""
    rows, columns = seen.shape
    for k in range(lasers.shape[0]):
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            unseen_length, t, step = 0.0, 0.0, 0.5 * h
            while t < ranges[k, b]:
                x, y = (lasers[k, 0] + t * ux - ox) / h, (lasers[k, 1] + t * uy - oy) / h
                inside = x >= 0.0 and x < columns and y >= 0.0 and y < rows
                if not inside or not seen[int(y), int(x)]:
                    unseen_length += step
                    if unseen_length > h:
                        ranges[k, b], scale[k, b] = t, np.inf
                        jacobian[k, b, :] = 0.0
                        break
                t += step
