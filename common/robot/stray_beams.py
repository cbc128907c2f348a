"""Beams that end where no others do, such as those that leave the building through a window."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import Array

CELL_M = 1.0  # of the grid in which beam ends are grouped
MIN_ENDS_PER_CELL = 3  # in a cell with fewer, beams are stray


def has_neighbours(ends: Array) -> npt.NDArray[np.bool_]:
    """Mask (R,) of the end points (R, 2) m that have others near them.

    Without this filter a few stray beams would make a grid as large as the scanner's range.
    """
    if not len(ends):
        return np.zeros(0, np.bool_)
    cell = np.floor(ends / CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    index = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    # Counted without an array of all cells, which would be huge for ranges that are not in m.
    _, of_end, counts = np.unique(index, return_inverse=True, return_counts=True)
    return np.asarray(counts[of_end] >= MIN_ENDS_PER_CELL)
