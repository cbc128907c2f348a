"""An occupancy grid: free, occupied and unknown cells, and the geometry derived from them.

Occupied cells are squares, and a beam ends at the first one it meets. Unknown cells do not stop beams, but no robot may
be in them. Cells and geometry are cached, so that equal grids of several worlds are decoded only once.
"""

from __future__ import annotations

import base64
import binascii
import functools
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt
import shapely
from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.geometry.cell_distance import inner_distance, signed_distance
from common.geometry.grid_values import values_at
from common.geometry.se2 import rotate
from common.limits import Angle, Coordinate

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Mask = npt.NDArray[np.bool_]

Cells = npt.NDArray[np.uint8]

FREE, OCCUPIED, UNKNOWN = 0, 100, 255  # as in nav_msgs/OccupancyGrid, whose -1 is 255 in an unsigned byte
MAX_CELLS = 16_000_000  # 4000 by 4000
MAX_CACHED_GRIDS = 4


class OccupancyGrid(BaseModel):
    """A map of square cells."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Annotated[int, Field(ge=1, le=MAX_CELLS)]  # cells along x
    height: Annotated[int, Field(ge=1, le=MAX_CELLS)]  # cells along y
    resolution: Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e3)]  # m, edge length of a cell
    origin: tuple[Coordinate, Coordinate, Angle]  # x m, y m, yaw rad in map of the lower left corner
    # one byte per cell, row by row from the lower left, zlib, base64: 0 free, 100 occupied, 255 unknown
    cells: Annotated[str, Field(max_length=4 * MAX_CELLS)]

    @classmethod
    def of(cls, values: Cells, resolution: float, origin: tuple[float, float, float]) -> OccupancyGrid:
        """Creates a grid from cells (rows, columns) of FREE, OCCUPIED and UNKNOWN, lowest row first.

        Raises ValueError for other values.
        """
        packed = base64.b64encode(zlib.compress(np.ascontiguousarray(values, np.uint8).tobytes())).decode()
        height, width = values.shape
        return cls(width=width, height=height, resolution=resolution, origin=origin, cells=packed)

    @model_validator(mode="after")
    def _check_cells(self) -> OccupancyGrid:
        if self.width * self.height > MAX_CELLS:
            raise ValueError(f"{self.width} x {self.height} cells are more than {MAX_CELLS}")
        _decode(self.cells, self.width, self.height)
        return self

    @property
    def values(self) -> Cells:
        """(height, width) cells of FREE, OCCUPIED and UNKNOWN, lowest row first; read-only."""
        return _decode(self.cells, self.width, self.height)

    @property
    def geometry(self) -> GridGeometry:
        """Geometry derived from the cells."""
        return _geometry(self)

    def corners(self) -> list[tuple[float, float]]:
        """Corners of the grid in m in map, counter-clockwise. The edge of the grid is not a wall."""
        width, height = self.width * self.resolution, self.height * self.resolution
        return [(x, y) for x, y in self.to_map([(0, 0), (width, 0), (width, height), (0, height)]).tolist()]

    def to_map(self, points: npt.ArrayLike) -> Array:
        """Transforms points (N, 2) in m from the grid's frame, with origin at its lower left corner, to map."""
        x, y, yaw = self.origin
        rotated = rotate(yaw, points) if yaw else np.asarray(points, float)
        return np.asarray(rotated + np.array([x, y]))

    def from_map(self, points: Array) -> Array:
        """Inverse of `to_map`."""
        x, y, yaw = self.origin
        moved = np.asarray(points, float) - np.array([x, y])
        return rotate(-yaw, moved) if yaw else moved

    def values_at(self, points: Array) -> Cells:
        """(N,) values of the cells at points (N, 2) in m in map; UNKNOWN outside the grid."""
        column, row = np.floor(self.from_map(points) / self.resolution).astype(int).T
        return values_at(self.values, row, column, np.uint8(UNKNOWN))


@functools.lru_cache(MAX_CACHED_GRIDS)
def _decode(packed: str, width: int, height: int) -> Cells:
    """Decodes cells; raises ValueError if they are invalid. Never decompresses more bytes than there are cells."""
    reader, count = zlib.decompressobj(), width * height
    try:
        plain = reader.decompress(base64.b64decode(packed, validate=True), count)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise ValueError(f"the cells are not zlib-compressed and base64-encoded ({error})") from None
    if len(plain) != count or not reader.eof or reader.unused_data:
        raise ValueError(f"the decompressed cells are not {width} x {height} bytes")
    values = np.frombuffer(plain, np.uint8).reshape(height, width)
    if not np.isin(values, (FREE, OCCUPIED, UNKNOWN)).all():
        raise ValueError(f"each cell must be {FREE} (free), {OCCUPIED} (occupied) or {UNKNOWN} (unknown)")
    return values


@functools.lru_cache(MAX_CACHED_GRIDS)
def _geometry(grid: OccupancyGrid) -> GridGeometry:
    return GridGeometry(grid)


@dataclass(frozen=True, eq=False)
class GridGeometry:
    """Geometry of one grid, computed when it is first used."""

    grid: OccupancyGrid
    _trees: dict[int, shapely.STRtree] = field(default_factory=dict)  # outlines of the cells of each value

    @functools.cached_property
    def walls(self) -> Array:
        """(S, 4) x0, y0, x1, y1 in m in map of the occupied cells' outlines; collinear edges are merged."""
        return self._in_map(outline(self.grid.values == OCCUPIED))

    @functools.cached_property
    def free_space(self) -> shapely.Geometry:
        """The free cells as polygons, in map."""
        free = self.grid.values == FREE
        faces = shapely.get_parts(shapely.polygonize(_lines(outline(free).astype(float))))
        column, row = np.floor(shapely.get_coordinates(shapely.point_on_surface(faces))).astype(int).T.reshape(2, -1)
        local = shapely.multipolygons(faces[free[row, column]])
        in_map: shapely.Geometry = shapely.transform(local, lambda xy: self.grid.to_map(xy * self.grid.resolution))
        return in_map

    def distance(self, value: int, points: Array) -> Array:
        """(N,) distances in m from points (N, 2) in map to the edge of the cells with ``value``; negative inside."""
        if value not in self._trees:
            self._trees[value] = shapely.STRtree(_lines(self._in_map(outline(self.grid.values == value))))
        tree, to_edge = self._trees[value], np.full(len(points), np.inf)
        if len(points) and len(tree):
            found, distance = tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)
            to_edge[found[0]] = distance
        return np.where(self.grid.values_at(points) == value, -to_edge, to_edge)

    def lattice_distances(self, value: int, x: Array, y: Array, max_distance: float = np.inf) -> Array:
        """(R, C) `distance` in m at the nodes of a lattice with ascending coordinates x (C,) and y (R,) in m in map.

        Distances are limited to ``max_distance``. Much faster than `distance`, unless the grid is rotated in map.
        """
        grid = self.grid
        if grid.origin[2]:
            nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            return np.clip(self.distance(value, nodes).reshape(len(y), len(x)), -max_distance, max_distance)
        x, y = (x - grid.origin[0]) / grid.resolution, (y - grid.origin[1]) / grid.resolution
        return signed_distance(grid.values == value, x, y, max_distance / grid.resolution) * grid.resolution

    def cells_with_clearance(self, clearance: float) -> npt.NDArray[np.int_]:
        """(K, 2) column and row of free cells whose centre is at least ``clearance`` m from the edge of free space."""
        free, size = self.grid.values == FREE, self.grid.resolution
        if clearance <= size / 2:  # all free cells
            return np.argwhere(free)[:, ::-1]
        x, y = (np.arange(side, dtype=float) + 0.5 for side in (self.grid.width, self.grid.height))
        return np.argwhere(inner_distance(free, x, y, clearance / size + 1) * size >= clearance)[:, ::-1]

    def points_in_cells(self, cells: npt.NDArray[np.int_], shares: npt.ArrayLike) -> Array:
        """(N, 2) points in m in map inside cells (N, 2) column, row.

        ``shares`` (N, 2), from 0 to 1, are the positions within the cells along x and y; 0.5 is the centre.
        """
        return self.grid.to_map((cells + np.asarray(shares)) * self.grid.resolution)

    def _in_map(self, segments: npt.NDArray[np.int_]) -> Array:
        """Segments (S, 4) in cells, in m in map."""
        return self.grid.to_map(segments.reshape(-1, 2) * self.grid.resolution).reshape(-1, 4)


def outline(mask: Mask) -> npt.NDArray[np.int_]:
    """(S, 4) x0, y0, x1, y1 in cells of the edges of a mask (rows, columns), with collinear edges merged.

    Segments meet only at their ends: where two cells touch at a corner, segments end there.
    """
    padded = np.pad(mask, 1).astype(np.int8)
    y, x0, x1 = _runs(np.diff(padded, axis=0))
    horizontal = np.column_stack([x0, y, x1, y])
    x, y0, y1 = _runs(np.diff(padded, axis=1).T)
    return np.concatenate([horizontal, np.column_stack([x, y0, x, y1])])


def _runs(steps: npt.NDArray[np.int8]) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.int_], npt.NDArray[np.int_]]:
    """Row, begin and end of the runs of equal nonzero steps, in coordinates of the cells before padding."""
    zeros = np.zeros((len(steps), 1), np.int8)
    padded = np.hstack([zeros, steps, zeros])
    before, after = padded[:, :-1], padded[:, 1:]
    changes = before != after
    row, begin = np.nonzero(changes & (after != 0))
    _, end = np.nonzero(changes & (before != 0))  # in the same order as the beginnings: runs do not overlap
    return row, begin - 1, end - 1


def _lines(segments: Array) -> npt.NDArray[np.object_]:
    """(S,) shapely lines from segments (S, 4)."""
    return np.asarray(shapely.linestrings(segments.reshape(-1, 2, 2)))
