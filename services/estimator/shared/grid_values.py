"""Values of a grid at given cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt


def values_at(
    grid: npt.NDArray[Any], row: npt.NDArray[np.integer], column: npt.NDArray[np.integer], beyond: float
) -> npt.NDArray[Any]:
    """The values (N,) of a grid (rows, columns) at the cells (N,); ``beyond``, whose type they have, outside of it."""
    inside = (row >= 0) & (column >= 0) & (row < grid.shape[0]) & (column < grid.shape[1])
    values = np.full(len(row), beyond)
    values[inside] = grid[row[inside], column[inside]]
    return values
