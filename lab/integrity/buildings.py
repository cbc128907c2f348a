"""Generated office buildings: corridors, rooms with doors, and furniture that repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import shapely

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.shapes import Box, Obstacle
from common.geometry.world import World
from lab.accuracy.furniture import CATALOGUE, FloorSpace, FurniturePiece, Point, Shape

Kind = Literal["office", "symmetric", "corridor"]

WALL_M, DOOR_M = 0.12, 1.05  # thickness, and width between the ends of the walls' centre lines
DOOR_AREA_M = 0.9  # kept free on both sides of a door
MIN_DOOR_OFFSET_M = 0.8  # of a door's centre from the corner of a room
TEMPLATES = 3  # different sets of furniture in a building
PLACE_DEVIATION_M, YAW_DEVIATION = 0.08, np.deg2rad(3)  # between rooms with the same set
CORRIDOR_SPACING_M = 4.0  # mean distance between pieces along a corridor
WALL_GAP_M = 0.03  # between a wall and a piece that stands against it

CORRIDOR_CATALOGUE = (CATALOGUE[1], CATALOGUE[8])  # shelf and plant


@dataclass(frozen=True)
class Room:
    """A rectangular room or corridor, in its own frame: its corner is the origin, and a room's door is at y = depth."""

    corner: tuple[float, float, float]  # pose in map of the own frame; the yaw is a multiple of 90 degrees
    width: float  # m, along its own x
    depth: float  # m, along its own y
    door: float | None = None  # m, the door's centre along its own x; None for a corridor

    def box(self, x: float, y: float, size: Point) -> Obstacle:
        """A box at a place in the room's frame, parallel to it."""
        center, turned = se2.transform(self.corner, [x, y]), abs(np.sin(self.corner[2])) > 0.5
        return Obstacle(box=Box(center=(float(center[0]), float(center[1])), size=size[::-1] if turned else size))

    def door_panel(self) -> Obstacle | None:
        """The closed door; None for a corridor."""
        return None if self.door is None else self.box(self.door, self.depth, (DOOR_M, 0.05))

    def door_area(self) -> shapely.Geometry:
        """The area around the door in which nothing stands; empty for a corridor."""
        if self.door is None:
            return shapely.Polygon()
        return self.box(self.door, self.depth, (DOOR_M, 2 * DOOR_AREA_M)).shape()


@dataclass(frozen=True)
class Building:
    """A building: what stays (walls) and what may move (furniture)."""

    name: str
    boundary: tuple[Point, ...]
    walls: tuple[Obstacle, ...]
    rooms: tuple[Room, ...]  # with the corridors, whose door is None
    furniture: tuple[FurniturePiece, ...] = ()

    @cached_property
    def world(self) -> World:
        """The building with its furniture."""
        return self.world_with(())

    def world_with(self, extra: Sequence[Obstacle]) -> World:
        """The building with its furniture and other obstacles."""
        obstacles = [*self.walls, *(part for piece in self.furniture for part in piece.obstacles), *extra]
        return World(name=self.name, boundary=list(self.boundary), obstacles=obstacles)

    def floor(self) -> FloorSpace:
        """The floor without furniture."""
        doors = shapely.union_all([room.door_area() for room in self.rooms])
        return FloorSpace(World(name=self.name, boundary=list(self.boundary), obstacles=list(self.walls)), doors)

    def furnished(self, pieces: Sequence[FurniturePiece]) -> Building:
        """The same walls with other furniture."""
        return replace(self, furniture=tuple(pieces))


def make_building(seed: int, kind: Kind = "office") -> Building:
    """The building of a seed, 80 to 300 m².

    ``symmetric`` has identical rooms on both sides of a corridor; ``corridor`` is 35 m of plain walls with one room.
    """
    rng = np.random.default_rng([seed, 20])
    alike = kind == "symmetric"
    if alike:
        boundary, walls, rooms = _corridor(rng, alike=True)
    else:
        plan = _long_corridor if kind == "corridor" else (_corridor, _corner, _ring)[rng.integers(3)]
        boundary, walls, rooms = plan(rng)
    empty = Building(f"{kind}-{seed}", tuple(boundary), tuple(walls), tuple(rooms))
    floor = empty.floor()
    templates = [_template(rng, int(rng.integers(9, 14))) for _ in range(1 if alike else TEMPLATES)]
    for room in rooms:
        if room.door is not None:
            items = templates[rng.integers(len(templates))]
            _furnish(floor, room, items, rng, 0.0 if alike else 1.0)
        elif kind != "corridor":
            count = 1 if alike else round(max(room.width, room.depth) / CORRIDOR_SPACING_M)
            _furnish(floor, room, _template(rng, count, CORRIDOR_CATALOGUE), rng, 1.0)
    return empty.furnished(floor.pieces)


FloorPlan = tuple[list[Point], list[Obstacle], list[Room]]


def _corridor(rng: np.random.Generator, *, alike: bool = False) -> FloorPlan:
    """Rooms on both sides of a straight corridor."""
    length, corridor_width, depth, north_depth = rng.uniform(12, 22), rng.uniform(1.7, 2.4), *rng.uniform(3.2, 5.0, 2)
    north_depth = depth if alike else north_depth
    height = depth + corridor_width + north_depth
    south = _row(rng, (0.0, 0.0, 0.0), length, depth, equal=alike)
    # The same divisions, turned by half a turn, if the rooms are alike.
    north = _turned(south, length, height) if alike else _row(rng, (length, height, np.pi), length, north_depth)
    walls = [wall for row in (south, north) for wall in _walls_of(row)]
    return _rectangle(length, height), walls, [*south, *north, Room((0.0, depth, 0.0), length, corridor_width)]


def _corner(rng: np.random.Generator) -> FloorPlan:
    """A corridor with a corner, and rooms on its outer side."""
    length, height = rng.uniform(13, 18), rng.uniform(11, 16)
    depth, wide = rng.uniform(3.5, 4.5), rng.uniform(1.7, 2.2)
    inner, top = length - depth, depth + wide
    south = _row(rng, (0.0, 0.0, 0.0), length, depth, corner_room=depth + 2 * MIN_DOOR_OFFSET_M)
    east = _row(rng, (length, depth, np.pi / 2), height - depth, depth)
    boundary = [(0.0, 0.0), (length, 0.0), (length, height), (inner - wide, height), (inner - wide, top), (0.0, top)]
    corridors = [Room((0.0, depth, 0.0), inner, wide), Room((inner - wide, depth, 0.0), wide, height - depth)]
    return boundary, [*_walls_of(south), *_walls_of(east)], [*south, *east, *corridors]


def _ring(rng: np.random.Generator) -> FloorPlan:
    """A ring of corridors around a block of rooms, and a row of rooms on one side."""
    length, wide, depth, block = rng.uniform(12, 17), rng.uniform(1.6, 2.0), rng.uniform(3.2, 4.5), rng.uniform(3, 4.5)
    south = _row(rng, (0.0, 0.0, 0.0), length, depth)
    low, high = depth + wide, depth + wide + block
    core = _row(rng, (wide, low, 0.0), length - 2 * wide, block)
    around = [_wall((wide, low), (length - wide, low))]
    around += [_wall((x, low), (x, high)) for x in (wide, length - wide)]
    corridors = [
        Room((0.0, depth, 0.0), length, wide),
        Room((0.0, high, 0.0), length, wide),
        Room((0.0, low, 0.0), wide, block),
        Room((length - wide, low, 0.0), wide, block),
    ]
    walls = [*_walls_of(south), *_walls_of(core), *around]
    return _rectangle(length, high + wide), walls, [*south, *core, *corridors]


def _long_corridor(rng: np.random.Generator) -> FloorPlan:
    """A long corridor with plain walls, and one room at its end."""
    length, wide, depth = 35.0, rng.uniform(1.8, 2.4), rng.uniform(3.5, 4.5)
    room = Room((0.0, 0.0, 0.0), 4.5, depth, 2.0)
    walls = [_wall((0.0, depth), (2.0 - DOOR_M / 2, depth)), _wall((2.0 + DOOR_M / 2, depth), (4.5, depth))]
    boundary = [(0.0, 0.0), (4.5, 0.0), (4.5, depth), (length, depth), (length, depth + wide), (0.0, depth + wide)]
    return boundary, walls, [room, Room((0.0, depth, 0.0), length, wide)]


def _row(
    rng: np.random.Generator,
    corner: tuple[float, float, float],
    length: float,
    depth: float,
    *,
    equal: bool = False,
    corner_room: float = 0.0,
) -> list[Room]:
    """Rooms side by side along the x axis of ``corner``, with doors at y = depth.

    With ``corner_room`` m, the last room has this width, and its door is at its beginning.
    """
    length -= corner_room
    count = max(2, round(length / rng.uniform(3.2, 5.0)))
    shares = np.ones(count) if equal or rng.random() < 0.5 else rng.uniform(0.75, 1.25, count)
    edges = length * np.concatenate([[0.0], np.cumsum(shares) / shares.sum()])
    side = rng.uniform(0.25, 0.75)
    rooms = []
    for begin, end in pairwise(edges.tolist()):
        door = MIN_DOOR_OFFSET_M + (end - begin - 2 * MIN_DOOR_OFFSET_M) * (side if equal else rng.uniform())
        rooms.append(Room(_along_x(corner, begin), end - begin, depth, door))
    if corner_room:
        rooms.append(Room(_along_x(corner, length), corner_room, depth, MIN_DOOR_OFFSET_M))
    return rooms


def _along_x(corner: tuple[float, float, float], distance: float) -> tuple[float, float, float]:
    """The pose ``corner`` moved by ``distance`` m along its x axis."""
    x, y, yaw = se2.compose(corner, [distance, 0.0, 0.0]).tolist()
    return x, y, yaw


def _turned(rooms: list[Room], length: float, height: float) -> list[Room]:
    """The rooms turned by 180 degrees about the centre of a building."""
    return [
        replace(room, corner=(length - room.corner[0], height - room.corner[1], room.corner[2] + np.pi))
        for room in rooms
    ]


def _walls_of(row: list[Room]) -> list[Obstacle]:
    """Walls with doors in front of a row of rooms, and the walls between the rooms."""
    walls = []
    for room in row:
        assert room.door is not None  # noqa: S101 - for the type checker
        places = [0.0, room.door - DOOR_M / 2, room.door + DOOR_M / 2, room.width]
        corners = se2.transform(room.corner, [[x, room.depth] for x in places])
        walls += [_wall(corners[0], corners[1]), _wall(corners[2], corners[3])]
    for room in row[1:]:
        walls.append(_wall(*se2.transform(room.corner, [[0.0, 0.0], [0.0, room.depth]])))
    return walls


def _wall(a: Sequence[float] | Array, b: Sequence[float] | Array) -> Obstacle:
    """A wall between two points in map, parallel to an axis, with half its thickness added at each end."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    (x, y), (width, depth) = (low + high) / 2, high - low + WALL_M
    return Obstacle(box=Box(center=(float(x), float(y)), size=(float(width), float(depth))))


def _rectangle(length: float, height: float) -> list[Point]:
    return [(0.0, 0.0), (length, 0.0), (length, height), (0.0, height)]


@dataclass(frozen=True)
class TemplateItem:
    """A piece in a set of furniture, placed relative to the size of any room."""

    piece: FurniturePiece
    side: int | None  # the wall, counter-clockwise from y = 0; None for a free-standing piece
    place: Point  # from 0 to 1, along the room's width and depth; only the first, if it stands against a wall
    yaw: float  # rad, of a free-standing piece


def _template(
    rng: np.random.Generator, count: int, catalogue: Sequence[tuple[Shape, Point, Point, bool]] = CATALOGUE
) -> list[TemplateItem]:
    """A set of furniture; large pieces first, because they need more room."""
    items = [_item(rng, catalogue) for _ in range(count)]
    return sorted(items, key=lambda item: -item.piece.size[0])


def _item(rng: np.random.Generator, catalogue: Sequence[tuple[Shape, Point, Point, bool]]) -> TemplateItem:
    shape, small, large, at_wall = catalogue[int(rng.integers(len(catalogue)))]
    size = rng.uniform(small, large).tolist()
    if shape == "disc":
        size[1] = size[0]
    yaw = rng.integers(4) * np.pi / 2 if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi)
    side = int(rng.integers(4)) if at_wall else None
    return TemplateItem(FurniturePiece(shape, (size[0], size[1])), side, tuple(rng.random(2)), yaw)


def _furnish(
    floor: FloorSpace, room: Room, items: Sequence[TemplateItem], rng: np.random.Generator, deviation: float
) -> None:
    """Puts down those items for which there is room, with ``deviation`` times the usual differences between rooms."""
    for item in items:
        offset = deviation * rng.standard_normal(3) * [PLACE_DEVIATION_M, PLACE_DEVIATION_M, YAW_DEVIATION]
        floor.put(item.piece.at(se2.compose(room.corner, _pose_of(item, room, offset))))


def _pose_of(item: TemplateItem, room: Room, offset: Array) -> Array:
    """Pose (3,) of an item in the room's frame, with an offset (3,) that leaves it at its wall."""
    width, depth = item.piece.size
    inner = np.array([room.width, room.depth]) - WALL_M - 2 * WALL_GAP_M
    if item.side is None:
        radius = np.hypot(width, depth) / 2
        place = radius + (inner - 2 * radius) * item.place
        return np.array([*(place + WALL_M / 2 + WALL_GAP_M), item.yaw]) + offset
    along_wall = inner[item.side % 2]
    along = np.clip(width / 2 + (along_wall - width) * item.place[0] + offset[0], width / 2, along_wall - width / 2)
    x, y, yaw = {
        0: (along, depth / 2, 0.0),
        1: (inner[0] - depth / 2, along, np.pi / 2),
        2: (along, inner[1] - depth / 2, np.pi),
        3: (depth / 2, along, -np.pi / 2),
    }[item.side]
    return np.array([x + WALL_M / 2 + WALL_GAP_M, y + WALL_M / 2 + WALL_GAP_M, yaw])


def random_place(building: Building, piece: FurniturePiece, rng: np.random.Generator) -> FurniturePiece:
    """The piece at a random place of a random room, against a wall or not; it may overlap other pieces."""
    rooms = building.rooms
    areas = np.array([room.width * room.depth for room in rooms])
    room = rooms[rng.choice(len(rooms), p=areas / areas.sum())]
    side = int(rng.integers(4)) if rng.random() < 0.5 else None
    item = TemplateItem(piece, side, tuple(rng.random(2)), rng.uniform(-np.pi, np.pi))
    return piece.at(se2.compose(room.corner, _pose_of(item, room, np.zeros(3))))


def random_piece(building: Building, rng: np.random.Generator) -> FurniturePiece:
    """A new piece at a random place."""
    return random_place(building, _item(rng, CATALOGUE).piece, rng)
