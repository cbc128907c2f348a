"""Values of a grid at given cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt


def are_inside(
    shape: tuple[int, ...], row: npt.NDArray[np.integer], column: npt.NDArray[np.integer]
) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the cells (N,) that are inside a grid of this shape (rows, columns)."""
    return np.asarray((row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1]))


def values_at(
    grid: npt.NDArray[Any], row: npt.NDArray[np.integer], column: npt.NDArray[np.integer], beyond: float | np.generic
) -> npt.NDArray[Any]:
    """The values (N,) of a grid (rows, columns) at the cells (N,).

    Cells outside the grid have the value ``beyond``; the result has the type of ``beyond``.
    """
    inside = are_inside(grid.shape, row, column)
    values = np.full(len(row), beyond)
    values[inside] = grid[row[inside], column[inside]]
    return values
