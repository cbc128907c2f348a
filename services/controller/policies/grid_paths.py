"""Cheapest paths on a grid with 16 neighbours, by Dijkstra's algorithm, compiled by numba.

``cell_cost`` (rows, columns) is the cost of crossing a cell along its side, +inf where a cell is not free. A move costs
its length times the mean of its two cells; the cells that it passes over must be free as well. Other arrays are flat.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

    Cells = npt.NDArray[np.int64]
    Mask = npt.NDArray[np.bool_]

NO_CELL = -1  # the next cell at the end of a path, and of a cell from which there is none
# Rows and columns of each move, then those of two cells that it passes over: none for the first four, which repeat
# their end; the two beside a diagonal; and the two in the middle of a knight's move.
_MOVES = np.array(
    [(r, c, r, c, r, c) for r, c in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    + [(r, c, r, 0, 0, c) for r in (1, -1) for c in (1, -1)]
    + [(2 * r, c, r, 0, r, c) for r in (1, -1) for c in (1, -1)]
    + [(r, 2 * c, 0, c, r, c) for r in (1, -1) for c in (1, -1)]
)
_LENGTHS = np.hypot(_MOVES[:, 0], _MOVES[:, 1])


def prepare() -> None:
    """Compiles the loops, or loads their compiled code, so that the first path does not have to wait for it."""
    known = cheapest_paths(np.ones((2, 2)), np.zeros(1, int), np.zeros(1))
    repaired_paths(np.ones((2, 2)), known, np.ones(1, int), 0, np.inf)


def cheapest_paths(
    cell_cost: Array, starts: Cells, start_costs: Array, limit: float = np.inf
) -> tuple[Array, npt.NDArray[np.int32]]:
    """Costs of the cheapest paths to the start cells, each of which has a cost of its own.

    Returns the cost (cells,) from each cell, +inf where there is no path or it costs more than ``limit``, and the next
    cell (cells,) on it, or `NO_CELL`.
    """
    cost, next_cell = np.full(cell_cost.size, np.inf), np.full(cell_cost.size, NO_CELL, np.int32)
    _search(cell_cost, starts, start_costs, np.ones(cell_cost.size, np.bool_), limit, cost, next_cell)
    return cost, next_cell


def repaired_paths(
    cell_cost: Array,
    known: tuple[Array, npt.NDArray[np.int32]],
    increased: Cells,
    end: int,
    limit: float,
) -> tuple[Array, npt.NDArray[np.int32]]:
    """The cheapest paths after the cost of some cells has increased, computed only where they differ.

    ``known`` are the `cheapest_paths` before, ``increased`` the cells whose cost has increased. The paths end at the
    cell ``end``: the former one, or another with its known cost if the former one is occupied. Above the ``limit``,
    costs may be too low, or +inf although there is a path, and paths may end early.
    """
    cost, next_cell = known[0].copy(), known[1].copy()
    affected = _paths_through(cell_cost.shape, known, increased, limit)
    cost[affected], next_cell[affected] = np.inf, NO_CELL
    cells = np.flatnonzero(affected)
    starts = np.append(cells, end)
    start_costs = np.append(_costs_by_others(cell_cost, cells, affected, limit, cost, next_cell), known[0][end])
    _search(cell_cost, starts, start_costs, affected, limit, cost, next_cell)
    return cost, next_cell


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paths_through(
    shape: tuple[int, int], known: tuple[Array, npt.NDArray[np.int32]], cells: Cells, limit: float
) -> Mask:
    """Which cells with costs of at most ``limit`` have paths through one of the ``cells`` or close to it; (cells,)."""
    rows, columns = shape
    cost, next_cell = known
    found = np.zeros(len(cost), np.bool_)
    stack = np.empty(len(cost), np.int32)
    count = 0
    for cell in cells:
        row, column = cell // columns, cell % columns
        # Also the neighbours, because their paths may begin with a move over the cell.
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                near = r * columns + c
                if cost[near] <= limit and not found[near]:
                    found[near], stack[count] = True, near
                    count += 1
    while count:
        count -= 1
        cell = stack[count]
        row, column = cell // columns, cell % columns
        for move in range(len(_MOVES)):
            other = _end_of_move(shape, row, column, move)
            if other != NO_CELL and next_cell[other] == cell and cost[other] <= limit and not found[other]:
                found[other], stack[count] = True, other
                count += 1
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _end_of_move(shape: tuple[int, int], row: int, column: int, move: int) -> int:
    """The cell at which a move ends, or `NO_CELL` if that is beyond the grid."""
    r, c = row + _MOVES[move, 0], column + _MOVES[move, 1]
    return int(r * shape[1] + c) if 0 <= r < shape[0] and 0 <= c < shape[1] else NO_CELL


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move_cost(cell_cost: Array, row: int, column: int, move: int) -> float:
    """Cost of a move that ends on the grid; +inf if it is not possible."""
    for passed in (2, 4):
        if cell_cost[row + _MOVES[move, passed], column + _MOVES[move, passed + 1]] == np.inf:
            return np.inf
    end = cell_cost[row + _MOVES[move, 0], column + _MOVES[move, 1]]
    return float(_LENGTHS[move] * (cell_cost[row, column] + end) / 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _costs_by_others(
    cell_cost: Array, cells: Cells, affected: Mask, limit: float, cost: Array, next_cell: npt.NDArray[np.int32]
) -> Array:
    """Cost (N,) of the path from each of the affected ``cells`` (N,) whose first move leads to one that is not.

    It is +inf above the ``limit``; below, the end of that move becomes the next cell.
    """
    columns = cell_cost.shape[1]
    costs = np.full(len(cells), np.inf)
    for k in range(len(cells)):
        row, column = cells[k] // columns, cells[k] % columns
        for move in range(len(_MOVES)):
            other = _end_of_move(cell_cost.shape, row, column, move)
            if other == NO_CELL or affected[other] or cost[other] >= costs[k]:
                continue
            total = cost[other] + _move_cost(cell_cost, row, column, move)
            if total <= limit and total < costs[k]:
                costs[k], next_cell[cells[k]] = total, other
    return costs


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    cell_cost: Array,
    starts: Cells,
    start_costs: Array,
    within: Mask,
    limit: float,
    cost: Array,
    next_cell: npt.NDArray[np.int32],
) -> None:
    """Dijkstra's algorithm from the start cells through the cells ``within``, up to costs of ``limit``."""
    columns = cell_cost.shape[1]
    queue = [(np.float64(0.0), np.int64(0)) for _ in range(0)]
    for k in range(len(starts)):
        if start_costs[k] <= limit and start_costs[k] < cost[starts[k]]:
            cost[starts[k]] = start_costs[k]
            queue.append((start_costs[k], starts[k]))
    heapq.heapify(queue)
    while queue:
        cost_here, cell = heapq.heappop(queue)
        if cost_here > cost[cell]:
            continue
        row, column = cell // columns, cell % columns
        for move in range(len(_MOVES)):
            other = _end_of_move(cell_cost.shape, row, column, move)
            if other == NO_CELL or cost[other] <= cost_here or not within[other]:
                continue
            total = cost_here + _move_cost(cell_cost, row, column, move)
            if total <= limit and total < cost[other]:
                cost[other], next_cell[other] = total, cell
                heapq.heappush(queue, (total, other))
