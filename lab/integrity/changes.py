"""Differences between the world and its map: furniture, doors, people, surfaces without return, and kidnapping."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt
import shapely

from common.geometry import se2
from common.geometry.ray_casting import cast_rays
from common.geometry.se2 import Array
from common.geometry.shapes import Box, Circle, Obstacle
from common.geometry.world import World
from lab.accuracy.furniture import FloorSpace, FurniturePiece
from lab.accuracy.scenes import ROBOT, Scene
from lab.integrity.buildings import Building, Room, random_piece, random_place
from services.simulator.people import People

Kidnapping = Literal["anywhere", "similar", "nearby"]

MAX_PLACES = 50  # that are tried for a piece before it is left out
WALKING_SPEED = 0.8  # m/s
PANEL_M = 2.0  # width of a window in an outer wall
SKIN_M = 0.02  # by which a surface without return covers the wall behind it
DIRECTIONS = 120  # of the panoramas that are compared for similar places
CANDIDATES = 400  # places that are compared
PANORAMA_RANGE_M = 10.0  # longer ranges count as equal
MIN_KIDNAPPING_M, MAX_NEARBY_M, MAX_NEARBY_TURN = 0.5, 2.0, np.deg2rad(45)
MIN_SIMILAR_M = 2.0  # from a place to a similar one


def move_furniture(building: Building, share: float, rng: np.random.Generator) -> Building:
    """Each piece is moved to another free place with probability ``share``."""
    return move_pieces(building, rng.random(len(building.furniture)) < share, building.rooms, rng)


def move_pieces(
    building: Building, moves: npt.NDArray[np.bool_], rooms: Sequence[Room], rng: np.random.Generator
) -> Building:
    """The pieces in the mask ``moves`` (F,) are moved to free places in ``rooms``; those without one are left out."""
    within, floor = replace(building, rooms=tuple(rooms)), building.floor()
    for piece, moved in zip(building.furniture, moves, strict=True):
        if not moved:
            floor.put(piece)
    for piece, moved in zip(building.furniture, moves, strict=True):
        if moved:
            _put_anywhere(floor, (random_place(within, piece, rng) for _ in range(MAX_PLACES)))
    return building.furnished(floor.pieces)


def add_furniture(building: Building, share: float, rng: np.random.Generator) -> Building:
    """New pieces at free places, ``share`` times as many as there are."""
    floor = building.floor()
    for piece in building.furniture:
        floor.put(piece)
    for _ in range(round(share * len(building.furniture))):
        _put_anywhere(floor, (random_piece(building, rng) for _ in range(MAX_PLACES)))
    return building.furnished(floor.pieces)


def remove_furniture(building: Building, share: float, rng: np.random.Generator) -> Building:
    """Each piece is removed with probability ``share``."""
    return building.furnished([piece for piece in building.furniture if rng.random() >= share])


def _put_anywhere(floor: FloorSpace, pieces: Iterable[FurniturePiece]) -> None:
    """Puts down the first piece for which there is room."""
    any(floor.put(piece) for piece in pieces)


def closed_doors(building: Building, share: float, rng: np.random.Generator) -> list[Obstacle]:
    """Panels in the doors, each of which is closed with probability ``share``."""
    panels = [room.door_panel() for room in building.rooms]
    return [panel for panel in panels if panel is not None and rng.random() < share]


def crowd(world: World, path: Array, rate: float, count: int, rng: np.random.Generator) -> Array:
    """Discs (N, count, 3) of people, x, y and radius in m, who walk around during a drive (N, 3) at ``rate`` Hz."""
    people = People(world, count, WALKING_SPEED, rng, path[0, :2], ROBOT.radius)
    places = [people.places.copy()]
    for before, after in zip(path[:-1, :2], path[1:, :2], strict=True):
        people.step(1 / rate, before, (after - before) * rate)
        places.append(people.places.copy())
    return np.insert(np.array(places), 2, people.radius, axis=2)


def glass(building: Building, share: float, rng: np.random.Generator) -> list[Obstacle]:
    """Surfaces in front of the walls, each with probability ``share``: windows in outer walls, and inner walls."""
    panes = [wall.box for wall in building.walls if wall.box is not None and rng.random() < share]
    ring = shapely.segmentize(shapely.LinearRing(building.boundary), PANEL_M)
    ends = shapely.get_coordinates(ring)
    for a, b in pairwise(ends):
        if rng.random() < share:
            (x, y), (width, depth) = (a + b) / 2, np.abs(b - a)
            panes.append(Box(center=(float(x), float(y)), size=(float(width) + 0.001, float(depth) + 0.001)))
    return [Obstacle(box=_grown(box)) for box in panes]


def black_furniture(building: Building, share: float, rng: np.random.Generator) -> list[Obstacle]:
    """Surfaces around the pieces, each with probability ``share``."""
    parts = [part for piece in building.furniture if rng.random() < share for part in piece.obstacles]
    boxes = [Obstacle(box=_grown(part.box)) for part in parts if part.box is not None]
    discs = [part.circle for part in parts if part.circle is not None]
    return [*boxes, *(Obstacle(circle=Circle(center=d.center, radius=d.radius + SKIN_M)) for d in discs)]


def _grown(box: Box) -> Box:
    width, depth = box.size
    return Box(center=box.center, size=(width + 2 * SKIN_M, depth + 2 * SKIN_M), yaw_deg=box.yaw_deg)


def hits(surfaces: Sequence[Obstacle], ranges: Array, lasers: Array, angles: Array) -> npt.NDArray[np.bool_]:
    """(N, B) whether beams of these ``ranges`` (N, B) m, from poses (N, 3) in map, meet one of the surfaces."""
    far = 200.0  # m, beyond every generated building and the range of a beam
    around = World(name="surfaces", boundary=[(-far, -far), (far, -far), (far, far), (-far, far)])
    return np.asarray(cast_rays(around.with_obstacles(list(surfaces)), lasers, angles) <= ranges)


class KidnappingPlaces:
    """Places to which a robot is carried."""

    def __init__(self, scene: Scene, kind: Kidnapping) -> None:
        self._scene, self._kind = scene, kind
        if kind == "similar":
            places = scene.world.sample_free(CANDIDATES, scene.rng, ROBOT.radius)
            self._lasers = np.column_stack([places, np.zeros(CANDIDATES)])
            self._panoramas = self._panorama(self._lasers)

    def after(self, pose: Array) -> Array:
        """The pose (3,) to which the robot is carried from ``pose`` (3,)."""
        choose = {"anywhere": self._anywhere, "similar": self._similar, "nearby": self._nearby}
        return choose[self._kind](pose)

    def _anywhere(self, pose: Array) -> Array:
        candidates = self._scene.poses(50)
        far = np.hypot(*(candidates - pose)[:, :2].T) > MIN_SIMILAR_M
        return np.asarray(candidates[np.argmax(far)])

    def _nearby(self, pose: Array) -> Array:
        rng = self._scene.rng
        while True:
            direction, distance = rng.uniform(-np.pi, np.pi), rng.uniform(MIN_KIDNAPPING_M, MAX_NEARBY_M)
            yaw = se2.wrap(pose[2] + rng.uniform(-MAX_NEARBY_TURN, MAX_NEARBY_TURN))
            moved = np.array([*(pose[:2] + distance * np.array([np.cos(direction), np.sin(direction)])), yaw])
            if self._scene.world.has_room(moved, ROBOT.radius):
                return moved

    def _similar(self, pose: Array) -> Array:
        """The candidate, more than `MIN_SIMILAR_M` away, at which the ranges differ least from those at ``pose``."""
        scanner = self._scene.scanner
        laser = se2.compose(pose, np.array(scanner.mount))
        view = np.abs(np.arange(DIRECTIONS) - DIRECTIONS // 2) * 2 * np.pi / DIRECTIONS < scanner.fov / 2
        here = np.roll(self._panorama(laser[None])[0], DIRECTIONS // 2)[view]
        costs = np.stack(
            [
                np.abs(np.roll(self._panoramas, DIRECTIONS // 2 - turn, axis=1)[:, view] - here).mean(axis=1)
                for turn in range(DIRECTIONS)
            ],
            axis=1,
        )
        costs[np.hypot(*(self._lasers - laser)[:, :2].T) < MIN_SIMILAR_M] = np.inf
        for index in np.argsort(costs, axis=None):
            place, turn = np.unravel_index(index, costs.shape)
            yaw = float(se2.wrap(turn * 2 * np.pi / DIRECTIONS))
            candidate = se2.compose([*self._lasers[place, :2], yaw], se2.inverse(scanner.mount))
            if self._scene.world.has_room(candidate, ROBOT.radius):
                return candidate
        return self._anywhere(pose)

    def _panorama(self, lasers: Array) -> Array:
        """Ranges (N, DIRECTIONS), m, all around laser poses (N, 3), beginning straight ahead."""
        angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
        return np.minimum(self._scene.world.ray_distances(lasers, angles), PANORAMA_RANGE_M)
