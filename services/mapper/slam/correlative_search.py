"""Search for the pose of one group of surface elements in another, over a wide window (Olson, ICRA 2009)."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.elements import Elements

Candidates = npt.NDArray[np.int64]  # (K, 3) number of a turn, and shifts along x and y in cells

CELL_M = 0.15  # of the grid that is searched
BLOCK = 4  # cells, edge length of a block of shifts that are bounded together
SECTORS = 8  # of the directions of normals, one bit of a cell each
TURN_STEP = 0.03  # rad
MAX_ELEMENTS = 200  # of the source that are used
PEAKS = 4  # poses returned
PEAK_DISTANCE_M, PEAK_TURN = 0.5, 0.15  # between them
FIRST_BLOCKS = 512  # blocks that are scored first; then twice as many, and so on
MAX_RANKED = 2000  # poses among which peaks are looked for


def correlative_search(
    target: Elements, source: Elements, around: Array, window: Array, turn_step: float = TURN_STEP
) -> Array:
    """The best poses (K, 3) of ``source`` in the frame of ``target``, at most ``window`` (3,) from ``around`` (3,).

    A pose's score is the number of elements of ``source`` in or beside cells with similar elements of ``target``; those
    with a score of 0 are left out. Among equal scores, a pose near ``around`` is better; a turn by ``turn_step`` counts
    as a cell. Branch and bound (Hess et al., ICRA 2016): blocks of shifts whose bound is too low are not scored.
    """
    if not len(source):
        return np.zeros((0, 3))
    window = np.minimum(window, [np.inf, np.inf, np.pi])
    sample = source.part(np.linspace(0, len(source) - 1, min(len(source), MAX_ELEMENTS)).astype(int))
    reach = np.hypot(*sample.points.T).max() + np.hypot(*window[:2])
    low = around[:2] - reach - 2 * CELL_M
    # Rasterise the target, and place the source's elements in its grid at each turn.
    grid = _rasterise(target, low, int(2 * (reach + 2 * CELL_M) / CELL_M) + 2)
    count = np.ceil(window[:2] / CELL_M).astype(int)
    turns = around[2] + turn_step * np.arange(-np.ceil(window[2] / turn_step), np.ceil(window[2] / turn_step) + 1)
    placed = [sample.transformed(np.array([*around[:2], turn])) for turn in turns]
    sector = np.array([_sector(each.normals) for each in placed])
    cells = np.array([np.floor((each.points - low) / CELL_M).astype(np.int64) for each in placed])  # (T, N, 2)
    # Bound the scores of all blocks of shifts, and order the blocks by their bounds.
    corners = [np.arange(-n, n + 1, BLOCK) for n in count.tolist()]
    blocks = np.stack(np.meshgrid(np.arange(len(turns)), *corners, indexing="ij"), axis=-1).reshape(-1, 3)
    bounds = _count_hits(_pooled(grid), sector, cells, blocks)
    order = np.argsort(-bounds, kind="stable")[: np.count_nonzero(bounds)]
    # Score one group of blocks after another until no other block can be better than the worst peak.
    best, scores = np.zeros((0, 3), np.int64), np.zeros(0, np.int32)  # of the candidates so far
    peaks, lowest_score = np.zeros((0, 3)), 0
    begin, size = 0, FIRST_BLOCKS
    while begin < len(order) and not (len(peaks) == PEAKS and lowest_score > bounds[order[begin]]):
        candidates = _shifts_within(blocks[order[begin : begin + size]], count)
        best = np.concatenate([best, candidates])
        scores = np.append(scores, _count_hits(grid, sector, cells, candidates))
        distance = ((best - [len(turns) // 2, 0, 0]) ** 2).sum(axis=1)
        rank = np.lexsort([distance, -scores])[: min(MAX_RANKED, np.count_nonzero(scores))]
        best, scores = best[rank], scores[rank]
        poses = np.column_stack([around[:2] + CELL_M * best[:, 1:], turns[best[:, 0]]])
        if chosen := _distant_poses(poses):
            peaks, lowest_score = poses[chosen], int(scores[chosen[-1]])
        begin, size = begin + size, 2 * size
    return peaks


def _shifts_within(blocks: Candidates, count: npt.NDArray[np.int_]) -> Candidates:
    """All candidates in blocks (B, 3), without those shifted by more than ``count`` (2,) cells."""
    within = np.stack(np.meshgrid(0, np.arange(BLOCK), np.arange(BLOCK)), axis=-1).reshape(-1, 3)
    candidates = (blocks[:, None] + within).reshape(-1, 3)
    return np.asarray(candidates[(candidates[:, 1:] <= count).all(axis=1)])


def _distant_poses(poses: Array) -> list[int]:
    """Indices of the first `PEAKS` of some poses (K, 3) that are distant from one another."""
    chosen: list[int] = []
    for number, pose in enumerate(poses):
        off = se2.difference(pose, poses[chosen])
        if not ((np.hypot(off[:, 0], off[:, 1]) < PEAK_DISTANCE_M) & (np.abs(off[:, 2]) < PEAK_TURN)).any():
            chosen.append(number)
        if len(chosen) == PEAKS:
            break
    return chosen


def _sector(normals: Array) -> npt.NDArray[np.uint8]:
    """The sector of directions (K,) in which each of the normals (K, 2) lies."""
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    return np.asarray(np.floor(angle / (2 * np.pi) * SECTORS) % SECTORS, np.uint8)


def _rasterise(elements: Elements, low: Array, size: int) -> npt.NDArray[np.uint8]:
    """Grid (row, column) of cells; bit s is set if an element of sector s, or one beside it, is in or near the cell."""
    grid = np.zeros((size, size), np.uint8)
    column, row = np.floor((elements.points - low) / CELL_M).astype(np.int64).T
    inside = (column > 0) & (column < size - 1) & (row > 0) & (row < size - 1)
    column, row, sector = column[inside], row[inside], _sector(elements.normals[inside])
    bits = sum((np.uint8(1) << (sector + turn) % SECTORS for turn in (SECTORS - 1, 0, 1)), np.zeros_like(sector))
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            np.bitwise_or.at(grid, (row + i, column + j), bits)
    return grid


def _pooled(grid: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The bits of all cells in the block of `BLOCK` x `BLOCK` cells that begins at each cell."""
    rows = grid.copy()
    for k in range(1, BLOCK):
        rows[:-k] |= grid[k:]
    pooled = rows.copy()
    for k in range(1, BLOCK):
        pooled[:, :-k] |= rows[:, k:]
    return np.asarray(pooled)


@numba.njit(cache=True, nogil=True)
def _count_hits(
    grid: npt.NDArray[np.uint8],
    sector: npt.NDArray[np.uint8],
    cells: npt.NDArray[np.int64],
    candidates: Candidates,
) -> npt.NDArray[np.int32]:
    """The number (K,) of elements in cells with the bit of their sector, for each of the ``candidates`` (K, 3).

    ``sector`` (T, N) and ``cells`` (T, N, 2), column and row, are of the elements after each turn.
    """
    hits = np.zeros(len(candidates), np.int32)
    for k in range(len(candidates)):
        turn, columns, rows = candidates[k]
        for n in range(sector.shape[1]):
            hits[k] += grid[cells[turn, n, 1] + rows, cells[turn, n, 0] + columns] >> sector[turn, n] & 1
    return hits
