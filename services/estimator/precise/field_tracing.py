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
BEAMS_AT_ONCE = 256  # traced in turns
GRAZING = 0.05  # no derivative is computed if |n . u| is less: at an incidence above 87 degrees, or at an edge

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@jit
def lookup(phi: Floats, x: float, y: float) -> tuple[float, float, float, bool]:
    """Interpolates phi (m) bilinearly at grid coordinates (cells).

    Returns phi, its derivatives by x and y (m per cell), and whether the point is inside the grid.
    """
    ny, nx = phi.shape
    if not (x >= 0.0 and x < nx - 1 and y >= 0.0 and y < ny - 1):  # a chain of comparisons compiles to slow code
        return 0.0, 0.0, 0.0, False
    j, i = int(x), int(y)
    u, v = x - j, y - i
    a = phi[i, j]
    b, c = phi[i, j + 1] - a, phi[i + 1, j] - a
    d = phi[i + 1, j + 1] - a - b - c
    return a + b * u + (c + d * u) * v, b + d * v, c + d * u, True


@jit
def trace_beams(
    phi: Floats, h: float, x: Array, y: Array, ux: Array, uy: Array, lengths: Array, clearances: Array
) -> None:
    """Traces beams (B,) by sphere tracing, from starts and along directions in grid coordinates.

    Fills the length of each beam and the smallest distance at which it passed another surface, in m; +inf if there is
    none. The beams take turns step by step, because a processor overlaps steps that do not depend on each other.
    """
    lengths[:], clearances[:] = np.inf, np.inf
    t, step, previous = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    falling, solid = np.zeros(len(x), np.bool_), np.ones(len(x), np.bool_)
    running, count = np.arange(len(x)), len(x)  # the first `count` of these beams have not ended
    for _ in range(MAX_STEPS):
        left = 0
        for n in range(count):
            b = running[n]
            value, _, _, inside = lookup(phi, x[b] + t[b] * ux[b], y[b] + t[b] * uy[b])
            if not inside:
                continue
            value /= h
            if value > 0.0:
                if falling[b] and value > previous[b]:
                    clearances[b] = min(clearances[b], previous[b] * h)
                solid[b], falling[b], previous[b] = False, value < previous[b], value
                step[b] = max(0.98 * value, MIN_STEP_CELLS)  # not all of phi, because it is not exactly a distance
                t[b] += step[b]
            elif solid[b]:  # a laser cannot be inside something, so what the map has there was removed: leave it first
                t[b] += max(-value, MIN_STEP_CELLS)
            else:
                t[b] -= step[b] * -value / (previous[b] - value)  # regula falsi with the last point in free space
                value, gx, gy, _ = lookup(phi, x[b] + t[b] * ux[b], y[b] + t[b] * uy[b])
                slope = gx * ux[b] + gy * uy[b]
                if slope < -MIN_COSINE * h:  # one Newton step onto the surface
                    t[b] -= min(max(value / slope, -1.0), 1.0)
                lengths[b] = max(t[b], 0.0) * h
                continue
            running[left] = b
            left += 1
        count = left
        if not count:
            break


@jit
def aim(
    ox: float, oy: float, h: float, lasers: Array, angles: Array, first: int, passed: Array
) -> tuple[Array, Array, Array, Array]:
    """Starts (x, y) and directions (ux, uy) in grid coordinates of some beams of all lasers, from the ``first`` on.

    Each beam starts where it has ``passed`` (n,) m.
    """
    count = len(passed)
    x, y, ux, uy = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for n in range(count):
        k, b = divmod(first + n, len(angles))
        ux[n], uy[n] = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
        x[n] = (lasers[k, 0] + passed[n] * ux[n] - ox) / h
        y[n] = (lasers[k, 1] + passed[n] * uy[n] - oy) / h
    return x, y, ux, uy


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
    clearance: Array,
    depth_ratio: Array,
    cos_incidence: Array,
) -> None:
    """Traces beams at ``angles`` (B,) from lasers (N, 3), and fills the fields of `field.TracedBeams`.

    These are ranges (N, B), jacobian (N, B, 3), and clearance, depth_ratio and cos_incidence (N, B). The derivative of
    a range is dr = -(n . dp + r n . u' dyaw) / (n . u). The depth ratio is the depth one cell behind the surface,
    relative to a plane.
    """
    flat_ranges, flat_clearance, flat_jacobian = ranges.reshape(-1), clearance.reshape(-1), jacobian.reshape(-1, 3)
    flat_depth_ratio, flat_cos_incidence = depth_ratio.reshape(-1), cos_incidence.reshape(-1)
    for first in range(0, len(flat_ranges), BEAMS_AT_ONCE):
        part = slice(first, min(first + BEAMS_AT_ONCE, len(flat_ranges)))
        x, y, ux, uy = aim(ox, oy, h, lasers, angles, first, np.zeros(part.stop - first))
        trace_beams(phi, h, x, y, ux, uy, flat_ranges[part], flat_clearance[part])
        for n in range(len(x)):
            beam = first + n
            r = flat_ranges[beam]
            flat_jacobian[beam, :] = 0.0
            flat_depth_ratio[beam], flat_cos_incidence[beam] = 0.0, 0.0
            if r == np.inf:
                continue
            hx, hy = x[n] + r / h * ux[n], y[n] + r / h * uy[n]
            _, gx, gy, _ = lookup(phi, hx, hy)
            length = max(math.hypot(gx, gy), 1e-9)
            nx, ny = gx / length, gy / length
            cosine = -min(nx * ux[n] + ny * uy[n], -MIN_COSINE)
            if cosine > GRAZING:
                flat_jacobian[beam, 0], flat_jacobian[beam, 1] = nx / cosine, ny / cosine
                flat_jacobian[beam, 2] = r * (ny * ux[n] - nx * uy[n]) / cosine
            behind, _, _, _ = lookup(phi, hx + ux[n], hy + uy[n])
            flat_depth_ratio[beam], flat_cos_incidence[beam] = -behind / (h * cosine), cosine


@jit
def trace_behind(
    phi: Floats, ox: float, oy: float, h: float, lasers: Array, angles: Array, ranges: Array, behind: Array
) -> None:
    """Fills behind (N, B) m, ranges to the next surface behind the one at ``ranges`` (N, B) m; none behind +inf."""
    flat_ranges, flat_behind = ranges.reshape(-1), behind.reshape(-1)
    for first in range(0, len(flat_ranges), BEAMS_AT_ONCE):
        part = slice(first, min(first + BEAMS_AT_ONCE, len(flat_ranges)))
        inside = flat_ranges[part] + 0.5 * h  # +inf is outside the grid: behind nothing there is nothing
        x, y, ux, uy = aim(ox, oy, h, lasers, angles, first, inside)
        trace_beams(phi, h, x, y, ux, uy, flat_behind[part], np.empty(len(x)))
        flat_behind[part] += inside


@jit
def mark_crossed(
    phi: Floats, ox: float, oy: float, h: float, lasers: Array, angles: Array, crossed: npt.NDArray[np.bool_]
) -> None:
    """Marks the nodes (ny, nx) that beams at ``angles`` (B,) from lasers (N, 3) pass."""
    ny, nx = phi.shape
    for k in range(lasers.shape[0]):
        x, y, ux, uy = aim(ox, oy, h, lasers[k : k + 1], angles, 0, np.zeros(len(angles)))
        ends = np.empty(len(angles))
        trace_beams(phi, h, x, y, ux, uy, ends, np.empty(len(angles)))
        for b in range(angles.shape[0]):
            t = 0.0
            while t < min(ends[b] / h, nx + ny):
                column, row = int(x[b] + t * ux[b] + 0.5), int(y[b] + t * uy[b] + 0.5)
                if not (0 <= column < nx and 0 <= row < ny):
                    break
                crossed[row, column] = True
                t += 0.7  # cells, so that no row or column is skipped
