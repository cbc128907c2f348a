"""A world as data: walls and furniture in metres, free space, and exact ray distances."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
import shapely
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import UserError

if TYPE_CHECKING:
    from common.se2 import Array

FOLDER = Path(__file__).resolve().parent.parent / "worlds"

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Length = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e5)]
Point = tuple[Number, Number]
Ring = Annotated[list[Point], Field(min_length=3, max_length=10_000)]

# What safe_load raises: a date like 2020-13-45 is a ValueError, 20 000 opening brackets end the recursion.
NOT_YAML = (yaml.YAMLError, ValueError, RecursionError)

CIRCLE_SEGMENTS = 64  # a quarter circle in free space: 0.04 mm off at a radius of 0.5 m


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Box(_Model):
    """A rectangle."""

    center: Point  # m
    size: tuple[Length, Length]  # m, along its own x and y
    yaw_deg: Number = 0.0

    def corners(self) -> Array:
        """(4, 2) m, counter-clockwise."""
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(self.size) / 2
        yaw = np.deg2rad(self.yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        return np.asarray(half @ turn.T + np.array(self.center))


class Circle(_Model):
    """A disc."""

    center: Point  # m
    radius: Length  # m


class Obstacle(_Model):
    """One piece of furniture: exactly one of polygon, box, circle."""

    name: Annotated[str, Field(max_length=200)] = ""
    polygon: Ring | None = None  # m, corners in order
    box: Box | None = None
    circle: Circle | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Obstacle:
        if sum(shape is not None for shape in (self.polygon, self.box, self.circle)) != 1:
            raise ValueError("an obstacle is exactly one of polygon, box, circle")
        if self.polygon is not None:
            _check_ring(self.polygon)
        return self

    def ring(self) -> Array | None:
        """(V, 2) corners in m, or None for a circle."""
        if self.polygon is not None:
            return np.array(self.polygon)
        return self.box.corners() if self.box is not None else None

    def shape(self) -> shapely.Geometry:
        """The area it covers."""
        if self.circle is not None:
            return shapely.Point(self.circle.center).buffer(self.circle.radius, quad_segs=CIRCLE_SEGMENTS)
        return shapely.Polygon(self.ring())


class Start(_Model):
    """Where the robot stands at first."""

    x: Number  # m
    y: Number  # m
    yaw_deg: Number = 0.0


class World(_Model):
    """The boundary's inside, less the obstacles, is free."""

    name: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[\w.-]+$")]
    boundary: Ring  # m, the walls
    obstacles: Annotated[list[Obstacle], Field(max_length=10_000)] = []
    start: Start | None = None

    @model_validator(mode="after")
    def _boundary_is_simple(self) -> World:
        _check_ring(self.boundary)
        return self

    @functools.cached_property
    def segments(self) -> Array:
        """(S, 4) x0, y0, x1, y1 in m of every straight edge."""
        rings = [np.array(self.boundary)] + [ring for o in self.obstacles if (ring := o.ring()) is not None]
        return np.concatenate([np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in rings])

    @functools.cached_property
    def circles(self) -> Array:
        """(C, 3) x, y, radius in m."""
        return np.array([[*o.circle.center, o.circle.radius] for o in self.obstacles if o.circle]).reshape(-1, 3)

    @functools.cached_property
    def free_space(self) -> shapely.Geometry:
        """Where a point may be."""
        return shapely.Polygon(self.boundary).difference(shapely.union_all([o.shape() for o in self.obstacles]))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in m of the boundary."""
        corners = np.array(self.boundary)
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    def center(self) -> Array:
        """(2,) m, the middle of the boundary's bounding box: where the paper's belief begins."""
        x0, y0, x1, y1 = self.bounds
        return np.array([(x0 + x1) / 2, (y0 + y1) / 2])

    def clearance(self, points: npt.ArrayLike) -> Array:
        """(N,) m from points (N, 2) to the nearest wall or obstacle; negative inside one or outside the world."""
        where = shapely.points(np.asarray(points, float).reshape(-1, 2))
        distance = shapely.distance(where, shapely.boundary(self.free_space))
        return np.where(shapely.contains(self.free_space, where), distance, -distance)

    def sample_free(self, count: int, rng: np.random.Generator, clearance: float = 0.0) -> Array:
        """(count, 2) points uniform over free space, at least ``clearance`` m from everything.

        Raises UserError where there is no such place.
        """
        x0, y0, x1, y1 = self.bounds
        room = shapely.buffer(self.free_space, -clearance)
        if room.is_empty:
            raise UserError(f"world {self.name!r} has no place {clearance} m clear of everything")
        found: list[Array] = []
        while sum(map(len, found)) < count:
            points = rng.uniform([x0, y0], [x1, y1], (max(count, 256), 2))
            found.append(points[shapely.contains(room, shapely.points(points)) & (self.clearance(points) >= clearance)])
        return np.concatenate(found)[:count]

    def start_pose(self, clearance: float) -> Array:
        """(3,) the start, or where none is stated the free place nearest the centre."""
        if self.start is not None:
            return np.array([self.start.x, self.start.y, np.deg2rad(self.start.yaw_deg)])
        room = shapely.buffer(self.free_space, -clearance)
        if room.is_empty:
            raise UserError(f"world {self.name!r} has no place {clearance} m clear of everything")
        nearest = shapely.shortest_line(room, shapely.Point(self.center()))
        return np.array([*shapely.get_coordinates(nearest)[0], 0.0])

    def ray_distances(self, poses: npt.ArrayLike, angles: npt.ArrayLike) -> Array:
        """(N, B) m from scanner poses (N, 3) in map along ``angles`` (B,) in laser; +inf where nothing is hit.

        Exact: rays against segments and circles, no grid.
        """
        poses, angles = np.asarray(poses, float).reshape(-1, 3), np.asarray(angles, float)
        # Blocks of about 20 MB keep the temporaries in memory that is already there.
        block = max(1, 2_500_000 // (len(angles) * max(len(self.segments), 1)))
        parts = [self._ray_block(poses[i : i + block], angles) for i in range(0, len(poses), block)]
        return np.concatenate(parts) if parts else np.zeros((0, len(angles)))

    def _ray_block(self, poses: Array, angles: Array) -> Array:
        heading = poses[:, 2:3] + angles
        dx, dy = np.cos(heading)[..., None], np.sin(heading)[..., None]  # (N, B, 1)
        ax, ay = (self.segments[:, k] - poses[:, k : k + 1] for k in (0, 1))  # (N, S)
        ex, ey = self.segments[:, 2] - self.segments[:, 0], self.segments[:, 3] - self.segments[:, 1]  # (S,)
        with np.errstate(divide="ignore", invalid="ignore"):
            det = dx * ey - dy * ex
            along = (ax * ey - ay * ex)[:, None, :] / det
            u = (ax[:, None, :] * dy - ay[:, None, :] * dx) / det
        hit = (along >= 0) & (u >= 0) & (u <= 1)
        best = np.where(hit, along, np.inf).min(axis=-1)
        for cx, cy, radius in self.circles:
            px, py = cx - poses[:, 0:1], cy - poses[:, 1:2]  # (N, 1)
            middle = px * dx[..., 0] + py * dy[..., 0]
            under = middle**2 - (px**2 + py**2 - radius**2)
            near = middle - np.sqrt(np.where(under >= 0, under, np.nan))
            best = np.fmin(best, np.where(near >= 0, near, np.inf))
        return np.asarray(best)


def _check_ring(ring: list[tuple[float, float]]) -> None:
    polygon = shapely.Polygon(ring)
    if not polygon.is_valid or polygon.area <= 0:
        raise ValueError(f"the polygon is not simple: {shapely.is_valid_reason(polygon)}")


def known_worlds() -> list[str]:
    """Names of the worlds that are shipped."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_world(name: str) -> World:
    """The shipped world of that name, or the world in that file; raises UserError saying what is wrong and where."""
    path = FOLDER / f"{name}.yaml" if name in known_worlds() else Path(name)
    try:
        data: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
        return World.model_validate(data)
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"no world {name!r}: give a file or one of {', '.join(known_worlds())}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"world {path}: cannot be read ({error})") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise UserError(f"world {path}: {'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}") from None
    except NOT_YAML as error:
        raise UserError(f"world {path}: no YAML ({' '.join(str(error).split())})") from None


def save_world(world: World) -> str:
    """The world as YAML text that `load_world` reads."""
    return str(yaml.safe_dump(world.model_dump(mode="json", exclude_defaults=True), sort_keys=False))
