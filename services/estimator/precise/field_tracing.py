"""Traces beams through the learned distance field, compiled by numba.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

from common.geometry.ray_casting import MIN_COSINE

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

    Floats = npt.NDArray[np.float32]

MIN_STEP_CELLS = 0.25  # shorter steps would take long along walls, longer ones would jump over corners
MAX_STEPS = 2000
GRAZING = 0.05  # no derivative is computed if |n . u| is less (below three degrees of incidence, or at an edge)

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@jit
def lookup(phi: Floats, x: float, y: float) -> tuple[float, float, float, bool]:
    """Interpolates phi (m) bilinearly at grid coordinates (cells).

    Returns phi, its derivatives by x and y (m per cell), and whether the point is inside the grid.
    """
    ny, nx = phi.shape
    if not (0 <= x < nx - 1 and 0 <= y < ny - 1):
        return 0.0, 0.0, 0.0, False
    j, i = int(x), int(y)
    u, v = x - j, y - i
    a = phi[i, j]
    b, c = phi[i, j + 1] - a, phi[i + 1, j] - a
    d = phi[i + 1, j + 1] - a - b - c
    return a + b * u + (c + d * u) * v, b + d * v, c + d * u, True


@jit
def trace_beam(phi: Floats, h: float, x: float, y: float, ux: float, uy: float) -> tuple[float, float]:
    """Traces one beam by sphere tracing, in grid coordinates.

    Returns the length of the beam and the smallest distance at which it passed another surface (inf if none), in m.
    """
    t, step, previous, falling, dip, solid = 0.0, 0.0, 0.0, False, np.inf, True
    for _ in range(MAX_STEPS):
        value, _, _, inside = lookup(phi, x + t * ux, y + t * uy)
        if not inside:
            return np.inf, dip
        value /= h
        if solid:  # a laser cannot be inside something, so what the map has there was removed: leave it first
            if value <= 0.0:
                t += max(-value, MIN_STEP_CELLS)
                continue
            solid = False
        if value <= 0.0:
            t -= step * -value / (previous - value)  # regula falsi with the last point in free space
            value, gx, gy, _ = lookup(phi, x + t * ux, y + t * uy)
            slope = gx * ux + gy * uy
            if slope < -MIN_COSINE * h:  # one Newton step onto the surface
                t -= min(max(value / slope, -1.0), 1.0)
            return max(t, 0.0) * h, dip
        if falling and value > previous:
            dip = min(dip, previous * h)
        falling, previous = value < previous, value
        step = max(0.98 * value, MIN_STEP_CELLS)  # not all of phi, because it is not exactly a distance
        t += step
    return np.inf, dip


@jit
def trace(
    phi: Floats,
    ox: float,
    oy: float,
    h: float,
    lasers: Array,
    angles: Array,
    ranges: Array,
    jacobian: Array,
    dip: Array,
    edge: Array,
    facing: Array,
) -> None:
    """Traces beams at ``angles`` (B,) from lasers (N, 3), and fills the fields of `field.TracedBeams`.

    These are ranges (N, B), jacobian (N, B, 3), and dip, edge and facing (N, B). The derivative of a range is
    dr = -(n . dp + r n . u' dyaw) / (n . u). Edge is the depth one cell behind the surface, relative to a plane.
    """
    for k in range(lasers.shape[0]):
        x, y = (lasers[k, 0] - ox) / h, (lasers[k, 1] - oy) / h
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            r, passed = trace_beam(phi, h, x, y, ux, uy)
            ranges[k, b], dip[k, b] = r, passed
            jacobian[k, b, :] = 0.0
            edge[k, b], facing[k, b] = 0.0, 0.0
            if r == np.inf:
                continue
            hx, hy = x + r / h * ux, y + r / h * uy
            _, gx, gy, _ = lookup(phi, hx, hy)
            length = max(math.hypot(gx, gy), 1e-9)
            nx, ny = gx / length, gy / length
            cosine = -min(nx * ux + ny * uy, -MIN_COSINE)
            if cosine > GRAZING:
                jacobian[k, b, 0], jacobian[k, b, 1] = nx / cosine, ny / cosine
                jacobian[k, b, 2] = r * (ny * ux - nx * uy) / cosine
            behind, _, _, _ = lookup(phi, hx + ux, hy + uy)
            edge[k, b], facing[k, b] = -behind / (h * cosine), cosine


@jit
def trace_behind(
    phi: Floats, ox: float, oy: float, h: float, lasers: Array, angles: Array, ranges: Array, behind: Array
) -> None:
    """Fills behind (N, B) m, ranges to the next surface behind the one at ``ranges`` (N, B) m; none behind +inf."""
    for k in range(lasers.shape[0]):
        for b in range(angles.shape[0]):
            behind[k, b] = np.inf
            if ranges[k, b] < np.inf:
                ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
                inside = ranges[k, b] + 0.5 * h
                x, y = lasers[k, 0] + inside * ux, lasers[k, 1] + inside * uy
                behind[k, b] = inside + trace_beam(phi, h, (x - ox) / h, (y - oy) / h, ux, uy)[0]


@jit
def mark_crossed(
    phi: Floats, ox: float, oy: float, h: float, lasers: Array, angles: Array, crossed: npt.NDArray[np.bool_]
) -> None:
    """Marks the nodes (ny, nx) that beams at ``angles`` (B,) from lasers (N, 3) pass."""
    ny, nx = phi.shape
    for k in range(lasers.shape[0]):
        x, y = (lasers[k, 0] - ox) / h, (lasers[k, 1] - oy) / h
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            end, _ = trace_beam(phi, h, x, y, ux, uy)
            t = 0.0
            while t < min(end / h, nx + ny):
                column, row = int(x + t * ux + 0.5), int(y + t * uy + 0.5)
                if not (0 <= column < nx and 0 <= row < ny):
                    break
                crossed[row, column] = True
                t += 0.7  # cells, so that no row or column is skipped


@jit
def end_in_unseen_cells(
    seen: npt.NDArray[np.bool_],
    ox: float,
    oy: float,
    h: float,
    lasers: Array,
    angles: Array,
    allowed: float,
    ranges: Array,
    jacobian: Array,
    scale: Array,
) -> None:
    """Ends each beam where it has passed more than ``allowed`` m of unseen cells, with infinite scale there."""
    rows, columns = seen.shape
    for k in range(lasers.shape[0]):
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            unseen_length, t, step = 0.0, 0.0, 0.5 * h
            while t < ranges[k, b]:
                x, y = (lasers[k, 0] + t * ux - ox) / h, (lasers[k, 1] + t * uy - oy) / h
                inside = 0 <= x < columns and 0 <= y < rows
                if not inside or not seen[int(y), int(x)]:
                    unseen_length += step
                    if unseen_length > allowed:
                        ranges[k, b], scale[k, b] = t, np.inf
                        jacobian[k, b, :] = 0.0
                        break
                t += step
