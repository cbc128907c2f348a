"""Exact ray casting against segments, circles and the cells of an occupancy grid, compiled by numba.

Cells are traversed as by Amanatides and Woo (A Fast Voxel Traversal Algorithm, 1987); those of an occupancy grid in
steps over squares of empty cells instead of single cells. Segments and circles are found in a grid, too, so that the
time of a ray hardly depends on the size of the world.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numba
import numpy as np
from scipy import ndimage

from common.geometry.occupancy_grid import MAX_CACHED_GRIDS, OCCUPIED, OccupancyGrid

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.outline_index import IndexArrays
    from common.geometry.se2 import Array
    from common.geometry.world import World

MIN_COSINE = 0.02  # of the angle of incidence, so that the derivatives of grazing rays stay finite
MAX_CLEAR_RADIUS = 255  # cells; fits into a byte

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


def cast_rays(world: World, poses: npt.ArrayLike, angles: npt.ArrayLike, people: Array | None = None) -> Array:
    """(N, B) distances in m from poses (N, 3) in map along ``angles`` (B,); +inf if nothing is hit.

    Rays also end at ``people`` (P, 3), circles of x, y and radius in m.
    """
    return _cast_rays(world, np.zeros((0, 3)) if people is None else people, poses, angles, derivatives=False)[0]


def cast_rays_with_jacobian(world: World, poses: npt.ArrayLike, angles: npt.ArrayLike) -> tuple[Array, Array]:
    """The result of `cast_rays`, and its derivatives (N, B, 3) by x, y (m/m) and yaw (m/rad) of the pose.

    The derivative of a distance is dr = -(n . dp + r n . u' dyaw) / (n . u), with the surface's normal n and the ray's
    direction u. It is 0 if nothing is hit.
    """
    return _cast_rays(world, np.zeros((0, 3)), poses, angles, derivatives=True)


def _cast_rays(
    world: World, people: Array, poses: npt.ArrayLike, angles: npt.ArrayLike, *, derivatives: bool
) -> tuple[Array, Array]:
    # Copied, because numba compiles again for arrays that are read-only or not contiguous.
    poses, angles = np.array(poses, float, order="C").reshape(-1, 3), np.array(angles, float, order="C").ravel()
    shape = (len(poses), len(angles))
    ranges, jacobian = np.empty(shape), np.zeros((*(shape if derivatives else (0, 0)), 3))
    _cast(world.outline_index.arrays, np.array(people, float), *_cells_of(world.grid), poses, angles, ranges, jacobian)
    return ranges, jacobian


@functools.lru_cache(MAX_CACHED_GRIDS)
def _cells_of(grid: OccupancyGrid | None) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.uint8], Array]:
    """Occupied cells (rows, columns), `clear_radius` of each cell, and frame (4,).

    There is a border of empty cells, through which rays enter and leave the grid. The frame is x, y (m) and yaw (rad)
    in map of the lower left corner, and the edge length of a cell in m. Without a grid there are no cells.
    """
    if grid is None:
        return np.zeros((0, 0), np.bool_), np.zeros((0, 0), np.uint8), np.zeros(4)
    occupied = np.pad(grid.values == OCCUPIED, 1)
    corner = grid.to_map(np.array([-grid.resolution, -grid.resolution]))
    return occupied, clear_radius(occupied), np.array([*corner, grid.origin[2], grid.resolution])


def clear_radius(occupied: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """(rows, columns) half-widths in cells of an empty square around each cell; 0 for occupied cells."""
    if not occupied.any():
        return np.full(occupied.shape, MAX_CLEAR_RADIUS, np.uint8)
    distance = ndimage.distance_transform_cdt(~occupied, "chessboard")
    return np.asarray(np.clip(distance - 1, 0, MAX_CLEAR_RADIUS), np.uint8)


@jit
def _cast(
    outlines: IndexArrays,
    people: Array,
    occupied: npt.NDArray[np.bool_],
    clear: npt.NDArray[np.uint8],
    frame: Array,
    poses: Array,
    angles: Array,
    ranges: Array,
    jacobian: Array,
) -> None:
    """Fills ranges (N, B), and jacobian (N, B, 3) unless it is empty."""
    size, cos, sin = frame[3], math.cos(frame[2]), math.sin(frame[2])
    for k in range(poses.shape[0]):
        x, y, yaw = poses[k, 0], poses[k, 1], poses[k, 2]
        mx, my = (x - frame[0]) / size, (y - frame[1]) / size
        column, row = cos * mx + sin * my, cos * my - sin * mx  # of the pose, in cells
        for b in range(angles.shape[0]):
            heading = yaw + angles[b]
            ux, uy = math.cos(heading), math.sin(heading)
            r, nx, ny = _nearest_outline(outlines, x, y, ux, uy)
            for s in range(people.shape[0]):
                distance = _distance_to_circle(people, s, x, y, ux, uy)
                if distance < r:
                    r, nx, ny = distance, *_circle_normal(people, s, x, y, ux, uy, distance)
            if occupied.size:
                heading -= frame[2]
                hit, hx, hy = _nearest_cell(
                    occupied, clear, column, row, math.cos(heading), math.sin(heading), r / size
                )
                if hit < np.inf:
                    r, nx, ny = hit * size, cos * hx - sin * hy, sin * hx + cos * hy
            ranges[k, b] = r
            if jacobian.size and r < np.inf:
                dot = nx * ux + ny * uy
                if dot > 0.0:  # the normal points towards the scanner
                    nx, ny, dot = -nx, -ny, -dot
                cosine = -min(dot, -MIN_COSINE)
                jacobian[k, b, 0], jacobian[k, b, 1] = nx / cosine, ny / cosine
                jacobian[k, b, 2] = r * (ny * ux - nx * uy) / cosine


@jit
def _nearest_outline(outlines: IndexArrays, x: float, y: float, ux: float, uy: float) -> tuple[float, float, float]:
    """Distance in m along the unit vector (ux, uy) to the nearest segment or circle, and its normal; +inf if none."""
    segments, circles, starts, members, (rows, columns), (left, low, size) = outlines
    px, py = (x - left) / size, (y - low) / size
    t, leaves = _cross_grid(px, py, ux, uy, columns, rows)
    nearest, which = np.inf, -1
    column = min(max(math.floor(px + t * ux), 0), columns - 1)
    row = min(max(math.floor(py + t * uy), 0), rows - 1)
    while t < leaves and 0 <= column < columns and 0 <= row < rows:
        cell = row * columns + column
        for m in range(starts[cell], starts[cell + 1]):
            s = members[m]
            if s < segments.shape[0]:
                r = _distance_to_segment(segments, s, x, y, ux, uy)
            else:
                r = _distance_to_circle(circles, s - segments.shape[0], x, y, ux, uy)
            # Of outlines that meet at a corner, the one with the lowest index is taken, whichever cell lists it first.
            if r < nearest or (r == nearest and s < which):
                nearest, which = r, s
        to_x, to_y = _distance_to_edge(px, ux, column, 0), _distance_to_edge(py, uy, row, 0)
        t = min(to_x, to_y)
        if nearest <= t * size:  # the hit is inside this cell, so no later cell has a nearer one
            break
        if to_x <= to_y:
            column += 1 if ux > 0 else -1
        else:
            row += 1 if uy > 0 else -1
    if which < 0:
        return np.inf, 0.0, 0.0
    if which >= segments.shape[0]:
        return nearest, *_circle_normal(circles, which - segments.shape[0], x, y, ux, uy, nearest)
    ex, ey = segments[which, 2] - segments[which, 0], segments[which, 3] - segments[which, 1]
    length = math.hypot(ex, ey)
    return nearest, -ey / length, ex / length


@jit
def _distance_to_segment(segments: Array, s: int, x: float, y: float, ux: float, uy: float) -> float:
    """Distance in m from (x, y) along (ux, uy) to segment s of (S, 4); +inf if the ray misses it."""
    ax, ay = segments[s, 0] - x, segments[s, 1] - y
    ex, ey = segments[s, 2] - segments[s, 0], segments[s, 3] - segments[s, 1]
    det = ux * ey - uy * ex
    if det == 0.0:
        return np.inf
    r, along = (ax * ey - ay * ex) / det, (ax * uy - ay * ux) / det
    return r if r >= 0.0 and 0.0 <= along <= 1.0 else np.inf


@jit
def _distance_to_circle(circles: Array, c: int, x: float, y: float, ux: float, uy: float) -> float:
    """Distance in m from (x, y) along (ux, uy) to circle c of (C, 3); +inf if the ray misses it or begins in it."""
    cx, cy, radius = circles[c, 0] - x, circles[c, 1] - y, circles[c, 2]
    middle = cx * ux + cy * uy
    discriminant = middle * middle - (cx * cx + cy * cy - radius * radius)
    if discriminant < 0.0:
        return np.inf
    r = middle - math.sqrt(discriminant)
    return r if r >= 0.0 else np.inf


@jit
def _circle_normal(circles: Array, c: int, x: float, y: float, ux: float, uy: float, r: float) -> tuple[float, float]:
    """The normal of circle c of (C, 3) where a ray ends after ``r`` m."""
    return (x + r * ux - circles[c, 0]) / circles[c, 2], (y + r * uy - circles[c, 1]) / circles[c, 2]


@jit
def _nearest_cell(
    occupied: npt.NDArray[np.bool_],
    clear: npt.NDArray[np.uint8],
    x: float,
    y: float,
    ux: float,
    uy: float,
    max_distance: float,
) -> tuple[float, float, float]:
    """Distance in cells to the nearest occupied cell, and its normal; +inf if none is nearer than ``max_distance``.

    A ray that starts in an occupied cell ends where it enters an empty one, as with rays against the outlines of the
    cells.
    """
    rows, columns = occupied.shape
    t, leaves = _cross_grid(x, y, ux, uy, columns, rows)
    if t >= leaves:
        return np.inf, 0.0, 0.0
    column = min(max(math.floor(x + t * ux), 0), columns - 1)
    row = min(max(math.floor(y + t * uy), 0), rows - 1)
    starts_occupied = occupied[row, column]
    while t < max_distance:
        radius = np.int64(clear[row, column])  # int() would keep it unsigned
        to_x = _distance_to_edge(x, ux, column, radius)
        to_y = _distance_to_edge(y, uy, row, radius)
        if to_x <= to_y:
            t, nx, ny = to_x, -math.copysign(1.0, ux), 0.0
            column += radius + 1 if ux > 0 else -radius - 1
            row = _cell_of(y + t * uy, uy, row, radius)
        else:
            t, nx, ny = to_y, 0.0, -math.copysign(1.0, uy)
            row += radius + 1 if uy > 0 else -radius - 1
            column = _cell_of(x + t * ux, ux, column, radius)
        if column < 0 or column >= columns or row < 0 or row >= rows:
            break
        if occupied[row, column] != starts_occupied:
            return (t if t < max_distance else np.inf), nx, ny
    return np.inf, 0.0, 0.0


@jit
def _cross_grid(x: float, y: float, ux: float, uy: float, columns: int, rows: int) -> tuple[float, float]:
    """Distances at which a ray enters (0 inside) and leaves the grid; if it misses, the second is at most the first."""
    first, last = 0.0, np.inf
    for start, along, size in ((x, ux, columns), (y, uy, rows)):
        if along == 0.0:
            if start < 0 or start >= size:
                last = -np.inf
            continue
        near, far = -start / along, (size - start) / along
        first, last = max(first, min(near, far)), min(last, max(near, far))
    return first, last


@jit
def _distance_to_edge(start: float, along: float, cell: int, radius: int) -> float:
    """Distance along a ray to the edge of the empty square around ``cell``, on one axis."""
    return np.inf if along == 0.0 else (cell + (radius + 1 if along > 0 else -radius) - start) / along


@jit
def _cell_of(position: float, along: float, cell: int, radius: int) -> int:
    """The cell at ``position``, limited to the cells of the empty square that the ray has not passed yet.

    Rounding errors therefore never move a ray backwards, so that the traversal ends.
    """
    low, high = (cell, cell + radius) if along >= 0 else (cell - radius, cell)
    return min(max(math.floor(position), low), high)
