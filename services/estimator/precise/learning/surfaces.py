"""Beams of posed scans, and the surfaces where they end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from common.errors import UserError
from common.geometry.grid_values import are_inside, values_at
from common.geometry.se2 import Array, compose
from services.estimator.precise.field import DistanceField, Floats
from services.estimator.precise.learning.beam_cells import count_crossings

BEAMS_AT_ONCE = 2_000_000  # processed together, which limits memory
MAX_CELLS = 100_000_000  # 250 000 m² in cells of 5 cm, which need 6 GB
WRONG_RANGES = (
    "Check that ranges are in metres, and that `range_max` (section `log` of the --config file) is the range that the "
    "driver reports for no return"
)
POOL_CELLS = 1  # cells to each side whose points are pooled to find a normal
ELEMENT_RADIUS_CELLS = 2.0  # around a surface element, within which it shapes the field
MIN_POINTS_PER_CELL = 3  # cells with fewer points are no surface
PASSED_DEPTH_M = 0.06  # a beam that ends farther behind a surface has passed through it
MIN_PRESENT_SHARE = 0.3  # a surface is removed if a smaller share of the beams that meet it end there


@dataclass(frozen=True)
class Beams:
    """Single beams of scans with known poses: starts (R, 2) m and directions (R,) rad in map, ranges (R,) m."""

    starts: Array
    directions: Array
    ranges: Array

    @classmethod
    def of(cls, poses: Array, mount: Array, angles: Array, ranges: Array) -> Beams:
        """All beams with a return, from scans ``ranges`` (N, B) m at base_link poses (N, 3)."""
        lasers = compose(poses, mount)
        returned = np.isfinite(ranges) & (ranges > 0)
        row, column = np.nonzero(returned)
        return cls(lasers[row, :2], lasers[row, 2] + angles[column], ranges[returned])

    def check_any(self) -> None:
        """Raises UserError if there are no beams."""
        if not len(self.ranges):
            raise UserError(f"no surface to learn from: no two beams end near each other. {WRONG_RANGES}")

    def ends(self) -> Array:
        """End points (R, 2), m in map."""
        return np.asarray(self.starts + self.ranges[:, None] * self.unit())

    def unit(self) -> Array:
        """Unit directions (R, 2) in map."""
        return np.stack([np.cos(self.directions), np.sin(self.directions)], -1)

    def part(self, which: np.ndarray | slice) -> Beams:
        """Returns the beams that a mask, indices or a slice select."""
        return Beams(self.starts[which], self.directions[which], self.ranges[which])

    def parts(self, which: npt.NDArray[np.intp] | None = None) -> Iterator[Beams]:
        """All beams, or those that indices select, at most `BEAMS_AT_ONCE` at a time."""
        for begin in range(0, len(self.ranges if which is None else which), BEAMS_AT_ONCE):
            part = slice(begin, begin + BEAMS_AT_ONCE)
            yield self.part(part if which is None else which[part])

    def bounds(self) -> tuple[Array, Array]:
        """The least and the greatest x and y (2,) in m of starts and ends."""
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for part in self.parts():
            for points in (part.starts, part.ends()):
                low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
        return low, high

    def joined(self, other: Beams) -> Beams:
        """Returns these beams and those of ``other``."""
        return Beams(
            np.concatenate([self.starts, other.starts]),
            np.concatenate([self.directions, other.directions]),
            np.concatenate([self.ranges, other.ranges]),
        )


@dataclass(frozen=True)
class SurfaceCells:
    """Cells of a grid in which beams end, with a surface element (mean, normal) each; arrays (rows, columns)."""

    low: Array  # (2,) m in map, corner of cell (0, 0)
    cell_m: float  # edge length
    counts: Array  # beams that end in the cell
    mean_x: Array  # m from `low`
    mean_y: Array
    normal_x: Array  # towards free space
    normal_y: Array

    @classmethod
    def of(cls, beams: Beams, cell_m: float) -> SurfaceCells:
        """The cells of ``cell_m`` m in which beams end. Raises UserError if there are too many, or no beams."""
        beams.check_any()
        low, high = beams.bounds()
        low = low - 4 * cell_m
        shape = np.ceil((high + 4 * cell_m - low) / cell_m).astype(int)[::-1] + 1
        if float(np.prod(shape, dtype=float)) > MAX_CELLS:
            width, height = high - low
            raise UserError(
                f"the beams end in an area of {width:.0f} m x {height:.0f} m, which is too large for cells of "
                f"{cell_m:g} m. {WRONG_RANGES}"
            )
        sums = np.zeros((8, int(shape.prod())))
        for part in beams.parts():
            local, (ux, uy) = part.ends() - low, part.unit().T
            cell = np.floor(local / cell_m).astype(int)
            index, (x, y) = cell[:, 1] * shape[1] + cell[:, 0], local.T
            for total, values in zip(sums, (None, x, y, x**2, y**2, x * y, ux, uy), strict=True):
                np.add(total, np.bincount(index, values, len(total)), out=total)
        counts = sums[0].reshape(shape)
        pooled, sx, sy, sxx, syy, sxy, dx, dy = (_pooled(each.reshape(shape)) for each in sums)
        pooled = np.maximum(pooled, 1)
        mean_x, mean_y = sx / pooled, sy / pooled
        xx, yy, xy = sxx / pooled - mean_x**2, syy / pooled - mean_y**2, sxy / pooled - mean_x * mean_y
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the surface, the long axis of the points
        normal_x, normal_y = -np.sin(angle), np.cos(angle)
        # Normals point against the beams, towards free space.
        flip = np.where(normal_x * dx + normal_y * dy > 0, -1.0, 1.0)
        return cls(low, cell_m, counts, mean_x, mean_y, normal_x * flip, normal_y * flip)

    @property
    def is_surface(self) -> npt.NDArray[np.bool_]:
        """Mask (rows, columns) of cells in which enough beams end."""
        return np.asarray(self.counts >= MIN_POINTS_PER_CELL)

    def crossings(self, beams: Beams) -> Array:
        """Counts (rows, columns) of beams that passed through the element of each cell."""
        crossed = np.zeros(self.counts.shape)
        elements = self.mean_x, self.mean_y, self.normal_x, self.normal_y
        for part in beams.parts():
            starts = part.starts - self.low
            count_crossings(
                starts, part.unit(), part.ranges, self.cell_m, self.is_surface, *elements, PASSED_DEPTH_M, crossed
            )
        return crossed

    def contradicted_by(self, beams: Beams) -> npt.NDArray[np.bool_]:
        """Mask (rows, columns) of cells whose surface element is absent: most beams that meet it pass through it."""
        crossed = _pooled(self.crossings(beams))
        row, column = self._cells_at(beams.ends())
        inside = are_inside(self.counts.shape, row, column)
        ended = np.zeros(self.counts.shape)
        np.add.at(ended, (row[inside], column[inside]), 1.0)
        ended = _pooled(ended)
        return are_mostly_passed(ended, crossed)

    def at(self, mask: npt.NDArray[np.bool_], points: Array) -> npt.NDArray[np.bool_]:
        """The values (N,) of a mask (rows, columns) at points (N, 2) m in map; False beyond the grid."""
        return values_at(mask, *self._cells_at(points), beyond=False)

    def _cells_at(self, points: Array) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Rows (N,) and columns (N,) of points (N, 2) m in map."""
        column, row = np.floor((points - self.low) / self.cell_m).astype(int).T
        return row, column


def are_mostly_passed(ended: Array, passed: Array) -> npt.NDArray[np.bool_]:
    """Whether so many beams passed, and so few ended, that no surface can be there; element by element."""
    return np.asarray((passed >= MIN_POINTS_PER_CELL) & (ended < MIN_PRESENT_SHARE * (ended + passed)))


def field_of_surfaces(beams: Beams, cell_m: float) -> DistanceField:
    """The field from surface elements in cells of ``cell_m`` m, without those that most beams passed through."""
    cells = SurfaceCells.of(beams, cell_m)
    crossed = cells.crossings(beams)
    surface = cells.is_surface & (cells.counts >= MIN_PRESENT_SHARE * (cells.counts + crossed))
    return DistanceField(_distances(cells, surface), (float(cells.low[0]), float(cells.low[1])), cell_m)


def _pooled(grid: Array) -> Array:
    """The sum of each cell and those around it."""
    return np.asarray(ndimage.correlate(grid, np.ones((2 * POOL_CELLS + 1,) * 2), mode="constant"))


def _distances(cells: SurfaceCells, surface: npt.NDArray[np.bool_]) -> Floats:
    """Distances phi at the nodes: near surface elements to their planes, elsewhere to the nearest element.

    The elements are those of the cells in the mask ``surface`` (rows, columns). They count by the square root of the
    number of their beams, and by a Gaussian of their distance, with a standard deviation of 0.58 cells.
    """
    rows, columns = np.nonzero(surface)
    mean_x, mean_y = cells.mean_x[surface], cells.mean_y[surface]
    normal_x, normal_y = cells.normal_x[surface], cells.normal_y[surface]
    element_weight, cell_m = np.sqrt(cells.counts[surface]), cells.cell_m
    total, weight = np.zeros(surface.shape), np.zeros(surface.shape)
    span = int(np.ceil(ELEMENT_RADIUS_CELLS)) + 1
    for di in range(-span, span + 1):
        for dj in range(-span, span + 1):
            i, j = rows + di, columns + dj
            inside = are_inside(surface.shape, i, j)
            x, y = j * cell_m - mean_x, i * cell_m - mean_y
            square = (x**2 + y**2) / cell_m**2
            w = np.where(inside & (square < ELEMENT_RADIUS_CELLS**2), np.exp(-1.5 * square) * element_weight, 0.0)
            np.add.at(total, (i[inside], j[inside]), (w * (normal_x * x + normal_y * y))[inside])
            np.add.at(weight, (i[inside], j[inside]), w[inside])
    near = weight > 0
    phi = np.divide(total, weight, out=np.zeros_like(total), where=near)
    nodes = np.argwhere(~near)[:, ::-1] * cell_m
    phi[~near], _ = cKDTree(np.column_stack([mean_x, mean_y])).query(nodes)
    return phi.astype(np.float32)
