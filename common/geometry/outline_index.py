"""A grid that lists the segments and circles in each of its cells, so that a ray is tested against few of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

    IndexArrays = tuple[
        Array, Array, npt.NDArray[np.int64], npt.NDArray[np.int64], tuple[int, int], tuple[float, float, float]
    ]

MARGIN_CELLS = 1e-6  # an outline this near a cell counts as inside it, because the positions of rays are rounded
MARGIN_M = 1e-3  # of the grid around all outlines

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True)
class OutlineIndex:
    """The segments and circles in each cell of a grid, which has about as many cells as there are outlines."""

    segments: Array  # (S, 4) x0, y0, x1, y1 in m
    circles: Array  # (C, 3) x, y, radius in m
    # Cell (i, j), with k = columns * i + j, has members[starts[k] : starts[k + 1]]: s < S is segment s, otherwise
    # circle s - S.
    starts: npt.NDArray[np.int64]  # (rows * columns + 1,)
    members: npt.NDArray[np.int64]
    shape: tuple[int, int]  # rows, columns
    frame: tuple[float, float, float]  # x and y of the corner of cell (0, 0), and edge length of a cell, in m

    @classmethod
    def of(cls, segments: Array, circles: Array) -> OutlineIndex:
        """Builds the index of segments (S, 4) and circles (C, 3)."""
        radius = circles[:, 2:]
        points = np.concatenate([segments.reshape(-1, 2), circles[:, :2] - radius, circles[:, :2] + radius])
        points = points if len(points) else np.zeros((1, 2))
        low = points.min(axis=0) - MARGIN_M
        extent = points.max(axis=0) + MARGIN_M - low
        count = len(segments) + len(circles) + 1
        # m, edge length of a cell; the second term limits the number of cells of a long, thin world
        size = max(math.sqrt(extent.prod() / count), float(extent.max()) / count)
        frame = (float(low[0]), float(low[1]), size)
        columns, rows = (int(n) for n in np.ceil(extent / size))
        # Two passes over the outlines: the first one counts the members of each cell, the second one lists them.
        counts, no_members = np.zeros(rows * columns, np.int64), np.zeros(0, np.int64)
        _visit_cells(segments, circles, (rows, columns), frame, counts, no_members)
        starts = np.concatenate([[0], np.cumsum(counts)])
        members = np.empty(starts[-1], np.int64)
        _visit_cells(segments, circles, (rows, columns), frame, starts[:-1].copy(), members)
        return cls(segments, circles, starts, members, (rows, columns), frame)

    @property
    def arrays(self) -> IndexArrays:
        """The fields, as compiled functions take them."""
        return self.segments, self.circles, self.starts, self.members, self.shape, self.frame


@jit
def _visit_cells(
    segments: Array,
    circles: Array,
    shape: tuple[int, int],
    frame: tuple[float, float, float],
    positions: npt.NDArray[np.int64],
    members: npt.NDArray[np.int64],
) -> None:
    """Visits the cells of each outline: writes its number to members[positions[k]] and adds 1 to positions[k].

    If ``members`` is empty, only counts in ``positions``.
    """
    (rows, columns), (x, y, size) = shape, frame
    for number in range(segments.shape[0] + circles.shape[0]):
        # In units of cells, a segment from a to b or the square around a circle.
        if number < segments.shape[0]:
            ax, ay = (segments[number, 0] - x) / size, (segments[number, 1] - y) / size
            bx, by = (segments[number, 2] - x) / size, (segments[number, 3] - y) / size
        else:
            circle = circles[number - segments.shape[0]]
            ax, ay = (circle[0] - circle[2] - x) / size, (circle[1] - circle[2] - y) / size
            bx, by = (circle[0] + circle[2] - x) / size, (circle[1] + circle[2] - y) / size
        bottom = max(math.floor(min(ay, by) - MARGIN_CELLS), 0)
        top = min(math.floor(max(ay, by) + MARGIN_CELLS), rows - 1)
        for i in range(bottom, top + 1):
            x0, x1 = ax, bx
            if number < segments.shape[0] and ay != by:  # only the part of the segment within the row
                u, v = (i - MARGIN_CELLS - ay) / (by - ay), (i + 1 + MARGIN_CELLS - ay) / (by - ay)
                u, v = max(min(u, v), 0.0), min(max(u, v), 1.0)
                x0, x1 = ax + u * (bx - ax), ax + v * (bx - ax)
            left = max(math.floor(min(x0, x1) - MARGIN_CELLS), 0)
            right = min(math.floor(max(x0, x1) + MARGIN_CELLS), columns - 1)
            for j in range(left, right + 1):
                k = columns * i + j
                if members.size:
                    members[positions[k]] = number
                positions[k] += 1
