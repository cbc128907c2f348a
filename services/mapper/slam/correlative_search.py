"""Search for the pose of one group of surface elements in another, over a wide window (Olson, ICRA 2009)."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.elements import Elements

CELL_M = 0.15  # of the grid that is searched
SECTORS = 8  # of the directions of normals
TURN_STEP = 0.03  # rad
MAX_ELEMENTS = 200  # of the moved group that are used
PEAKS = 4  # poses returned
PEAK_DISTANCE_M, PEAK_TURN = 0.5, 0.15  # between them


def correlative_search(
    target: Elements, moved: Elements, around: Array, window: Array, turn_step: float = TURN_STEP
) -> Array:
    """The best poses (K, 3) of ``moved`` in the frame of ``target``, at most ``window`` (3,) from ``around`` (3,).

    There are none if ``moved`` is empty.
    """
    if not len(moved):
        return np.zeros((0, 3))
    window = np.minimum(window, [np.inf, np.inf, np.pi])
    sample = moved.part(np.linspace(0, len(moved) - 1, min(len(moved), MAX_ELEMENTS)).astype(int))
    reach = np.hypot(*sample.points.T).max() + np.hypot(*window[:2])
    low = around[:2] - reach - 2 * CELL_M
    grid = _rasterise(target, low, int(2 * (reach + 2 * CELL_M) / CELL_M) + 2)
    count = np.ceil(window[:2] / CELL_M).astype(int)
    turns = around[2] + turn_step * np.arange(-np.ceil(window[2] / turn_step), np.ceil(window[2] / turn_step) + 1)
    scores = np.zeros((len(turns), 2 * count[1] + 1, 2 * count[0] + 1), np.int32)
    for k, turn in enumerate(turns):
        placed = sample.transformed(np.array([*around[:2], turn]))
        column, row = np.floor((placed.points - low) / CELL_M).astype(np.int64).T
        _count_hits(grid, _sector(placed.normals), row, column, scores[k])
    return _peaks(scores, turns, around, count)


def _peaks(scores: npt.NDArray[np.int32], turns: Array, around: Array, count: npt.NDArray[np.int_]) -> Array:
    """The highest scores that are apart, as poses (K, 3)."""
    order = np.argsort(scores, axis=None)[::-1][:2000]
    k, i, j = np.unravel_index(order, scores.shape)
    poses = np.column_stack([around[0] + CELL_M * (j - count[0]), around[1] + CELL_M * (i - count[1]), turns[k]])
    found: list[Array] = []
    for pose in poses:
        off = se2.difference(pose, np.array(found).reshape(-1, 3))
        if not ((np.hypot(off[:, 0], off[:, 1]) < PEAK_DISTANCE_M) & (np.abs(off[:, 2]) < PEAK_TURN)).any():
            found.append(pose)
        if len(found) == PEAKS:
            break
    return np.array(found)


def _sector(normals: Array) -> npt.NDArray[np.int64]:
    """The sector of directions (K,) in which each of the normals (K, 2) lies."""
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    return np.asarray(np.floor(angle / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS)


def _rasterise(elements: Elements, low: Array, size: int) -> npt.NDArray[np.uint8]:
    """Grid (sector, row, column) of cells with an element in or beside them, in the same sector or one beside it."""
    grid = np.zeros((SECTORS, size, size), np.uint8)
    column, row = np.floor((elements.points - low) / CELL_M).astype(np.int64).T
    inside = (column > 0) & (column < size - 1) & (row > 0) & (row < size - 1)
    column, row, sector = column[inside], row[inside], _sector(elements.normals[inside])
    for turn in (-1, 0, 1):
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                grid[(sector + turn) % SECTORS, row + i, column + j] = 1
    return grid


@numba.njit(cache=True, nogil=True)
def _count_hits(
    grid: npt.NDArray[np.uint8],
    sector: npt.NDArray[np.int64],
    row: npt.NDArray[np.int64],
    column: npt.NDArray[np.int64],
    scores: npt.NDArray[np.int32],
) -> None:
    """Counts, for each shift (rows, columns) of the window, the elements that fall into marked cells."""
    rows, columns = scores.shape
    for n in range(len(sector)):
        for i in range(rows):
            y = row[n] + i - rows // 2
            for j in range(columns):
                scores[i, j] += grid[sector[n], y, column[n] + j - columns // 2]
