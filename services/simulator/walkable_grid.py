"""Grid of places where a person can walk, for their paths.

Ways are shortest over that graph (Dijkstra, from scipy), then pulled tight: a point is left out where the straight
line past it is clear as well.
"""

from __future__ import annotations

import numpy as np
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from common.geometry.se2 import Array
from common.geometry.world import World

CELL = 0.2  # m between two points of the grid; wider where the world would have more than MOST
MOST = 100_000  # points
SPARE = 0.05  # m to walls, beside the body
FAR = 2.0  # m, the least walk worth setting out for, where there is one
ROOMY = 25  # points, 1 m²: a smaller pocket is no place to begin in
AHEAD = 40  # points of a way that one look takes in
NEIGHBOURS = 24  # points looked at for the first step onto the grid
NOBODY = np.zeros((0, 3))


class Floor:
    """The graph of one world for one radius."""

    def __init__(self, world: World, radius: float) -> None:
        """No error where nothing is free: there are no ``nodes`` then."""
        self.room = shapely.buffer(world.free_space, -(radius + SPARE))
        self._near = shapely.buffer(self.room, 1e-6)  # who walks along its edge is in, whatever the last digit says
        shapely.prepare(self.room)
        shapely.prepare(self._near)
        x0, y0, x1, y1 = world.bounds
        cell = max(CELL, float(np.sqrt((x1 - x0) * (y1 - y0) / MOST)))
        x, y = np.meshgrid(np.arange(x0 + cell / 2, x1, cell), np.arange(y0 + cell / 2, y1, cell), indexing="ij")
        points = np.column_stack([x.ravel(), y.ravel()])
        inside = shapely.covers(self.room, shapely.points(points))
        self.nodes: Array = points[inside]  # (N, 2) m
        number = np.where(inside, np.cumsum(inside) - 1, -1).reshape(x.shape)
        self.graph = self._joined(number)
        label = connected_components(self.graph, directed=False)[1]
        self.roomy = np.flatnonzero(np.bincount(label)[label] >= ROOMY)  # nodes to begin at

    def _joined(self, number: Array) -> csr_matrix:
        """Each node (its number at its place in the grid, or -1) with those of its eight neighbours it sees."""
        wide, high = number.shape
        pairs = [
            np.column_stack([number[:-1].ravel(), number[1:].ravel()]),
            np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
            np.column_stack([number[: wide - 1, : high - 1].ravel(), number[1:, 1:].ravel()]),
            np.column_stack([number[: wide - 1, 1:].ravel(), number[1:, : high - 1].ravel()]),
        ]
        pair = np.concatenate(pairs)
        pair = pair[(pair >= 0).all(axis=1)]
        a, b = pair[shapely.covers(self.room, shapely.linestrings(self.nodes[pair]))].T
        length = np.hypot(*(self.nodes[a] - self.nodes[b]).T)
        both = np.concatenate([a, b]), np.concatenate([b, a])
        return csr_matrix((np.tile(length, 2), both), shape=(len(self.nodes), len(self.nodes)))

    def holds(self, place: Array) -> bool:
        """Whether a way can begin at ``place`` (2,) m."""
        return self._first(place, self.nodes, NOBODY) is not None

    def way(self, place: Array, rng: np.random.Generator, blocked: Array = NOBODY) -> Array | None:
        """(W, 2) m, W >= 2, from ``place`` (2,) m to a random node in reach; None where there is no way.

        It comes no nearer to the centres of ``blocked`` (M, 3: x, y, radius m) than their radii, or than it begins.
        """
        nodes, graph = self.nodes, self.graph
        if len(blocked):
            apart = np.hypot(nodes[:, None, 0] - blocked[:, 0], nodes[:, None, 1] - blocked[:, 1])
            free = np.flatnonzero((apart >= blocked[:, 2] + SPARE).all(axis=1))
            nodes, graph = nodes[free], graph[free][:, free]
        first = self._first(place, nodes, blocked)
        if first is None:
            return None
        reach, before = dijkstra(graph, indices=first, return_predecessors=True)
        some = np.flatnonzero(np.isfinite(reach))
        far = some[reach[some] >= FAR]
        back = [int(rng.choice(far if len(far) else some))]
        while back[-1] != first:
            back.append(int(before[back[-1]]))
        return self._tight(place, nodes[back[::-1]], blocked)

    def _first(self, place: Array, nodes: Array, blocked: Array) -> int | None:
        """The nearest node that is seen from ``place``."""
        distance = np.hypot(*(nodes - place).T)
        near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
        seen = near[self._clear(place, nodes[near], blocked)]
        return int(seen[0]) if len(seen) else None

    def _tight(self, place: Array, path: Array, blocked: Array) -> Array:
        """``place`` and those points of ``path`` (P, 2) m that are needed."""
        way, at = [place], 0
        while at < len(path):
            seen = np.flatnonzero(self._clear(way[-1], path[at : at + AHEAD], blocked))
            at += int(seen[-1]) if len(seen) else 0  # the next one is seen but for the last digit
            way.append(path[at])
            at += 1
        return np.array(way)

    def _clear(self, start: Array, ends: Array, blocked: Array) -> Array:
        """(E,) whether the straight lines from ``start`` (2,) to ``ends`` (E, 2) keep to the room and off others."""
        lines = np.stack([np.broadcast_to(start, ends.shape), ends], axis=1)
        length = np.hypot(*(ends - start).T)
        # A line without length is no line to shapely.
        here = bool(shapely.covers(self._near, shapely.Point(start)))
        clear = np.where(length > 1e-9, shapely.covers(self._near, shapely.linestrings(lines)), here)
        if len(blocked):
            centres = blocked[:, :2]
            nearest = np.stack([to_segment(centres, start, end) for end in ends])  # (E, M)
            least = np.minimum(blocked[:, 2], np.hypot(*(centres - start).T))
            clear &= (nearest >= least - 1e-9).all(axis=1)
        return clear


def to_segment(points: Array, a: Array, b: Array) -> Array:
    """(N,) m from points (N, 2) to the straight piece from ``a`` (2,) to ``b`` (2,)."""
    along = b - a
    square = float(along @ along)
    share = np.clip((points - a) @ along / square, 0.0, 1.0) if square > 0 else np.zeros(len(points))
    off = points - a - share[:, None] * along
    return np.hypot(off[:, 0], off[:, 1])
