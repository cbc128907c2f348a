"""Cost to go over free space: the goal as a preference.

A quadratic goal prior pulls straight at the goal, through walls. Its place takes ``-ln p(x) = lambda d(x)``, with d the
geodesic distance in which a metre near a wall counts for more. Its slope is lambda everywhere: the prior is as a
Gaussian whose precision, lambda / d, grows as the goal comes near, so the pull does not die away on the last metres.

Distances are Dijkstra's (scipy.sparse.csgraph, in C) over a grid with 16 neighbours, at most 2.7 % longer than the true
ones; the attractor is the farthest point of the way that can be seen along a free straight line, so the robot's own way
is not bound to the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.controller.policies.free_space import FreeSpace

GAP = 0.03  # m between footprint and wall at least: a little more than the obstacle stop asks for
SOFT = 0.35  # m beyond it in which a metre costs more
NEAR_WALL = 1.0  # how much more, at the wall
REACH = 3.0  # m of the way within which the attractor is looked for
LOOKS = 12  # points of it that are tried
SLACK = 1.02  # what the straight line may cost over the way on the grid
# Half of the 16 neighbours (rows, columns); the other half are their opposites. Beside a knight's move lie two cells
# which must be free as well.
MOVES = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (2, -1), (1, -2))
NOBODY = -9999  # scipy's predecessor of a start


class Roads:
    """All edges between free cells, and what they cost with what stands there now."""

    def __init__(self, free: FreeSpace, radius: float) -> None:
        """For a footprint of ``radius`` m."""
        self.free, self.grid, self.radius = free, free.grid, radius
        self.least = radius + GAP  # m of clearance
        self.clearance = free.clearance  # (rows, columns) m, of walls and of temporary obstacles
        self._graph = _edges(free.clearance >= self.least, self.grid.resolution)
        self._length = self._graph.data.copy()
        self._to = self._graph.indices
        self._from = np.repeat(np.arange(self.grid.cells), np.diff(self._graph.indptr))
        self._opposite = np.empty_like(self._from)  # of each edge, the number of the one that leads back
        self._opposite[np.lexsort((self._to, self._from))] = np.lexsort((self._from, self._to))
        self._near = np.zeros(self.grid.cells, bool)  # cells that temporary obstacles are near to
        self.slowness = np.zeros(self.grid.shape)
        self._weigh(~self._near)
        _, self.component = connected_components(self._graph, directed=False)  # of the map alone
        self._centres = self.grid.centres()

    def block(self, points: Array) -> None:
        """From now on with obstacles at ``points`` (K, 2) m in map, and no others."""
        far, before = self.least + SOFT, self._near
        self.clearance, self._near = self.free.clearance, np.zeros(self.grid.cells, bool)
        if len(points):
            self._near[self.grid.cell_of(points)] = True
            self._near = _grown(self._near.reshape(self.grid.shape), int(far / self.grid.resolution) + 1).ravel()
            apart, _ = cKDTree(points).query(self._centres[self._near], distance_upper_bound=far)
            clearance = self.free.clearance.ravel().copy()
            clearance[self._near] = np.minimum(clearance[self._near], apart)
            self.clearance = clearance.reshape(self.grid.shape)
        self._weigh(before | self._near)

    def _weigh(self, changed: npt.NDArray[np.bool_]) -> None:
        """The edges of cells (cells,) that changed."""
        clearance, slow = self.clearance.ravel(), self.slowness.ravel()
        slow[changed] = slowness(clearance[changed], self.least)
        from_here = np.flatnonzero(changed[self._from])
        edges = np.concatenate([from_here, self._opposite[from_here]])
        s = np.where(clearance >= self.least, slow, np.inf)
        self._graph.data[edges] = self._length[edges] * (s[self._from[edges]] + s[self._to[edges]]) / 2

    def nearest_free(
        self, point: Array, within: float = np.inf, component: int | None = None, *, by_map: bool = False
    ) -> int | None:
        """Flat number of the free cell nearest to a point (2,) m, of one component if told; None: none so near.

        ``by_map``: whatever stands there now.
        """
        clearance = (self.free.clearance if by_map else self.clearance).ravel()
        here = int(self.grid.cell_of(np.asarray(point, float)))
        if clearance[here] >= self.least and component in (None, self.component[here]) and self.grid.inside(point):
            return here  # nearest to a point in a cell is that cell's centre
        free = clearance >= self.least
        if component is not None:
            free &= self.component == component
        cells = np.flatnonzero(free)
        if not len(cells):
            return None
        apart = np.hypot(*(self._centres[cells] - point).T)
        best = int(np.argmin(apart))
        return int(cells[best]) if apart[best] <= within else None

    def from_(self, point: Array, within: float = np.inf) -> Field | None:
        """Cost between everywhere and the free cell nearest to ``point`` (2,) m; None: none within ``within`` m."""
        cell = self.nearest_free(point, within)
        if cell is None:
            return None
        cost, before = dijkstra(self._graph, indices=cell, return_predecessors=True)
        exact = np.array(point, float)
        if float(self.grid.between(self.clearance, exact)) < self.least:
            exact = self._centres[cell]
        return Field(self, exact, cost.reshape(self.grid.shape), before)

    def clear_line(self, start: Array, ends: Array) -> tuple[Array, Array]:
        """(N,) whether the straight way from (2,) to each of (N, 2) is free, and (N,) what it costs."""
        length = np.hypot(*(ends - start).T)
        steps = int(np.ceil(max(float(length.max(initial=0.0)), 0.05) / (self.grid.resolution / 2))) + 1
        along = np.linspace(0, 1, steps)[:, None, None]
        points = start + along * (ends - start)
        clear = self.grid.between(self.clearance, points)
        # The robot may stand nearer to a wall than it likes; from there any way that leads away is free.
        ok = np.all((clear >= self.least - 1e-9) | (clear >= clear[:1] - 1e-9), axis=0)
        return ok, length * self.grid.between(self.slowness, points).mean(axis=0)


@dataclass(frozen=True)
class Field:
    """The preference for one place."""

    roads: Roads
    goal: Array  # (2,) m in map, where the robot can stand
    cost: Array  # (rows, columns) m to go, more near walls; +inf out of reach
    before: Array  # (cells,) the next cell on the way to the goal

    def reaches(self, point: Array) -> bool:
        """Whether there is a way from near a point (2,) m."""
        return self._entry(point) is not None

    def path(self, point: Array) -> Array:
        """(K, 2) m in map from a point (2,) to the goal, cell by cell; (0, 2) where there is no way."""
        cell = self._entry(point)
        if cell is None:
            return np.zeros((0, 2))
        cells = [cell]
        while (cell := int(self.before[cell])) != NOBODY:
            cells.append(cell)
        way = self.roads.grid.centres(np.array(cells))
        return np.concatenate([np.atleast_2d(point), way[1:-1], self.goal[None]])

    def attractor(self, point: Array, path: Array) -> Array:
        """(2,) m the point of ``path`` that attracts a robot at ``point``."""
        reached = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        near = np.flatnonzero(reached[1:] <= REACH) + 1
        tried = near[np.unique(np.linspace(0, len(near) - 1, LOOKS).astype(int))] if len(near) else np.array([1])
        there = self._to_go(path[tried])
        ok, cost = self.roads.clear_line(point, path[tried])
        along = self._to_go(path[:1])[0] - there
        good = np.flatnonzero(ok & (cost <= along * SLACK + 2 * self.roads.grid.resolution))
        best = int(good[-1]) if len(good) else 0
        return np.asarray(path[tried[best]])

    def _to_go(self, points: Array) -> Array:
        cost = self.cost.ravel()[self.roads.grid.cell_of(points)]
        return np.where(np.isfinite(cost), cost, 0.0)

    def _entry(self, point: Array) -> int | None:
        """The cell by which to enter the way, none further than a footprint."""
        grid = self.roads.grid
        cell = int(grid.cell_of(np.asarray(point)))
        if np.isfinite(self.cost.ravel()[cell]):
            return cell
        known = np.flatnonzero(np.isfinite(self.cost.ravel()))
        apart = np.hypot(*(grid.centres(known) - point).T)
        near = apart <= self.roads.least + 2 * grid.resolution
        if not near.any():
            return None
        return int(known[near][np.argmin(apart[near] + self.cost.ravel()[known[near]] * 1e-3)])


def slowness(clearance: Array, least: float) -> Array:
    """What a metre costs at a clearance (N,) m: 1 far from walls, 1 + NEAR_WALL at the least one."""
    short = np.clip(1 - (clearance - least) / SOFT, 0, 1)
    return np.asarray(1 + NEAR_WALL * short**2)


def _grown(cells: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    """(rows, columns) bool, and all ``by`` cells or less beside them."""
    for _ in range(2):
        wide = cells.copy()
        for step in range(1, by + 1):
            wide[step:] |= cells[:-step]
            wide[:-step] |= cells[step:]
        cells = wide.T
    return cells


def _edges(free: npt.NDArray[np.bool_], resolution: float) -> csr_matrix:
    """(cells, cells) lengths in m of each move between free cells, either way."""
    rows, columns = free.shape
    number = np.arange(free.size).reshape(free.shape)

    def shifted(values: Any, down: int, right: int, like: tuple[int, int]) -> Any:
        """The part of ``values`` that lies (down, right) of those cells from which the move ``like`` is possible."""
        d, r = like
        top, left = max(0, -d), max(0, -r)
        height, width = rows - abs(d), columns - abs(r)
        return values[top + down : top + down + height, left + right : left + right + width]

    # A map of one cell has no moves at all.
    starts, ends = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    lengths = [np.zeros(0)]
    for move in MOVES:
        d, r = move
        if abs(d) >= rows or abs(r) >= columns:
            continue
        ok = shifted(free, 0, 0, move) & shifted(free, d, r, move)
        for beside in _beside(d, r):
            ok = ok & shifted(free, *beside, move)
        starts.append(shifted(number, 0, 0, move)[ok])
        ends.append(shifted(number, d, r, move)[ok])
        lengths.append(np.full(int(ok.sum()), resolution * float(np.hypot(d, r))))
    a, b, length = np.concatenate(starts), np.concatenate(ends), np.tile(np.concatenate(lengths), 2)
    both = np.concatenate([a, b]), np.concatenate([b, a])
    return csr_matrix((length, both), shape=(free.size, free.size))


def _beside(down: int, right: int) -> list[tuple[int, int]]:
    """Cells that a move passes over."""
    if abs(down) + abs(right) == 3:
        half = (int(np.sign(down)), 0) if abs(down) == 2 else (0, int(np.sign(right)))
        return [half, (int(np.sign(down)), int(np.sign(right)))]
    return [(down, 0), (0, right)] if down and right else []
