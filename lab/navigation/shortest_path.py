"""Shortest path and least time.

Exact, and none of the controller's: a visibility graph over free space shrunk by the robot's radius and a gap, with
Dijkstra's algorithm on it (Lozano-Perez and Wesley 1979). The shrunk space has round corners; they become polygons that
are at most `ARC_TOLERANCE` off.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from common.errors import UserError
from common.geometry.se2 import Array, wrap
from common.geometry.world import World, load_world
from common.robot.base import Robot
from lab.experiments.journeys import least_time

ARC_TOLERANCE = 1e-3  # m, polygon instead of arc
WALL_GAP = 0.03  # m between footprint and walls that the shortest way keeps
START_GOAL_MARGIN = 0.05  # m, and what start and goal have around the footprint
MIN_TRIP_LENGTH = 2.0  # m by the shortest way
MAX_DRAWS = 500
# Where starts and goals are drawn, of worlds that are about one part of them: x0, y0, x1, y1 in m. In the corridor of
# `twins` a scan tells where it is, so whoever has a goal there finds out on the way.
ROOMS = {"twins": ((0.0, 0.0, 5.9, 4.4), (6.1, 0.0, 12.0, 4.4))}


class Ways:
    """All shortest ways in one world at one clearance."""

    def __init__(self, world: World, clearance: float) -> None:
        """``clearance`` m between the robot's centre and everything."""
        room = shapely.simplify(shapely.buffer(world.free_space, -clearance, quad_segs=64), ARC_TOLERANCE)
        # A line along an edge, or through a corner, is inside.
        self.room = shapely.buffer(room, 1e-6, join_style="mitre")
        shapely.prepare(self.room)
        self.corners, self._beside = _reflex(room)
        near = [self._seen(here, self.corners, self._taut(here) & self._taut_from(here)) for here in self.corners]
        self._between = np.array(near).reshape(len(self.corners), len(self.corners))

    def way(self, start: Array, goal: Array) -> Array:
        """(K, 2) m from ``start`` (2,) to ``goal`` (2,), straight between; (0, 2) where there is none."""
        places = np.concatenate([np.array([start, goal], float), self.corners])
        lengths = np.zeros((len(places), len(places)))
        lengths[2:, 2:] = self._between
        for number, place in enumerate(places[:2]):
            lengths[number] = self._seen(place, places, np.concatenate([[True, True], self._taut(place)]))
        _, before = dijkstra(csr_matrix(lengths), directed=False, indices=1, return_predecessors=True)
        numbers = [0]
        while numbers[-1] != 1:
            if before[numbers[-1]] < 0:
                return np.zeros((0, 2))
            numbers.append(int(before[numbers[-1]]))
        return places[numbers]

    def _seen(self, place: Array, others: Array, which: npt.NDArray[np.bool_]) -> Array:
        """(N,) m to each of (N, 2) that matters; 0, no edge, where something stands between."""
        apart = np.zeros(len(others))
        ends = others[which]
        lines = shapely.linestrings(np.stack([np.broadcast_to(place, ends.shape), ends], axis=1))
        apart[which] = np.where(shapely.covers(self.room, lines), np.hypot(*(ends - place).T), 0.0)
        return apart

    def _taut(self, place: Array) -> npt.NDArray[np.bool_]:
        """(N,) corners past which a string from ``place`` (2,) may run on: both their edges lie on one side of it."""
        return _one_side(self.corners - place, self._beside)

    def _taut_from(self, corner: Array) -> npt.NDArray[np.bool_]:
        """(N,) corners to which a string may run that came round ``corner`` (2,), itself one of them."""
        number = int(np.flatnonzero((self.corners == corner).all(axis=1))[0])
        return _one_side(self.corners - corner, self._beside[number : number + 1])


def _one_side(strings: Array, edges: Array) -> npt.NDArray[np.bool_]:
    """(N,) for strings (N, 2) m, and edges (N or 1, 2, 2) m from a corner to those before and after it."""
    side = strings[:, None, 0] * edges[..., 1] - strings[:, None, 1] * edges[..., 0]
    return np.asarray(side.min(axis=1) * side.max(axis=1) >= -1e-12)


def _reflex(room: shapely.Geometry) -> tuple[Array, Array]:
    """(N, 2) m corners that bulge into free space, for only round those a shortest way bends; (N, 2, 2) their edges."""
    corners, edges = [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    for polygon in shapely.get_parts(shapely.orient_polygons(room)):
        for ring in shapely.get_rings(polygon):
            here = shapely.get_coordinates(ring)[:-1]
            back, on = np.roll(here, 1, axis=0) - here, np.roll(here, -1, axis=0) - here
            bulges = back[:, 0] * on[:, 1] - back[:, 1] * on[:, 0] > 0  # free space lies to the left
            corners.append(here[bulges])
            edges.append(np.stack([back, on], axis=1)[bulges])
    return np.concatenate(corners), np.concatenate(edges)


def length(way: Array) -> float:
    """M along (K, 2+)."""
    return float(np.hypot(*np.diff(way[:, :2], axis=0).T).sum())


@functools.lru_cache(maxsize=8)
def load_ways(world: str, radius: float = Robot().radius) -> tuple[World, Ways]:
    """A world by name and the shortest ways in it, with `WALL_GAP`; made once a process."""
    known = load_world(world)
    return known, Ways(known, radius + WALL_GAP)


@dataclass(frozen=True)
class Trip:
    """From standing at ``start`` to ``goal``."""

    start: tuple[float, float, float]  # m, m, rad
    goal: tuple[float, float]  # m
    shortest: tuple[tuple[float, float], ...]  # m, the shortest way with clearance
    redrawn: int = 0  # pairs drawn before that were nearer, or had no way between


def draw_trip(world: str, rng: np.random.Generator, robot: Robot, apart: float = MIN_TRIP_LENGTH) -> Trip:
    """Places uniform over free space with `START_GOAL_MARGIN`, ``apart`` m or more by the shortest way; any heading.

    Whole millimetres and ten-thousandths of a radian. Raises UserError where there seems to be no such pair.
    """
    known, ways = load_ways(world, robot.radius)
    rooms = ROOMS.get(world)
    for redrawn in range(MAX_DRAWS):
        start, goal = np.round(known.sample_free(2, rng, robot.radius + START_GOAL_MARGIN), 3)
        if rooms and not all(any(_inside(place, room) for room in rooms) for place in (start, goal)):
            continue
        way = ways.way(start, goal)
        if len(way) and length(way) >= apart:
            heading = round(float(rng.uniform(-np.pi, np.pi)), 4)
            there = float(goal[0]), float(goal[1])
            corners = tuple((float(x), float(y)) for x, y in np.round(way, 4))
            return Trip((float(start[0]), float(start[1]), heading), there, corners, redrawn)
    raise UserError(f"world {known.name!r}: no two places {apart:g} m apart between which the robot could drive")


def _inside(place: Array, room: tuple[float, float, float, float]) -> bool:
    x0, y0, x1, y1 = room
    return bool(x0 <= place[0] <= x1 and y0 <= place[1] <= y1)


def least_turn(angle: float, robot: Robot) -> float:
    """S to turn on the spot by ``angle`` rad, from standing to standing: accelerate, turn, brake."""
    w, a = robot.max_turn, robot.turn_acceleration
    away = abs(angle)
    return float(2 * np.sqrt(away / a)) if away < w**2 / a else away / w + w / a


def least_trip(way: npt.ArrayLike, heading: float, robot: Robot, tolerance: float) -> float:
    """S from standstill until ``tolerance`` m before the end of a way (K, 2), which nobody asks it to stop at.

    Accelerate, cruise at full speed round every corner; a differential base turns on the spot into the way first.
    """
    along = np.asarray(way, float)
    seconds = least_time(length(along), robot, tolerance)
    if robot.drive == "differential":
        x, y = along[1] - along[0]
        seconds += least_turn(float(wrap(np.arctan2(y, x) - heading)), robot)
    return seconds
