"""Exact distances from grid nodes to occupied cells.

The squared distance to a union of grid cells is separable (Felzenszwalb and Huttenlocher, Distance Transforms of
Sampled Functions, 2012): it is computed along each column first and then minimised over the columns.

scipy.ndimage.distance_transform_edt does not give it: it measures between cell centres, not from any node to an edge.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array


def signed_distance(mask: npt.NDArray[np.bool_], x: Array, y: Array, max_distance: float = np.inf) -> Array:
    """(len(y), len(x)) distances in cells from nodes (x[i], y[j]) to the edge of ``mask``, positive outside it.

    ``mask`` has shape (rows, columns); x and y are in cells from its lower left corner, ascending. Everything beyond
    the mask is outside. Distances are limited to ``max_distance``, which saves time.
    """
    padded = np.pad(mask, 1)
    outside = _to_cells(padded, x + 1, y + 1, max_distance)
    row, column = np.floor(y + 1).astype(int), np.floor(x + 1).astype(int)
    rows, columns = padded.shape
    inside = np.ix_((row >= 0) & (row < rows), (column >= 0) & (column < columns))
    depth = np.zeros_like(outside)
    x, y = x[inside[1][0]] + 1, y[inside[0][:, 0]] + 1
    depth[inside] = _to_cells(~padded, x, y, max_distance)
    return outside - depth


def inner_distance(mask: npt.NDArray[np.bool_], x: Array, y: Array, max_distance: float = np.inf) -> Array:
    """(len(y), len(x)) distances in cells from nodes on the grid to the nearest point outside ``mask``; 0 outside."""
    return _to_cells(~np.pad(mask, 1), x + 1, y + 1, max_distance)


def _to_cells(mask: npt.NDArray[np.bool_], x: Array, y: Array, max_distance: float) -> Array:
    """(len(y), len(x)) distances to the nearest True cell, 0 inside one, at most ``max_distance``."""
    along = _along_columns(mask, y)  # (columns, len(y))
    nearest = np.full((len(x), len(y)), float(max_distance) ** 2)
    if not len(x) or not len(y):
        return np.asarray(np.sqrt(nearest.T))
    column = np.floor(x).astype(int)
    active, step = np.arange(len(x)), 0
    furthest = max(int(column.max()), len(along) - 1) - min(int(column.min()), 0)
    while len(active) and step <= furthest:
        for side in (-step, step) if step else (0,):
            candidate = column[active] + side
            exists = (candidate >= 0) & (candidate < len(along))
            nodes, candidate = active[exists], candidate[exists]
            gap = np.maximum(np.maximum(candidate - x[nodes], x[nodes] - candidate - 1), 0.0)
            nearest[nodes] = np.minimum(nearest[nodes], along[candidate] + gap[:, None] ** 2)
        # The next columns are at least `step` away.
        active = active[nearest[active].max(axis=1) > step**2]
        step += 1
    return np.asarray(np.sqrt(nearest.T))


def _along_columns(mask: npt.NDArray[np.bool_], y: Array) -> Array:
    """(columns, len(y)) squared distances along a column to its nearest True cell; +inf if it has none."""
    rows, no_cell = len(mask), 10**7
    number = np.arange(rows)[:, None]
    below = np.maximum.accumulate(np.where(mask, number, -no_cell), axis=0)
    above = np.minimum.accumulate(np.where(mask, number, no_cell)[::-1], axis=0)[::-1]
    row = np.clip(np.floor(y).astype(int), 0, rows - 1)
    height = y[:, None]
    down = np.where(height >= 0, np.maximum(height - below[row] - 1, 0.0), np.inf)
    up = np.where(height < rows, np.maximum(above[row] - height, 0.0), np.inf)
    gap = np.minimum(down, up)
    return np.ascontiguousarray(np.where(gap < no_cell // 2, gap, np.inf).T ** 2)
