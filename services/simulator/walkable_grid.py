"""Grid of places where a person can walk, for their paths.

Paths are shortest over the grid's graph (Dijkstra's algorithm, from scipy), then shortened: a point is left out if the
straight line past it is clear as well.
"""

from __future__ import annotations

import numpy as np
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from common.geometry.se2 import Array
from common.geometry.world import World

CELL_M = 0.2  # between two points of the grid; more in worlds that would have too many points
MAX_POINTS = 100_000
WALL_MARGIN_M = 0.05  # to walls, beside the body
MIN_WALK_M = 2.0  # a destination is at least this far away, if there is one
MIN_COMPONENT_NODES = 25  # 1 m²; a person does not start in a smaller part of the grid
MAX_SHORTCUT_NODES = 40  # nodes that one step of the shortening may leave out
MAX_START_CANDIDATES = 24  # nearest nodes that are tried as the first one of a path
NO_DISCS = np.zeros((0, 3))


class WalkableGrid:
    """Graph of the places in one world where a person of one radius fits."""

    def __init__(self, world: World, radius: float) -> None:
        """``nodes`` is empty if there is no room for a person of ``radius`` m anywhere."""
        self.room = shapely.buffer(world.free_space, -(radius + WALL_MARGIN_M))
        self._room_with_tolerance = shapely.buffer(self.room, 1e-6)  # paths along the edge of `room` must be inside
        shapely.prepare(self.room)
        shapely.prepare(self._room_with_tolerance)
        x0, y0, x1, y1 = world.bounds
        cell = max(CELL_M, float(np.sqrt((x1 - x0) * (y1 - y0) / MAX_POINTS)))
        x, y = np.meshgrid(np.arange(x0 + cell / 2, x1, cell), np.arange(y0 + cell / 2, y1, cell), indexing="ij")
        points = np.column_stack([x.ravel(), y.ravel()])
        inside = shapely.covers(self.room, shapely.points(points))
        self.nodes: Array = points[inside]  # (N, 2) m
        index = np.where(inside, np.cumsum(inside) - 1, -1).reshape(x.shape)
        self.graph = self._connect(index)
        component = connected_components(self.graph, directed=False)[1]
        self.start_nodes = np.flatnonzero(np.bincount(component)[component] >= MIN_COMPONENT_NODES)

    def _connect(self, index: Array) -> csr_matrix:
        """Graph of each node with those of its eight neighbours to which a straight line is clear.

        ``index`` (columns, rows) contains each node's index at its place in the grid, and -1 elsewhere.
        """
        wide, high = index.shape
        pairs = [
            np.column_stack([index[:-1].ravel(), index[1:].ravel()]),
            np.column_stack([index[:, :-1].ravel(), index[:, 1:].ravel()]),
            np.column_stack([index[: wide - 1, : high - 1].ravel(), index[1:, 1:].ravel()]),
            np.column_stack([index[: wide - 1, 1:].ravel(), index[1:, : high - 1].ravel()]),
        ]
        pair = np.concatenate(pairs)
        pair = pair[(pair >= 0).all(axis=1)]
        a, b = pair[shapely.covers(self.room, shapely.linestrings(self.nodes[pair]))].T
        length = np.hypot(*(self.nodes[a] - self.nodes[b]).T)
        both = np.concatenate([a, b]), np.concatenate([b, a])
        return csr_matrix((np.tile(length, 2), both), shape=(len(self.nodes), len(self.nodes)))

    def can_start(self, place: Array) -> bool:
        """Whether a path can begin at ``place`` (2,) m."""
        return self._first_node(place, self.nodes, NO_DISCS) is not None

    def random_path(self, place: Array, rng: np.random.Generator, blocked: Array = NO_DISCS) -> Array | None:
        """Path (W, 2) m, W >= 2, from ``place`` (2,) m to a random node that can be reached; None if there is no path.

        The path stays out of the discs ``blocked`` (M, 3: x, y, radius, in m). If it begins inside a disc, it comes no
        closer to its centre.
        """
        nodes, graph = self.nodes, self.graph
        if len(blocked):
            distance = np.hypot(nodes[:, None, 0] - blocked[:, 0], nodes[:, None, 1] - blocked[:, 1])
            free = np.flatnonzero((distance >= blocked[:, 2] + WALL_MARGIN_M).all(axis=1))
            nodes, graph = nodes[free], graph[free][:, free]
        first = self._first_node(place, nodes, blocked)
        if first is None:
            return None
        length, predecessor = dijkstra(graph, indices=first, return_predecessors=True)
        reachable = np.flatnonzero(np.isfinite(length))
        far = reachable[length[reachable] >= MIN_WALK_M]
        reversed_path = [int(rng.choice(far if len(far) else reachable))]
        while reversed_path[-1] != first:
            reversed_path.append(int(predecessor[reversed_path[-1]]))
        return self._shorten(place, nodes[reversed_path[::-1]], blocked)

    def _first_node(self, place: Array, nodes: Array, blocked: Array) -> int | None:
        """Index of the nearest node to which a straight line from ``place`` is clear; None if there is none."""
        distance = np.hypot(*(nodes - place).T)
        near = np.argsort(distance, kind="stable")[:MAX_START_CANDIDATES]
        visible = near[self._clear_lines(place, nodes[near], blocked)]
        return int(visible[0]) if len(visible) else None

    def _shorten(self, place: Array, path: Array, blocked: Array) -> Array:
        """``place``, followed by those points of ``path`` (P, 2) m that are needed."""
        shortened, index = [place], 0
        while index < len(path):
            next_nodes = path[index : index + MAX_SHORTCUT_NODES]
            visible = np.flatnonzero(self._clear_lines(shortened[-1], next_nodes, blocked))
            index += int(visible[-1]) if len(visible) else 0  # the next node is always visible, but for rounding errors
            shortened.append(path[index])
            index += 1
        return np.array(shortened)

    def _clear_lines(self, start: Array, ends: Array, blocked: Array) -> Array:
        """Whether lines from ``start`` (2,) to ``ends`` (E, 2) stay in the room and out of the discs; (E,) bool."""
        lines = np.stack([np.broadcast_to(start, ends.shape), ends], axis=1)
        length = np.hypot(*(ends - start).T)
        # shapely does not accept lines of length zero.
        start_inside = bool(shapely.covers(self._room_with_tolerance, shapely.Point(start)))
        inside = shapely.covers(self._room_with_tolerance, shapely.linestrings(lines))
        clear = np.where(length > 1e-9, inside, start_inside)
        if len(blocked):
            centres = blocked[:, :2]
            nearest = np.stack([distance_to_segment(centres, start, end) for end in ends])  # (E, M)
            min_distance = np.minimum(blocked[:, 2], np.hypot(*(centres - start).T))
            clear &= (nearest >= min_distance - 1e-9).all(axis=1)
        return clear


def distance_to_segment(points: Array, a: Array, b: Array) -> Array:
    """Distance (N,) m from points (N, 2) to the line segment from ``a`` (2,) to ``b`` (2,)."""
    along = b - a
    square = float(along @ along)
    fraction = np.clip((points - a) @ along / square, 0.0, 1.0) if square > 0 else np.zeros(len(points))
    offset = points - a - fraction[:, None] * along
    return np.hypot(offset[:, 0], offset[:, 1])
