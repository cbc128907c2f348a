"""Shortest paths.

An exact computation, independent of the controller's planner: Dijkstra's algorithm on the visibility graph of free
space shrunk by the robot's radius and a gap (Lozano-Perez and Wesley 1979). The round corners of the shrunk space are
approximated by polygons with an error of at most `ARC_TOLERANCE`.
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
from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.robot import Robot
from lab.navigation.worlds import RULES, StartGoalRule, world_of

ARC_TOLERANCE = 1e-3  # m, error of the polygons that replace arcs
WALL_GAP = 0.03  # m between the footprint and the walls along the shortest path
START_GOAL_MARGIN = 0.05  # m between the footprint and the walls at start and goal
MAX_DRAWS = 500


class ShortestPaths:
    """Shortest paths in a world, for a given clearance."""

    def __init__(self, world: World, clearance: float) -> None:
        """``clearance`` is the distance in m that the robot's centre keeps from all obstacles."""
        room = shapely.simplify(shapely.buffer(world.free_space, -clearance, quad_segs=64), ARC_TOLERANCE)
        # The margin lets lines along an edge or through a corner count as inside.
        self.room = shapely.buffer(room, 1e-6, join_style="mitre")
        shapely.prepare(self.room)
        self.corners, self._edges = _protruding_corners(room)
        near = [
            self._visible_distances(here, self.corners, self._bend_corners(here) & self._next_bend_corners(here))
            for here in self.corners
        ]
        self._corner_distances = np.array(near).reshape(len(self.corners), len(self.corners))

    def path(self, start: Array, goal: Array) -> Array:
        """Corners (K, 2), m, of the shortest path from ``start`` (2,) to ``goal`` (2,); (0, 2) if there is no path."""
        places = np.concatenate([np.array([start, goal], float), self.corners])
        lengths = np.zeros((len(places), len(places)))
        lengths[2:, 2:] = self._corner_distances
        for number, place in enumerate(places[:2]):
            lengths[number] = self._visible_distances(
                place, places, np.concatenate([[True, True], self._bend_corners(place)])
            )
        _, before = dijkstra(csr_matrix(lengths), directed=False, indices=1, return_predecessors=True)
        indices = [0]
        while indices[-1] != 1:
            if before[indices[-1]] < 0:
                return np.zeros((0, 2))
            indices.append(int(before[indices[-1]]))
        return places[indices]

    def _visible_distances(self, place: Array, others: Array, mask: npt.NDArray[np.bool_]) -> Array:
        """Distances (N,), m, from ``place`` to those of the ``others`` (N, 2) that ``mask`` selects.

        0, which means no edge in the visibility graph, where the line between them is not free.
        """
        apart = np.zeros(len(others))
        ends = others[mask]
        lines = shapely.linestrings(np.stack([np.broadcast_to(place, ends.shape), ends], axis=1))
        apart[mask] = np.where(shapely.covers(self.room, lines), np.hypot(*(ends - place).T), 0.0)
        return apart

    def _bend_corners(self, place: Array) -> npt.NDArray[np.bool_]:
        """Mask (N,) of corners around which a shortest path from ``place`` (2,) may bend.

        Both edges of such a corner lie on the same side of the line from ``place``.
        """
        return _same_side(self.corners - place, self._edges)

    def _next_bend_corners(self, corner: Array) -> npt.NDArray[np.bool_]:
        """Mask (N,) of corners that may follow ``corner`` (2,), one of `corners`, on a shortest path."""
        number = int(np.flatnonzero((self.corners == corner).all(axis=1))[0])
        return _same_side(self.corners - corner, self._edges[number : number + 1])


def _same_side(strings: Array, edges: Array) -> npt.NDArray[np.bool_]:
    """Whether both edges of a corner lie on the same side of a line, (N,).

    ``strings`` (N, 2) are the lines' directions; ``edges`` (N or 1, 2, 2) point from a corner to its two neighbours.
    """
    side = strings[:, None, 0] * edges[..., 1] - strings[:, None, 1] * edges[..., 0]
    return np.asarray(side.min(axis=1) * side.max(axis=1) >= -1e-12)


def _protruding_corners(room: shapely.Geometry) -> tuple[Array, Array]:
    """Corners (N, 2), m, that protrude into free space, and their edges (N, 2, 2).

    A shortest path bends only around such corners.
    """
    corners, edges = [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    for polygon in shapely.get_parts(shapely.orient_polygons(room)):
        for ring in shapely.get_rings(polygon):
            here = shapely.get_coordinates(ring)[:-1]
            to_previous, to_next = np.roll(here, 1, axis=0) - here, np.roll(here, -1, axis=0) - here
            # Free space lies to the left of each edge.
            bulges = to_previous[:, 0] * to_next[:, 1] - to_previous[:, 1] * to_next[:, 0] > 0
            corners.append(here[bulges])
            edges.append(np.stack([to_previous, to_next], axis=1)[bulges])
    return np.concatenate(corners), np.concatenate(edges)


def length(path: Array) -> float:
    """Length in m of a path (K, 2+)."""
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


@functools.lru_cache(maxsize=8)
def load_shortest_paths(name: str, radius: float = Robot().radius, seed: int = 0) -> tuple[World, ShortestPaths]:
    """Loads a world, or generates that of a seed, and prepares its shortest paths with `WALL_GAP`; cached."""
    world = world_of(name, seed)
    return world, ShortestPaths(world, radius + WALL_GAP)


@dataclass(frozen=True)
class NavigationTask:
    """Start pose, goal and shortest path of a navigation trial; the robot begins at rest."""

    start: tuple[float, float, float]  # m, m, rad
    goal: tuple[float, float]  # m
    shortest: tuple[tuple[float, float], ...]  # m, corners of the shortest path with clearance
    redrawn: int = 0  # rejected pairs, too close together or without a path


def draw_task(name: str, rng: np.random.Generator, robot: Robot, seed: int = 0) -> NavigationTask:
    """Draws start and goal uniformly from free space with `START_GOAL_MARGIN`, and a uniform start heading.

    They follow the world's rule in `RULES`. Coordinates are rounded to millimetres and the heading to 1e-4 rad. Raises
    UserError if no such pair is found.
    """
    world, paths = load_shortest_paths(name, robot.radius, seed)
    rule = RULES.get(name, StartGoalRule())
    for redrawn in range(MAX_DRAWS):
        start, goal = np.round(world.sample_free(2, rng, robot.radius + START_GOAL_MARGIN), 3)
        if not rule.allows(world, [start, goal]):
            continue
        path = paths.path(start, goal)
        if len(path) and length(path) >= rule.min_length:
            heading = round(float(rng.uniform(-np.pi, np.pi)), 4)
            corners = tuple((float(x), float(y)) for x, y in np.round(path, 4))
            return NavigationTask(
                (float(start[0]), float(start[1]), heading), (float(goal[0]), float(goal[1])), corners, redrawn
            )
    raise UserError(
        f"world {world.name!r}: no two places {rule.min_length:g} m apart between which the robot could drive"
    )
