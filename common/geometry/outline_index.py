"""A grid that lists the segments and circles in each of its cells, so that a ray is compared with few of them."""

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

MARGIN_CELLS = 1e-6  # an outline this near a cell counts as inside, because a ray's position is rounded
MARGIN_M = 1e-3  # around all outlines

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True)
class OutlineIndex:
    """The segments and circles in each cell of a grid, which has about as many cells as there are outlines."""

    segments: Array  # (S, 4) x0, y0, x1, y1 in m
    circles: Array  # (C, 3) x, y, radius in m
    # Cell (i, j) lists members[starts[k] : starts[k + 1]], with k = columns * i + j; numbers from S on are circles.
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
        frame = (float(low[0]), float(low[1]), max(math.sqrt(extent.prod() / count), float(extent.max()) / count))
        columns, rows = (int(n) for n in np.ceil(extent / frame[2]))
        # Two passes over the outlines: the first one counts the members of each cell, the second one lists them.
        starts, members = np.zeros(rows * columns + 1, np.int64), np.zeros(0, np.int64)
        _list(segments, circles, (rows, columns), frame, starts, members)
        starts = np.cumsum(starts)
        members = np.empty(starts[-1], np.int64)
        _list(segments, circles, (rows, columns), frame, starts.copy(), members)
        return cls(segments, circles, starts, members, (rows, columns), frame)

    @property
    def arrays(self) -> IndexArrays:
        """The fields, as compiled functions take them."""
        return self.segments, self.circles, self.starts, self.members, self.shape, self.frame


@jit
def _list(
    segments: Array,
    circles: Array,
    shape: tuple[int, int],
    frame: tuple[float, float, float],
    ends: npt.NDArray[np.int64],
    members: npt.NDArray[np.int64],
) -> None:
    """Counts the members of cell k in ends[k + 1] if ``members`` is empty, else writes them from ends[k] on."""
    (rows, columns), (x, y, size) = shape, frame
    for s in range(segments.shape[0] + circles.shape[0]):
        if s < segments.shape[0]:
            ax, ay = (segments[s, 0] - x) / size, (segments[s, 1] - y) / size
            bx, by = (segments[s, 2] - x) / size, (segments[s, 3] - y) / size
        else:
            circle = circles[s - segments.shape[0]]
            ax, ay = (circle[0] - circle[2] - x) / size, (circle[1] - circle[2] - y) / size
            bx, by = (circle[0] + circle[2] - x) / size, (circle[1] + circle[2] - y) / size
        first = max(math.floor(min(ay, by) - MARGIN_CELLS), 0)
        last = min(math.floor(max(ay, by) + MARGIN_CELLS), rows - 1)
        for i in range(first, last + 1):
            low, high = min(ax, bx), max(ax, bx)
            if s < segments.shape[0] and ay != by:  # only the part of the segment within the row
                u, v = (i - MARGIN_CELLS - ay) / (by - ay), (i + 1 + MARGIN_CELLS - ay) / (by - ay)
                u, v = max(min(u, v), 0.0), min(max(u, v), 1.0)
                low, high = min(ax + u * (bx - ax), ax + v * (bx - ax)), max(ax + u * (bx - ax), ax + v * (bx - ax))
            for j in range(
                max(math.floor(low - MARGIN_CELLS), 0), min(math.floor(high + MARGIN_CELLS), columns - 1) + 1
            ):
                k = i * columns + j
                if members.size:
                    members[ends[k]] = s
                    ends[k] += 1
                else:
                    ends[k + 1] += 1
