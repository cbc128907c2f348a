"""Ray casting in occupancy grids with derivatives, compiled by numba."""

from __future__ import annotations

import math

import numpy as np

from services.estimator.shared.kernels import FACING, jit


@jit
def cast_cells(occupied, clear, frame, lasers, angles, ranges, jacobian):
    """Casts rays against the cells of a grid, from lasers (N, 3) in map along angles (B,).

    Where a cell is nearer than ``ranges`` (N, B) m, writes its distance there, and the derivative to jacobian (N, B,
    3). ``occupied`` and ``clear`` (rows, columns) are those of `CellRays`. ``frame`` holds x, y (m) and yaw (rad) in
    map of the lower left corner of the first cell, and the size of a cell in m.
    """
    rows, columns = occupied.shape
    size, cos, sin = frame[3], math.cos(frame[2]), math.sin(frame[2])
    for k in range(lasers.shape[0]):
        mx, my = (lasers[k, 0] - frame[0]) / size, (lasers[k, 1] - frame[1]) / size
        px, py = cos * mx + sin * my, cos * my - sin * mx
        for b in range(angles.shape[0]):
            heading = lasers[k, 2] + angles[b] - frame[2]
            ux, uy = math.cos(heading), math.sin(heading)
            at, last, on_x = 0.0, np.inf, True
            for start, along, end in ((px, ux, columns), (py, uy, rows)):
                if along == 0.0:
                    if start < 0 or start >= end:
                        last = -np.inf
                    continue
                near, far = -start / along, (end - start) / along
                at, last = max(at, min(near, far)), min(last, max(near, far))
            if at >= last:
                continue
            column = min(max(math.floor(px + at * ux), 0), columns - 1)
            row = min(max(math.floor(py + at * uy), 0), rows - 1)
            start_occupied, hit, max_length = occupied[row, column], False, ranges[k, b] / size
            while at < max_length:
                radius = np.int64(clear[row, column])  # int() would keep it unsigned
                to_x = np.inf if ux == 0.0 else (column + (radius + 1 if ux > 0 else -radius) - px) / ux
                to_y = np.inf if uy == 0.0 else (row + (radius + 1 if uy > 0 else -radius) - py) / uy
                on_x = to_x <= to_y
                if on_x:
                    at = to_x
                    column += radius + 1 if ux > 0 else -radius - 1
                    low, high = (row, row + radius) if uy >= 0 else (row - radius, row)
                    row = min(max(math.floor(py + at * uy), low), high)
                else:
                    at = to_y
                    row += radius + 1 if uy > 0 else -radius - 1
                    low, high = (column, column + radius) if ux >= 0 else (column - radius, column)
                    column = min(max(math.floor(px + at * ux), low), high)
                if column < 0 or column >= columns or row < 0 or row >= rows:
                    break
                if occupied[row, column] != start_occupied:
                    hit = at < max_length
                    break
            if not hit:
                continue
            ranges[k, b] = at * size
            nx, ny = (-math.copysign(1.0, ux), 0.0) if on_x else (0.0, -math.copysign(1.0, uy))
            cosine = max(-(nx * ux + ny * uy), FACING)
            jacobian[k, b, 0], jacobian[k, b, 1] = (cos * nx - sin * ny) / cosine, (sin * nx + cos * ny) / cosine
            jacobian[k, b, 2] = at * size * (ny * ux - nx * uy) / cosine
