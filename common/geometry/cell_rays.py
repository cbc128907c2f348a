"""Exact ray casting against the square cells of an occupancy grid.

Grid traversal after Amanatides and Woo (A Fast Voxel Traversal Algorithm, 1987), in steps over squares of empty cells
instead of single cells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

CLEAR_LEVELS = 6  # sizes of empty squares: 3, 5, 9, 17, 33, 65 cells along a side
RAYS_PER_BLOCK = 200_000  # need about 20 MB of temporary memory


class CellRays:
    """Casts rays against the occupied cells of one grid."""

    def __init__(self, occupied: npt.NDArray[np.bool_]) -> None:
        """``occupied`` has shape (rows, columns)."""
        self.occupied = np.pad(occupied, 1)  # a border of empty cells, into which rays leave the grid
        self.clear = clear_radius(self.occupied)  # (rows + 2, columns + 2) uint8

    def distances(self, x: Array, y: Array, dx: Array, dy: Array) -> Array:
        """(N,) distances in cells from (x, y) along unit vectors (dx, dy); +inf if nothing is hit.

        x and y are in cells from the lower left corner. A ray that starts in an occupied cell ends where it enters an
        empty one, as with rays against the outlines of the cells.
        """
        parts = [
            self._block(*(values[i : i + RAYS_PER_BLOCK] for values in (x + 1, y + 1, dx, dy)))
            for i in range(0, len(x), RAYS_PER_BLOCK)
        ]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _block(self, x: Array, y: Array, dx: Array, dy: Array) -> Array:
        found = np.full(len(x), np.inf)
        rows, columns = self.occupied.shape
        at, entered = self._enter(x, y, dx, dy)
        rays = np.flatnonzero(entered)
        x, y, dx, dy, at = x[rays], y[rays], dx[rays], dy[rays], at[rays]
        column = np.clip(np.floor(x + at * dx).astype(int), 0, columns - 1)
        row = np.clip(np.floor(y + at * dy).astype(int), 0, rows - 1)
        started_occupied = self.occupied[row, column]
        with np.errstate(divide="ignore", invalid="ignore"):
            while len(rays):
                radius = self.clear[row, column].astype(int)
                to_x = np.where(dx == 0, np.inf, (column + np.where(dx > 0, radius + 1, -radius) - x) / dx)
                to_y = np.where(dy == 0, np.inf, (row + np.where(dy > 0, radius + 1, -radius) - y) / dy)
                across_x = to_x <= to_y
                at = np.where(across_x, to_x, to_y)
                # Rounding errors never move a ray backwards along the other axis, so that the loop ends.
                column = np.where(across_x, _step_out(column, radius, dx), _cell_at(x + at * dx, column, radius, dx))
                row = np.where(across_x, _cell_at(y + at * dy, row, radius, dy), _step_out(row, radius, dy))
                on_grid = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
                hit = on_grid.copy()
                hit[on_grid] = self.occupied[row[on_grid], column[on_grid]] != started_occupied[on_grid]
                found[rays[hit]] = at[hit]
                active = on_grid & ~hit
                rays, x, y, dx, dy, column, row, started_occupied = (
                    values[active] for values in (rays, x, y, dx, dy, column, row, started_occupied)
                )
        return found

    def _enter(self, x: Array, y: Array, dx: Array, dy: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """(N,) distance along each ray at which it enters the grid (0 inside), and whether it enters at all."""
        rows, columns = self.occupied.shape
        first, last = np.zeros(len(x)), np.full(len(x), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for start, along, size in ((x, dx, columns), (y, dy, rows)):
                near, far = -start / along, (size - start) / along
                within = (start >= 0) & (start < size)
                near, far = (
                    np.where(along == 0, np.where(within, -np.inf, np.inf), np.minimum(near, far)),
                    np.where(along == 0, np.where(within, np.inf, -np.inf), np.maximum(near, far)),
                )
                first, last = np.maximum(first, near), np.minimum(last, far)
        return first, first < last


def clear_radius(occupied: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """(rows, columns) half-widths in cells of an empty square around each cell; 0 for occupied cells."""
    clear = np.zeros(occupied.shape, np.uint8)
    near = occupied
    for level in range(CLEAR_LEVELS):
        near = _dilate(near, 2 ** max(level - 1, 0))
        clear[~near] = 2**level
    return clear


def _dilate(mask: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    """Grow a mask by ``by`` cells to every side; it has to consist of squares at least that wide."""
    for _ in range(2):
        grown = mask.copy()
        grown[by:] |= mask[:-by]
        grown[:-by] |= mask[by:]
        mask = grown.T
    return mask


def _step_out(cell: npt.NDArray[np.int_], radius: npt.NDArray[np.int_], along: Array) -> npt.NDArray[np.int_]:
    """The first cell beyond the empty square around ``cell``, in the direction of the ray along this axis."""
    return np.asarray(np.where(along > 0, cell + radius + 1, cell - radius - 1))


def _cell_at(
    position: Array, cell: npt.NDArray[np.int_], radius: npt.NDArray[np.int_], along: Array
) -> npt.NDArray[np.int_]:
    """The cell at ``position``, limited to the cells of the empty square that the ray has not passed yet."""
    forward = along >= 0
    low, high = np.where(forward, cell, cell - radius), np.where(forward, cell + radius, cell)
    return np.asarray(np.clip(np.floor(position).astype(int), low, high))
