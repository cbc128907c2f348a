"""An occupancy grid: free, occupied and unknown cells, and the geometry derived from them.

Occupied cells are squares: a beam ends where it meets the first one. Unknown cells stop no beam, but nobody may be in
them. What follows from the cells is computed once for a map, however many worlds are made of it.
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
from common.geometry.cell_rays import CellRays
from common.geometry.se2 import rotate
from common.limits import Angle, Coordinate

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Mask = npt.NDArray[np.bool_]

Cells = npt.NDArray[np.uint8]

FREE, OCCUPIED, UNKNOWN = 0, 100, 255  # as in nav_msgs/OccupancyGrid, whose -1 is 255 in a byte without a sign
MAX_CELLS = 16_000_000  # 4000 by 4000
KEPT = 4  # maps whose shapes are remembered


class OccupancyGrid(BaseModel):
    """A map of square cells."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Annotated[int, Field(ge=1, le=MAX_CELLS)]  # cells along the map's own x
    height: Annotated[int, Field(ge=1, le=MAX_CELLS)]  # cells along its y
    resolution: Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e3)]  # m, a cell's edge
    origin: tuple[Coordinate, Coordinate, Angle]  # m, m, rad: lower left corner of the first cell, in map
    cells: Annotated[str, Field(max_length=4 * MAX_CELLS)]
    # base64 of zlib of a byte a cell, row by row from the lower left: 0 free, 100 occupied, 255 unknown

    @classmethod
    def of(cls, values: Cells, resolution: float, origin: tuple[float, float, float]) -> OccupancyGrid:
        """From (rows, columns) of FREE, OCCUPIED, UNKNOWN, the lowest row first; ValueError for other values."""
        packed = base64.b64encode(zlib.compress(np.ascontiguousarray(values, np.uint8).tobytes())).decode()
        height, width = values.shape
        return cls(width=width, height=height, resolution=resolution, origin=origin, cells=packed)

    @model_validator(mode="after")
    def _cells_are_cells(self) -> OccupancyGrid:
        if self.width * self.height > MAX_CELLS:
            raise ValueError(f"{self.width} x {self.height} cells are more than {MAX_CELLS}")
        _unpacked(self.cells, self.width, self.height)
        return self

    @property
    def values(self) -> Cells:
        """(height, width) of FREE, OCCUPIED, UNKNOWN, the lowest row first; read-only."""
        return _unpacked(self.cells, self.width, self.height)

    @property
    def shapes(self) -> GridShapes:
        """What follows from the cells."""
        return _shapes(self)

    def corners(self) -> list[tuple[float, float]]:
        """The map's edge, counter-clockwise, m in map; no wall."""
        wide, high = self.width * self.resolution, self.height * self.resolution
        x, y = self.to_map(np.array([[0, 0], [wide, 0], [wide, high], [0, high]])).T.tolist()
        return list(zip(x, y, strict=True))

    def to_map(self, points: npt.ArrayLike) -> Array:
        """(N, 2) m in map of points (N, 2) m from the map's lower left corner, along its edges."""
        x, y, yaw = self.origin
        moved: Array = (rotate(yaw, points) if yaw else np.asarray(points, float)) + np.array([x, y])
        return moved

    def from_map(self, points: Array) -> Array:
        """The inverse of `to_map`."""
        x, y, yaw = self.origin
        moved = np.asarray(points, float) - np.array([x, y])
        return rotate(-yaw, moved) if yaw else moved

    def at(self, points: Array) -> Cells:
        """(N,) the cells that points (N, 2) m in map lie in; UNKNOWN off the map."""
        column, row = np.floor(self.from_map(points) / self.resolution).astype(int).T
        on = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        found = np.full(len(on), UNKNOWN, np.uint8)
        found[on] = self.values[row[on], column[on]]
        return found


@functools.lru_cache(KEPT)
def _unpacked(packed: str, width: int, height: int) -> Cells:
    """Raises ValueError where the text is not this many cells; it never becomes more bytes than they are."""
    reader, count = zlib.decompressobj(), width * height
    try:
        plain = reader.decompress(base64.b64decode(packed, validate=True), count)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise ValueError(f"the cells are not base64 of zlib ({error})") from None
    if len(plain) != count or not reader.eof or reader.unused_data:
        raise ValueError(f"the cells are not {width} x {height} bytes")
    values = np.frombuffer(plain, np.uint8).reshape(height, width)
    if not np.isin(values, (FREE, OCCUPIED, UNKNOWN)).all():
        raise ValueError(f"a cell is {FREE} free, {OCCUPIED} occupied or {UNKNOWN} unknown")
    return values


@functools.lru_cache(KEPT)
def _shapes(grid: OccupancyGrid) -> GridShapes:
    return GridShapes(grid)


@dataclass(frozen=True, eq=False)
class GridShapes:
    """Geometry of one map, made when it is first asked for."""

    grid: OccupancyGrid
    _trees: dict[int, shapely.STRtree] = field(default_factory=dict)  # of the edges of the cells of a kind

    @functools.cached_property
    def walls(self) -> Array:
        """(S, 4) x0, y0, x1, y1 in m in map: the faces of occupied cells, those in line and side by side as one."""
        return self._in_map(outline(self.grid.values == OCCUPIED))

    @functools.cached_property
    def free_space(self) -> shapely.Geometry:
        """The free cells as polygons, in map."""
        free = self.grid.values == FREE
        faces = shapely.get_parts(shapely.polygonize(_lines(outline(free).astype(float))))
        column, row = np.floor(shapely.get_coordinates(shapely.point_on_surface(faces))).astype(int).T.reshape(2, -1)
        local = shapely.multipolygons(faces[free[row, column]])
        turned: shapely.Geometry = shapely.transform(local, lambda at: self.grid.to_map(at * self.grid.resolution))
        return turned

    @functools.cached_property
    def rays(self) -> CellRays:
        """Where beams end."""
        return CellRays(self.grid.values == OCCUPIED)

    def ray_distances(self, poses: Array, angles: Array) -> Array:
        """(N, B) m from poses (N, 3) in map along ``angles`` (B,) to occupied cells; +inf where none is hit."""
        grid = self.grid
        x, y = np.repeat(grid.from_map(poses[:, :2]) / grid.resolution, len(angles), axis=0).T
        heading = (poses[:, 2:3] + angles - grid.origin[2]).ravel()
        found = self.rays.distances(x, y, np.cos(heading), np.sin(heading))
        return (found * grid.resolution).reshape(len(poses), len(angles))

    def distance(self, kind: int, points: Array) -> Array:
        """(N,) m from points (N, 2) in map to the edge of the cells of a kind; negative within them."""
        within = self.grid.at(points) == kind
        if kind not in self._trees:
            self._trees[kind] = shapely.STRtree(_lines(self._in_map(outline(self.grid.values == kind))))
        away = np.full(len(points), np.inf)
        if len(points) and len(self._trees[kind]):
            found, distance = self._trees[kind].query_nearest(
                shapely.points(points), return_distance=True, all_matches=False
            )
            away[found[0]] = distance
        return np.where(within, -away, away)

    def lattice_distances(self, kind: int, x: Array, y: Array, most: float = np.inf) -> Array:
        """(len(y), len(x)) m: `distance` of nodes in map, ascending, as far as ``most``; fast on a map not turned."""
        grid = self.grid
        if grid.origin[2]:
            nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            return np.clip(self.distance(kind, nodes).reshape(len(y), len(x)), -most, most)
        x, y = (x - grid.origin[0]) / grid.resolution, (y - grid.origin[1]) / grid.resolution
        return signed_distance(grid.values == kind, x, y, most / grid.resolution) * grid.resolution

    def cells_with_clearance(self, clearance: float) -> npt.NDArray[np.int_]:
        """(K, 2) column and row of the free cells with ``clearance`` m or more from middle to edge of free space."""
        free, size = self.grid.values == FREE, self.grid.resolution
        if clearance <= size / 2:
            return np.argwhere(free)[:, ::-1]
        x, y = (np.arange(side, dtype=float) + 0.5 for side in (self.grid.width, self.grid.height))
        return np.argwhere(inner_distance(free, x, y, clearance / size + 1) * size >= clearance)[:, ::-1]

    def points_in_cells(self, cells: npt.NDArray[np.int_], shares: npt.ArrayLike) -> Array:
        """(N, 2) m in map, at ``shares`` (N, 2) of the edges of cells (N, 2) column, row."""
        return self.grid.to_map((cells + np.asarray(shares)) * self.grid.resolution)

    def _in_map(self, runs: npt.NDArray[np.int_]) -> Array:
        return self.grid.to_map(runs.reshape(-1, 2) * self.grid.resolution).reshape(-1, 4)


def outline(mask: Mask) -> npt.NDArray[np.int_]:
    """(S, 4) x0, y0, x1, y1 in cells: where ``mask`` (rows, columns) and the rest meet, whole straight pieces.

    Pieces meet at their ends alone: where two cells touch with a corner, they end.
    """
    padded = np.pad(mask, 1).astype(np.int8)
    line, begin, end = _runs(np.diff(padded, axis=0))
    level = np.column_stack([begin, line, end, line])
    line, begin, end = _runs(np.diff(padded, axis=1).T)
    return np.concatenate([level, np.column_stack([line, begin, line, end])])


def _runs(step: npt.NDArray[np.int8]) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.int_], npt.NDArray[np.int_]]:
    """Line, begin and end of the runs of equal steps up or down in padded cells."""
    nothing = np.zeros((len(step), 1), np.int8)
    edged = np.hstack([nothing, step, nothing])
    before, after = edged[:, :-1], edged[:, 1:]
    changes = before != after
    line, begin = np.nonzero(changes & (after != 0))
    _, end = np.nonzero(changes & (before != 0))
    return line, begin - 1, end - 1


def _lines(segments: Array) -> npt.NDArray[np.object_]:
    """(S,) from (S, 4)."""
    return np.asarray(shapely.linestrings(segments.reshape(-1, 2, 2)))
