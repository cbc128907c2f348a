"""A world: walls and furniture in metres, or a ROS map, of one floor or several; free space and exact ranges."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
import shapely
import yaml
from pydantic import Field, ValidationError, model_validator

from common.errors import UserError, first_fault
from common.geometry import building, ros_map
from common.geometry.floors import (
    Floor,
    Lift,
    bounds_of,
    check_floors,
    corners_of,
    floor_at,
    place_text,
    unknown_floor_message,
)
from common.geometry.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from common.geometry.shapes import Box, Circle, Degrees, Obstacle, Ring, WorldName, WorldPart, check_ring
from common.limits import MAX_WORLD_AREA_M2, Coordinate
from common.yaml_text import NOT_YAML, TooLargeError, parse_yaml

if TYPE_CHECKING:
    from common.geometry.outline_index import OutlineIndex
    from common.geometry.se2 import Array

__all__ = ["Box", "Circle", "Obstacle", "Start", "World", "known_worlds", "load_world", "save_world"]

FOLDER = Path(__file__).resolve().parents[2] / "worlds"


POINTS_PER_BLOCK = 100_000  # a shapely point needs a few hundred bytes
MAX_SAMPLING_ATTEMPTS = 50  # after this many attempts without a result, a grid counts as having no suitable place


class Start(WorldPart):
    """Initial pose of the robot."""

    x: Coordinate  # m
    y: Coordinate  # m
    yaw_deg: Degrees = 0.0


class World(WorldPart):
    """A world. Free space is the inside of the walls, or the free cells of the grid, without the obstacles.

    The walls are the boundary, or those of the floors. The edge of a grid is not a wall.
    """

    name: WorldName
    boundary: Ring  # m, the walls; optional with a grid or floors
    obstacles: Annotated[list[Obstacle], Field(max_length=10_000)] = []  # noqa: RUF012 - pydantic copies it
    start: Start | None = None
    # a ROS map; left out if there is none
    grid: Annotated[OccupancyGrid | None, Field(exclude_if=lambda grid: grid is None)] = None
    # side by side in map
    floors: Annotated[list[Floor], Field(max_length=100, exclude_if=lambda floors: not floors)] = []  # noqa: RUF012
    # places x m, y m of a lift by floor, in the floor's frame
    lifts: Annotated[list[Lift], Field(max_length=1000, exclude_if=lambda lifts: not lifts)] = []  # noqa: RUF012

    @model_validator(mode="before")
    @classmethod
    def _default_boundary(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "boundary" in data:
            return data
        if data.get("grid") is not None:
            grid = OccupancyGrid.model_validate(data["grid"])
            return {**data, "grid": grid, "boundary": grid.corners()}
        if data.get("floors"):
            floors = [Floor.model_validate(floor) for floor in data["floors"]]
            return {**data, "floors": floors, "boundary": _box_around(floors)}
        return data

    @model_validator(mode="after")
    def _boundary_is_simple(self) -> World:
        check_ring(self.boundary)
        if self.grid is not None and not (
            len(self.boundary) == 4 and np.allclose(self.boundary, self.grid.corners(), rtol=0, atol=1e-6)
        ):
            raise ValueError("the boundary of a world with a grid is the grid's edge: leave it out")
        if self.floors and self.grid is None and self.boundary != _box_around(self.floors):
            raise ValueError("the boundary of a world with floors is the box around them: leave it out")
        check_floors(self.floors, self.lifts)
        boxes = [floor.bounds for floor in self.floors] or [self.bounds]
        for x0, y0, x1, y1 in boxes if self.grid is None else ():
            if (area := (x1 - x0) * (y1 - y0)) > MAX_WORLD_AREA_M2:
                raise ValueError(
                    f"the walls are {x1 - x0:g} m by {y1 - y0:g} m, {area * 1e-6:.3g} km², but a floor has at most "
                    f"{MAX_WORLD_AREA_M2 * 1e-6:g} km²: are the units metres?"
                )
        return self

    @model_validator(mode="after")
    def _obstacles_differ(self) -> World:
        taken: set[str] = set()
        for obstacle in self.obstacles:
            if obstacle.name in taken:
                raise ValueError(f"two obstacles are named {obstacle.name!r}; give each a name of its own")
            if obstacle.name == "boundary":
                raise ValueError("an obstacle is named 'boundary', as the walls are; give it another name")
            if obstacle.name:
                taken.add(obstacle.name)
        return self

    def with_obstacles(self, obstacles: list[Obstacle]) -> World:
        """The same world with other obstacles."""
        # Not a copy, which would keep the cached geometry.
        return World(
            name=self.name,
            boundary=self.boundary,
            obstacles=obstacles,
            start=self.start,
            grid=self.grid,
            floors=self.floors,
            lifts=self.lifts,
        )

    @property
    def wall_rings(self) -> list[Ring]:
        """The closed rings of walls in m: the boundary, or that of each floor; none in a world with a grid."""
        if self.grid is not None:
            return []
        return [floor.boundary for floor in self.floors] or [self.boundary]

    def floor_at(self, place: npt.ArrayLike) -> Floor | None:
        """The floor on which a point (2,) or pose (3,) in map is; None between floors, and in a world without any."""
        return floor_at(self.floors, place)

    def floor(self, name: str) -> Floor:
        """The floor of that name; raises UserError if there is none."""
        for floor in self.floors:
            if floor.name == name:
                return floor
        if not self.floors:
            raise UserError(f"there is no floor {name!r}: world {self.name!r} has no floors")
        raise UserError(unknown_floor_message(name, [floor.name for floor in self.floors]))

    def to_map(self, places: npt.ArrayLike, floor: str) -> Array:
        """Transforms points (..., 2) or poses (..., 3) from the frame of a floor (from map, if it is empty) to map.

        Raises UserError if there is no floor of that name, or a place is off the floor.
        """
        if not floor:
            return np.asarray(places, float)
        if (error := self.floor(floor).placement_error(places)) is not None:
            raise UserError(error)
        return self.floor(floor).to_map(places)

    @functools.cached_property
    def segments(self) -> Array:
        """(S, 4) x0, y0, x1, y1 in m of all straight edges of walls and obstacles."""
        return self.outlines if self.grid is None else np.concatenate([self.grid.geometry.walls, self.outlines])

    @functools.cached_property
    def outlines(self) -> Array:
        """(S, 4) the `segments` without those of the grid's cells."""
        rings = [np.array(ring) for ring in self.wall_rings]
        rings += [ring for o in self.obstacles if (ring := o.ring()) is not None]
        return np.concatenate([np.zeros((0, 4)), *(np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in rings)])

    @functools.cached_property
    def circles(self) -> Array:
        """(C, 3) x, y, radius in m of the round obstacles."""
        return np.array([[*o.circle.center, o.circle.radius] for o in self.obstacles if o.circle]).reshape(-1, 3)

    @functools.cached_property
    def outline_index(self) -> OutlineIndex:
        """The outlines and circles, by the cells of a grid."""
        from common.geometry.outline_index import OutlineIndex  # numba, which most services do not need

        return OutlineIndex.of(self.outlines, self.circles)

    @functools.cached_property
    def furniture(self) -> shapely.Geometry:
        """The area that the obstacles cover."""
        return shapely.union_all([o.shape() for o in self.obstacles])

    @functools.cached_property
    def free_space(self) -> shapely.Geometry:
        """The free area."""
        return shapely.difference(self._inside, self.furniture)

    @functools.cached_property
    def _inside(self) -> shapely.Geometry:
        """The area within the walls, including that under obstacles."""
        if self.grid is not None:
            return self.grid.geometry.free_space
        if self.floors:
            return shapely.union_all([shapely.Polygon(ring) for ring in self.wall_rings])
        return shapely.Polygon(self.boundary)

    @functools.cached_property
    def _free_area(self) -> _Area:
        return _Area(self.free_space)

    @functools.cached_property
    def _furniture_area(self) -> _Area:
        return _Area(self.furniture)

    @property
    def free_area(self) -> float:
        """Size of the free area in m²; for a grid, that of its free cells, including those under obstacles."""
        if self.grid is None:
            return float(shapely.area(self.free_space))
        return float(np.count_nonzero(self.grid.values == FREE)) * self.grid.resolution**2

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in m of the boundary's bounding box."""
        return bounds_of(self.boundary)

    def center(self) -> Array:
        """(2,) centre of the bounding box in m, at which the paper's belief starts."""
        x0, y0, x1, y1 = self.bounds
        return np.array([(x0 + x1) / 2, (y0 + y1) / 2])

    def clearance(self, points: npt.ArrayLike) -> Array:
        """(N,) distances in m from points (N, 2) to the edge of free space; negative outside it."""
        points = np.asarray(points, float).reshape(-1, 2)
        if self.grid is None:
            return self._free_area.signed_distance(points)
        return self._limit_by_obstacles(points, 0.0 - self.grid.geometry.distance(FREE, points))

    def surface_distance(self, points: npt.ArrayLike) -> Array:
        """(N,) distances in m from points (N, 2) to the nearest surface, negative behind; unknown cells have none."""
        points = np.asarray(points, float).reshape(-1, 2)
        if self.grid is None:
            return self._free_area.signed_distance(points)
        return self._limit_by_obstacles(points, self.grid.geometry.distance(OCCUPIED, points))

    def has_room(self, place: Array, radius: float) -> bool:
        """Whether a robot of ``radius`` m can stand at a point (2,) or pose (3,)."""
        return bool(self.clearance(place[:2])[0] >= radius)

    def placement_error(self, place: Array, radius: float) -> str | None:
        """The reason why a robot of ``radius`` m cannot stand at a point (2,) or pose (3,), or None if it can."""
        if self.has_room(place, radius):
            return None
        problem = lack_of_room(float(self.clearance(place[:2])[0]), radius)
        return f"{place_text(self.floors, place)} in {self.name} {problem}"

    def clearance_on_lattice(self, x: Array, y: Array) -> Array:
        """(len(y), len(x)) `clearance` in m at the nodes x, y of a lattice in map, ascending."""
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if self.grid is None:
            return self.clearance(nodes).reshape(len(y), len(x))
        clearance = 0.0 - self.grid.geometry.lattice_distances(FREE, x, y)  # subtracted, to avoid -0.0
        return self._limit_by_obstacles(nodes, clearance.ravel()).reshape(len(y), len(x))

    def surface_distance_on_lattice(self, x: Array, y: Array, max_distance: float) -> Array:
        """(len(y), len(x)) distances in m to the nearest surface that a laser sees, negative behind surfaces.

        x and y are the nodes of a lattice in map, ascending. Distances are limited to ``max_distance``. A laser does
        not see unknown cells.
        """
        if self.grid is not None:
            nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            distance = self.grid.geometry.lattice_distances(OCCUPIED, x, y, max_distance).ravel()
            distance = self._limit_by_obstacles(nodes, distance)
            return np.clip(distance, -max_distance, max_distance).reshape(len(y), len(x))
        columns = [self._free_area.signed_distance(np.column_stack([np.full(len(y), x_k), y])) for x_k in x]
        return np.clip(np.stack(columns, axis=1), -max_distance, max_distance)

    def _limit_by_obstacles(self, points: Array, distance: Array) -> Array:
        """(N,) the smaller one of ``distance`` and the distance of points (N, 2) to the obstacles."""
        return np.minimum(distance, -self._furniture_area.signed_distance(points)) if self.obstacles else distance

    def sample_free(self, count: int, rng: np.random.Generator, clearance: float = 0.0) -> Array:
        """(count, 2) points distributed uniformly over free space, at least ``clearance`` m from its edge.

        Raises UserError if there is no such place.
        """
        if self.grid is not None:
            return self._sample_cells(count, rng, clearance)
        return self._sample(self._room(clearance), count, rng, clearance)

    def sample_within_walls(self, count: int, rng: np.random.Generator) -> Array:
        """(count, 2) points distributed uniformly within the walls, also under obstacles; free cells in a grid."""
        return self._sample(self._inside, count, rng)

    def _sample(
        self, area: shapely.Geometry, count: int, rng: np.random.Generator, clearance: float | None = None
    ) -> Array:
        """(count, 2) points distributed uniformly over the area, of those with at least the ``clearance`` if given."""
        x0, y0, x1, y1 = self.bounds
        shapely.prepare(area)
        found: list[Array] = []
        while sum(map(len, found)) < count:
            points = rng.uniform([x0, y0], [x1, y1], (max(count, 256), 2))
            points = points[shapely.contains(area, shapely.points(points))]
            found.append(points if clearance is None else points[self.clearance(points) >= clearance])
        return np.concatenate(found)[:count]

    def sample_poses(self, count: int, rng: np.random.Generator, clearance: float) -> Array:
        """Random poses (count, 3) at places from `sample_free`, with uniform headings."""
        places = self.sample_free(count, rng, clearance)
        return np.column_stack([places, rng.uniform(-np.pi, np.pi, count)])

    def _sample_cells(self, count: int, rng: np.random.Generator, clearance: float) -> Array:
        """`sample_free` on a grid: samples points in cells that may have the clearance, and keeps those that do."""
        assert self.grid is not None  # noqa: S101 - for the type checker
        geometry = self.grid.geometry
        # The resolution is more than half a cell's diagonal, so that all cells with suitable points are included.
        cells = geometry.cells_with_clearance(clearance - self.grid.resolution)
        found, attempts_left = [np.zeros((0, 2))], MAX_SAMPLING_ATTEMPTS
        while attempts_left and len(cells) and sum(map(len, found)) < count:
            chosen = rng.integers(len(cells), size=max(count, 256))
            points = geometry.points_in_cells(cells[chosen], rng.random((len(chosen), 2)))
            found.append(points[self.clearance(points) >= clearance])
            attempts_left = attempts_left if len(found[-1]) else attempts_left - 1
        if sum(map(len, found)) < count:
            raise self._no_room(clearance)
        return np.concatenate(found)[:count]

    def _no_room(self, clearance: float) -> UserError:
        return UserError(f"world {self.name!r} has no place {clearance} m clear of walls and obstacles")

    def start_pose(self, clearance: float) -> Array:
        """(3,) the world's start pose; if it has none, the position with ``clearance`` m that is nearest to the centre.

        In a building, this is the centre of the first floor.
        Raises UserError if there is no such position.
        """
        if self.start is not None:
            return np.array([self.start.x, self.start.y, np.deg2rad(self.start.yaw_deg)])
        x0, y0, x1, y1 = self.floors[0].bounds if self.floors else self.bounds
        centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        if self.grid is not None:
            geometry = self.grid.geometry
            places = geometry.points_in_cells(geometry.cells_with_clearance(clearance), 0.5)
            places = places[self._limit_by_obstacles(places, np.full(len(places), np.inf)) >= clearance]
            if not len(places):
                raise self._no_room(clearance)
            return np.array([*places[np.argmin(np.hypot(*(places - centre).T))], 0.0])
        nearest = shapely.shortest_line(self._room(clearance), shapely.Point(centre))
        return np.array([*shapely.get_coordinates(nearest)[0], 0.0])

    def _room(self, clearance: float) -> shapely.Geometry:
        """`space_with_clearance`; raises UserError if it is empty."""
        room = self.space_with_clearance(clearance)
        if shapely.is_empty(room):
            raise self._no_room(clearance)
        return room

    def space_with_clearance(self, clearance: float) -> shapely.Geometry:
        """The part of free space at least ``clearance`` m from its edge."""
        if clearance not in self._spaces:
            # Obstacles are widened one by one, because narrowing a free space with thousands of holes takes a minute.
            widened = shapely.union_all(shapely.buffer([each.shape() for each in self.obstacles], clearance))
            self._spaces[clearance] = shapely.difference(shapely.buffer(self._inside, -clearance), widened)
        return self._spaces[clearance]

    @functools.cached_property
    def _spaces(self) -> dict[float, shapely.Geometry]:
        """Results of `space_with_clearance`, by clearance."""
        return {}

    def ray_distances(self, poses: npt.ArrayLike, angles: npt.ArrayLike) -> Array:
        """(N, B) exact distances in m from scanner poses (N, 3) in map along ``angles`` (B,) in laser.

        They are +inf if nothing is hit.
        """
        from common.geometry.ray_casting import cast_rays  # numba, which most services do not need

        return cast_rays(self, poses, angles)


class _Area:
    """An area with a spatial index of its edges, for fast distances."""

    def __init__(self, area: shapely.Geometry) -> None:
        shapely.prepare(area)
        ends, ring = shapely.get_coordinates(shapely.get_parts(shapely.boundary(area)), return_index=True)
        joined = ring[1:] == ring[:-1]
        self._area = area
        self._edges = shapely.STRtree(shapely.linestrings(np.stack([ends[:-1], ends[1:]], axis=1)[joined]))

    def signed_distance(self, points: Array) -> Array:
        """(N,) distances in m from points (N, 2) to the edge of the area; positive inside."""
        blocks = [points[begin : begin + POINTS_PER_BLOCK] for begin in range(0, len(points), POINTS_PER_BLOCK)]
        return np.concatenate([self._signed(block) for block in blocks]) if blocks else np.zeros(0)

    def _signed(self, points: Array) -> Array:
        where, distance = shapely.points(points), np.full(len(points), np.inf)
        if len(self._edges):
            found, near = self._edges.query_nearest(where, return_distance=True, all_matches=False)
            distance[found[0]] = near
        return np.where(shapely.contains(self._area, where), distance, -distance)


def _box_around(floors: list[Floor]) -> list[tuple[float, float]]:
    return corners_of(bounds_of([corner for floor in floors for corner in floor.boundary]))


def lack_of_room(clearance: float, radius: float) -> str:
    """What is wrong with a place for a robot of ``radius`` m, ``clearance`` m from the edge of free space."""
    if clearance < 0:
        return "is inside something, or off the map"
    # Adding 0 turns -0, the clearance at a corner, into 0.
    return f"is {clearance + 0.0:.2f} m from a wall, and the robot needs {radius:g} m around it"


def known_worlds() -> list[str]:
    """Names of the shipped worlds."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_world(name: str) -> World:
    """The shipped world of that name, or the world, building or ROS map in that file.

    Raises UserError if it is invalid.
    """
    return _load(name, Path())


def _load(name: str, folder: Path, *, is_floor: bool = False) -> World:
    """`load_world` of a file relative to ``folder``; a floor must not be a building, which might contain itself."""
    path = FOLDER / f"{name}.yaml" if name in known_worlds() else folder / name
    try:
        return _world_of(path, parse_yaml(path.read_text(encoding="utf-8")), is_floor=is_floor)
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"no world {str(path)!r}: give a file or one of {', '.join(known_worlds())}") from None
    except UnicodeDecodeError:
        image = path.suffix.lower() in ros_map.IMAGE_SUFFIXES
        hint = (
            f"an image: give the map.yaml that names it, such as {path.with_suffix('.yaml')}" if image else "not text"
        )
        raise UserError(f"world {path}: {hint}") from None
    except OSError as error:
        raise UserError(f"world {path}: cannot be read ({error})") from None
    except ValidationError as error:
        raise UserError(f"world {path}: {first_fault(error)}") from None
    except TooLargeError as error:
        raise UserError(f"world {path}: {error}") from None
    except NOT_YAML as error:
        raise UserError(f"world {path}: not valid YAML ({' '.join(str(error).split())})") from None


def world_name(path: Path) -> str:
    """Name of a world that is made from a file, such as a log, which does not state one."""
    return re.sub(r"[^\w.-]+", "-", path.resolve().stem)


def _world_of(path: Path, data: Any, *, is_floor: bool) -> World:
    """The world in the ``data`` of a file; raises UserError or ValidationError if they are invalid."""
    if isinstance(data, dict):
        data.setdefault("name", world_name(path))
    if not building.is_building(data):
        return World.model_validate(ros_map.read_map(path, data) if ros_map.is_map(data) else data)
    if is_floor:
        raise UserError("a floor cannot be a building with floors of its own")
    try:
        return _load_building(path.parent, data)
    except UserError as error:
        raise UserError(f"world {path}: {error}") from None


def _load_building(folder: Path, data: dict[str, Any]) -> World:
    """The building in ``data``, whose files are relative to ``folder``; raises UserError if it is invalid."""
    file = building.read_building(data)
    floors = {}
    for name, world in file.floors.items():
        try:
            floors[name] = _load(world, folder, is_floor=True)
        except UserError as error:
            raise UserError(f"floor {name!r}: {error}") from None
    laid_out = World.model_validate(building.lay_out(file, floors))
    for number, lift in enumerate(laid_out.lifts, 1):
        for name, (x, y) in lift.items():
            if laid_out.clearance(laid_out.to_map((x, y), name))[0] <= 0:
                raise UserError(f"lift {number}: ({x:g}, {y:g}) is not in free space of floor {name!r}")
    return laid_out


def save_world(world: World) -> str:
    """The world as YAML text that `load_world` reads."""
    return str(yaml.safe_dump(world.model_dump(mode="json", exclude_defaults=True), sort_keys=False))
