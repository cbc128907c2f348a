"""Cells that beams pass on their way, compiled by numba.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@jit
def _entry(x: float, y: float, ux: float, uy: float, rows: int, columns: int) -> float:
    """Distance after which a beam is inside a grid: 0 if it starts there, +inf if it misses the grid. All in cells."""
    enter, leave = 0.0, np.inf
    for start, direction, size in ((x, ux, columns), (y, uy, rows)):
        if direction != 0.0:
            first, last = -start / direction, (size - start) / direction
            enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
        elif not 0 <= start < size:
            return np.inf
    return enter if enter < leave else np.inf


@jit
def count_crossings(
    starts: Array,
    unit: Array,
    ranges: Array,
    h: float,
    surface: npt.NDArray[np.bool_],
    mx: Array,
    my: Array,
    nx: Array,
    ny: Array,
    margin: float,
    crossed: Array,
) -> None:
    """Counts in crossed (rows, columns) the beams that passed through the surface element of each cell.

    Beams have starts (R, 2), unit directions (R, 2) and ranges (R,), in m from node (0, 0). Cells of ``h`` m with
    ``surface`` set have an element with mean (mx, my) and normal (nx, ny). A beam passes through it if it crosses the
    element's plane within the cell, and ends at least ``margin`` m behind it.
    """
    rows, columns = surface.shape
    for b in range(ranges.shape[0]):
        x, y, ux, uy = starts[b, 0] / h, starts[b, 1] / h, unit[b, 0], unit[b, 1]
        t = _entry(x, y, ux, uy, rows, columns)
        if t == np.inf:
            continue
        # Rounding may put the place of entry just outside.
        j, i = min(max(int(x + t * ux), 0), columns - 1), min(max(int(y + t * uy), 0), rows - 1)
        sx, sy = (1 if ux > 0 else -1), (1 if uy > 0 else -1)
        # Amanatides and Woo 1987: step from cell to cell, across the nearer edge in x or in y.
        ax = ((j + (ux > 0)) - x) / ux if ux != 0.0 else np.inf
        ay = ((i + (uy > 0)) - y) / uy if uy != 0.0 else np.inf
        end = ranges[b] / h
        while t < end and 0 <= i < rows and 0 <= j < columns:
            out = min(ax, ay)
            if surface[i, j]:
                ex, ey = x + end * ux - mx[i, j] / h, y + end * uy - my[i, j] / h
                depth = ex * nx[i, j] + ey * ny[i, j]
                slope = ux * nx[i, j] + uy * ny[i, j]
                if slope != 0.0 and abs(depth) * h > margin and (depth > 0.0) == (slope > 0.0):
                    at = end - depth / slope
                    if t <= at <= out:
                        crossed[i, j] += 1.0
            t = out
            if ax < ay:
                j, ax = j + sx, ax + abs(1.0 / ux)
            else:
                i, ay = i + sy, ay + abs(1.0 / uy)


@jit
def mark_seen_cells(starts: Array, unit: Array, ranges: Array, h: float, seen: npt.NDArray[np.bool_]) -> None:
    """Marks in ``seen`` the cells of ``h`` m that beams pass.

    Beams have starts (R, 2), unit directions (R, 2) and ranges (R,), in m from node (0, 0).
    """
    rows, columns = seen.shape
    for b in range(ranges.shape[0]):
        for k in range(int(ranges[b] / (0.5 * h)) + 1):
            t = min(0.5 * h * k, ranges[b])
            j, i = int((starts[b, 0] + t * unit[b, 0]) / h), int((starts[b, 1] + t * unit[b, 1]) / h)
            if 0 <= i < rows and 0 <= j < columns:
                seen[i, j] = True


@jit
def count_at_nodes(
    starts: Array, unit: Array, ranges: Array, h: float, radius: float, margin: float, ended: Array, passed: Array
) -> None:
    """Counts the beams that ended at each node of a grid of ``h`` m, and that passed it.

    The counts are added to ended and passed (rows, columns). Beams have starts (R, 2), unit directions (R, 2) and
    ranges (R,), in m from node (0, 0). One belongs to a node if its line is within ``radius`` m, at most ``h`` / 2, of
    it. It passed if it ends more than ``margin`` m behind the node, and ended there if it ends less than that before or
    behind it.
    """
    rows, columns = ended.shape
    for b in range(ranges.shape[0]):
        x, y, ux, uy = starts[b, 0], starts[b, 1], unit[b, 0], unit[b, 1]
        last = -1
        for k in range(int((ranges[b] + margin) / (0.5 * h)) + 1):
            t = 0.5 * h * k
            j, i = int(np.round((x + t * ux) / h)), int(np.round((y + t * uy) / h))
            if not (0 <= i < rows and 0 <= j < columns) or i * columns + j == last:
                continue
            last = i * columns + j
            dx, dy = j * h - x, i * h - y
            behind = ranges[b] - (dx * ux + dy * uy)
            if abs(dx * uy - dy * ux) > radius or behind < -margin:
                continue
            if behind > margin:
                passed[i, j] += 1.0
            else:
                ended[i, j] += 1.0
