"""The moves on a grid as a matrix, from which scipy finds cheapest paths: a reference for `grid_paths`."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix

MOVES = [(r, c) for r in range(-2, 3) for c in range(-2, 3) if np.gcd(r, c) == 1]


def moves(cell_cost: np.ndarray) -> coo_matrix:
    """Costs (cells, cells) of all possible moves, given the cost of each cell, +inf where it is not free."""
    rows, columns = cell_cost.shape
    padded = np.pad(cell_cost, 2, constant_values=np.inf)

    def at(r: int, c: int) -> np.ndarray:
        """Cost of the cell at this offset from each cell."""
        return padded[2 + r : 2 + r + rows, 2 + c : 2 + c + columns]

    starts, ends, costs = [], [], []
    for r, c in MOVES:
        # A cell is passed over if its centre is less than 0.8 from the middle of the move.
        near = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if np.hypot(i - r / 2, j - c / 2) < 0.8]
        possible = np.all([np.isfinite(at(i, j)) for i, j in [(0, 0), (r, c), *near]], axis=0)
        row, column = np.nonzero(possible)
        starts.append(row * columns + column)
        ends.append((row + r) * columns + column + c)
        costs.append(np.hypot(r, c) * (at(0, 0) + at(r, c))[possible] / 2)
    pairs = np.concatenate(starts), np.concatenate(ends)
    return coo_matrix((np.concatenate(costs), pairs), shape=(cell_cost.size, cell_cost.size))
