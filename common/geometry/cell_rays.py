"""Exact ray casting against the square cells of an occupancy grid.

Amanatides and Woo (A Fast Voxel Traversal Algorithm, 1987), with squares of empty cells in the place of cells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

LEVELS = 6  # squares of 3, 5, 9, 17, 33, 65 cells a side
RAYS = 200_000  # at once, about 20 MB


class CellRays:
    """Occupied cells, prepared for rays."""

    def __init__(self, occupied: npt.NDArray[np.bool_]) -> None:
        """From (rows, columns) bool."""
        self.occupied = np.pad(occupied, 1)  # so that a ray that leaves leaves into an empty cell
        self.clear = clear_radius(self.occupied)  # (rows + 2, columns + 2) uint8

    def distances(self, x: Array, y: Array, dx: Array, dy: Array) -> Array:
        """(N,) in cells from (x, y), in cells from the lower left corner, along unit vectors; +inf: nothing is hit.

        A ray that begins in an occupied cell is hit where it leaves the last one, as among outlines.
        """
        parts = [
            self._block(*(values[i : i + RAYS] for values in (x + 1, y + 1, dx, dy))) for i in range(0, len(x), RAYS)
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
        began = self.occupied[row, column]
        with np.errstate(divide="ignore", invalid="ignore"):
            while len(rays):
                radius = self.clear[row, column].astype(int)
                to_x = np.where(dx == 0, np.inf, (column + np.where(dx > 0, radius + 1, -radius) - x) / dx)
                to_y = np.where(dy == 0, np.inf, (row + np.where(dy > 0, radius + 1, -radius) - y) / dy)
                over_x = to_x <= to_y
                at = np.where(over_x, to_x, to_y)
                # Along the other axis never back, whatever the last digit says: so it comes to an end.
                column = np.where(over_x, _out(column, radius, dx), _on(x + at * dx, column, radius, dx))
                row = np.where(over_x, _on(y + at * dy, row, radius, dy), _out(row, radius, dy))
                on = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
                hit = on.copy()
                hit[on] = self.occupied[row[on], column[on]] != began[on]
                found[rays[hit]] = at[hit]
                go = on & ~hit
                rays, x, y, dx, dy, column, row, began = (
                    values[go] for values in (rays, x, y, dx, dy, column, row, began)
                )
        return found

    def _enter(self, x: Array, y: Array, dx: Array, dy: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """(N,) how far along a ray the cells begin, 0 within them, and whether they ever do."""
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
    """(rows, columns) how many cells to every side of a cell are empty, as it is; 0 in occupied ones too."""
    clear = np.zeros(occupied.shape, np.uint8)
    near = occupied
    for level in range(LEVELS):
        near = _spread(near, 2 ** max(level - 1, 0))
        clear[~near] = 2**level
    return clear


def _spread(mask: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    """A mask of squares of radius ``by`` or more, or of cells for 1, wider by that much to every side."""
    for _ in range(2):
        wide = mask.copy()
        wide[by:] |= mask[:-by]
        wide[:-by] |= mask[by:]
        mask = wide.T
    return mask


def _out(cell: npt.NDArray[np.int_], radius: npt.NDArray[np.int_], along: Array) -> npt.NDArray[np.int_]:
    """The next cell beyond the square."""
    return np.asarray(np.where(along > 0, cell + radius + 1, cell - radius - 1))


def _on(where: Array, cell: npt.NDArray[np.int_], radius: npt.NDArray[np.int_], along: Array) -> npt.NDArray[np.int_]:
    """The cell that ``where`` lies in, of those ahead in the square."""
    ahead = along >= 0
    low, high = np.where(ahead, cell, cell - radius), np.where(ahead, cell + radius, cell)
    return np.asarray(np.clip(np.floor(where).astype(int), low, high))
