"""The goal as a preference: the cost of the path to it through free space.

A quadratic prior on the goal pulls straight at it, through walls. It is replaced by ``-ln p(x) = lambda d(x)``, where d
is the geodesic distance to the goal and a metre near a wall counts for more. The slope of this prior is lambda
everywhere, as if it were a Gaussian whose precision, lambda / d, grows as the robot approaches, so the attraction does
not vanish on the last metres.

Distances come from Dijkstra's algorithm (scipy.sparse.csgraph) on a grid with 16 neighbours. They are at most 2.7 %
longer than the true ones. The robot does not follow the grid: it drives towards the lookahead point, which is the
farthest point of the path to which a straight line is free.
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

WALL_GAP_M = 0.03  # minimum distance between footprint and wall; the obstacle stop needs 0.02 m, and noise 0.01 m
WALL_COST_RANGE_M = 0.35  # range of clearances beyond the minimum within which a metre costs more
MAX_WALL_COST = 1.0  # additional cost of a metre at the minimum clearance
UNKNOWN_COST = 30.0  # additional cost of a metre where nothing is known: a path through it is the last resort
LOOKAHEAD_RANGE_M = 3.0  # length of the path within which the lookahead point is chosen, for slow robots
MAX_LOOKAHEAD_CANDIDATES = 12  # points of the path that are tried, evenly spaced
MAX_LINE_COST_RATIO = 1.02  # cost of the straight line to the lookahead point, relative to the path on the grid
WAITING_RANGE_M = 4.0  # cost of the path to an occupied goal within which a robot chooses the place where it waits
# Cost of a metre between that place and the goal. More than a metre along any path, so that the robot drives as near as
# it can without a detour.
REMAINING_COST = 2 * (1 + MAX_WALL_COST)
# Half of the 16 neighbours as (rows, columns); the other half are their opposites. A knight's move passes over two more
# cells, which must be free as well.
MOVES = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (2, -1), (1, -2))
NO_PREDECESSOR = -9999  # scipy's predecessor of the start node


class FreeSpaceGraph:
    """Graph of the free cells. Edge weights are costs, given the walls and the temporary obstacles."""

    def __init__(self, free: FreeSpace, radius: float) -> None:
        """Builds the graph for a footprint of ``radius`` m, without temporary obstacles."""
        self.free, self.grid, self.radius = free, free.grid, radius
        self.min_clearance = radius + WALL_GAP_M
        self.clearance = free.clearance  # (rows, columns) m, to walls and temporary obstacles
        self._graph = _edges(free.clearance >= self.min_clearance, self.grid.resolution)
        self._length = self._graph.data.copy()
        self._to = self._graph.indices
        self._from = np.repeat(np.arange(self.grid.cell_count), np.diff(self._graph.indptr))
        self._opposite = np.empty_like(self._from)  # for each edge, the index of the edge in the opposite direction
        self._opposite[np.lexsort((self._to, self._from))] = np.lexsort((self._from, self._to))
        self._near_obstacles = np.zeros(self.grid.cell_count, bool)  # cells whose cost temporary obstacles may change
        self.cost_per_metre = np.zeros(self.grid.shape)
        self._extra_cost_per_metre = UNKNOWN_COST * free.unknown.ravel()  # the part that does not depend on clearance
        self._update_weights(~self._near_obstacles)
        _, self.component = connected_components(self._graph, directed=False)  # (cells,), without temporary obstacles
        self._centres = self.grid.centres()

    def set_obstacles(self, points: Array) -> None:
        """Replaces the temporary obstacles by ``points`` (K, 2) m in map."""
        range_m, before = self.min_clearance + WALL_COST_RANGE_M, self._near_obstacles
        self.clearance, self._near_obstacles = self.free.clearance, np.zeros(self.grid.cell_count, bool)
        if len(points):
            self._near_obstacles[self.grid.cell_of(points)] = True
            occupied = self._near_obstacles.reshape(self.grid.shape)
            self._near_obstacles = _dilate(occupied, int(range_m / self.grid.resolution) + 1).ravel()
            distance, _ = cKDTree(points).query(self._centres[self._near_obstacles], distance_upper_bound=range_m)
            clearance = self.free.clearance.ravel().copy()
            clearance[self._near_obstacles] = np.minimum(clearance[self._near_obstacles], distance)
            self.clearance = clearance.reshape(self.grid.shape)
        self._update_weights(before | self._near_obstacles)

    def set_extra_cost_per_metre(self, cost: Array) -> None:
        """Replaces the additional cost (cells,) of a metre in each cell, also that of unknown cells."""
        self._extra_cost_per_metre = cost
        self._update_weights(np.ones(self.grid.cell_count, bool))

    @property
    def lengths(self) -> csr_matrix:
        """Lengths (cells, cells) in m of the edges, without temporary obstacles."""
        return csr_matrix((self._length, self._graph.indices, self._graph.indptr), shape=self._graph.shape, copy=True)

    def _update_weights(self, changed: npt.NDArray[np.bool_]) -> None:
        """Recomputes the weights of all edges of the ``changed`` cells (cells,) bool."""
        clearance, cost = self.clearance.ravel(), self.cost_per_metre.ravel()
        cost[changed] = cost_near_walls(clearance[changed], self.min_clearance) + self._extra_cost_per_metre[changed]
        outgoing = np.flatnonzero(changed[self._from])
        edges = np.concatenate([outgoing, self._opposite[outgoing]])
        cost = np.where(clearance >= self.min_clearance, cost, np.inf)
        self._graph.data[edges] = self._length[edges] * (cost[self._from[edges]] + cost[self._to[edges]]) / 2

    def nearest_free(
        self, point: Array, within: float = np.inf, component: int | None = None, *, map_only: bool = False
    ) -> int | None:
        """Flat index of the free cell nearest to a point (2,) m, or None if there is none within ``within`` m.

        ``component`` restricts the search to one connected component; ``map_only`` ignores temporary obstacles.
        """
        clearance = (self.free.clearance if map_only else self.clearance).ravel()
        here = int(self.grid.cell_of(np.asarray(point, float)))
        if (
            clearance[here] >= self.min_clearance
            and component in (None, self.component[here])
            and self.grid.inside(point)
        ):
            return here  # no other cell's centre is nearer to a point inside this cell
        cells = np.arange(self.grid.cell_count) if np.isinf(within) else self.grid.cells_near(point, within)
        cells = cells[clearance[cells] >= self.min_clearance]
        if component is not None:
            cells = cells[self.component[cells] == component]
        if not len(cells):
            return None
        distance = np.hypot(*(self._centres[cells] - point).T)
        best = int(np.argmin(distance))
        return int(cells[best]) if distance[best] <= within else None

    def cost_field(self, point: Array, within: float = np.inf, position: Array | None = None) -> CostField | None:
        """Costs from all cells to the free cell nearest to ``point`` (2,) m, or None if none is within ``within`` m.

        If the point is occupied, a ``position`` (2,) m of the robot makes this the best cell to wait at for a robot
        that is near.
        """
        cell = self.nearest_free(point, within)
        if cell is None:
            return None
        if position is not None and cell != self.grid.cell_of(point):
            cell = self._waiting_cell(point, within, position, cell)
        cost, predecessor = dijkstra(self._graph, indices=cell, return_predecessors=True)
        goal = np.array(point, float)
        if float(self.grid.interpolate(self.clearance, goal)) < self.min_clearance:
            goal = self._centres[cell]
        return CostField(self, goal, cost.reshape(self.grid.shape), predecessor)

    def _waiting_cell(self, point: Array, within: float, position: Array, nearest: int) -> int:
        """The free cell within ``within`` m of an occupied ``point`` with the least path and remaining distance to it.

        Without the path from ``position``, the robot would drive around an obstacle that occupies its goal, because the
        rear, which it does not see, seems free. Far from the point, it is the cell ``nearest`` to it.
        """
        start = self.nearest_free(position, self.min_clearance + 2 * self.grid.resolution)
        if start is None:
            return nearest
        cells = self.grid.cells_near(point, within)
        distance = np.hypot(*(self._centres[cells] - point).T)
        limit = WAITING_RANGE_M + REMAINING_COST * float(np.hypot(*(self._centres[nearest] - point)))
        cost = dijkstra(self._graph, indices=start, limit=limit)[cells] + REMAINING_COST * distance
        best = int(np.argmin(np.where(distance <= within, cost, np.inf)))
        return int(cells[best]) if cost[best] <= limit else nearest  # above the limit, costs are not known

    def clear_line(self, start: Array, ends: Array) -> tuple[Array, Array]:
        """Whether straight lines from (2,) to (N, 2) m are free, and their costs; both (N,)."""
        length = np.hypot(*(ends - start).T)
        steps = int(np.ceil(max(float(length.max(initial=0.0)), 0.05) / (self.grid.resolution / 2))) + 1
        fraction = np.linspace(0, 1, steps)[:, None, None]
        points = start + fraction * (ends - start)
        clearance = self.grid.interpolate(self.clearance, points)
        # The robot may stand closer to a wall than min_clearance. From there every line that leads away is free.
        free = np.all((clearance >= self.min_clearance - 1e-9) | (clearance >= clearance[:1] - 1e-9), axis=0)
        return free, length * self.grid.interpolate(self.cost_per_metre, points).mean(axis=0)


@dataclass(frozen=True)
class CostField:
    """Cost to go to one goal from everywhere."""

    graph: FreeSpaceGraph
    goal: Array  # (2,) m in map, moved to the nearest place where the robot can stand
    cost: Array  # (rows, columns) m to go, more near walls; +inf where the goal cannot be reached
    next_cell: Array  # (cells,) flat index of the next cell on the path to the goal

    def reaches(self, point: Array) -> bool:
        """Whether the goal can be reached from a point (2,) m."""
        return self._entry_cell(point) is not None

    def cost_from(self, point: Array) -> float:
        """Cost in m of the path from a point (2,) m to the goal; +inf if there is none."""
        cell = self._entry_cell(point)
        return np.inf if cell is None else float(self.cost.ravel()[cell])

    def path(self, point: Array) -> Array:
        """Path (K, 2) m in map from a point (2,) to the goal, cell by cell; (0, 2) if there is none."""
        cell = self._entry_cell(point)
        if cell is None:
            return np.zeros((0, 2))
        cells = [cell]
        while (cell := int(self.next_cell[cell])) != NO_PREDECESSOR:
            cells.append(cell)
        centres = self.graph.grid.centres(np.array(cells))
        return np.concatenate([np.atleast_2d(point), centres[1:-1], self.goal[None]])

    def lookahead_point(self, point: Array, path: Array, within: float = 0.0) -> Array:
        """The lookahead point (2,) m on ``path`` of a robot at ``point``: the farthest on a free straight line.

        It is chosen on the next `LOOKAHEAD_RANGE_M` of the path, or ``within`` m if that is more.
        """
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        near = np.flatnonzero(distance[1:] <= max(LOOKAHEAD_RANGE_M, within)) + 1
        tried = np.array([1])
        if len(near):
            tried = near[np.unique(np.linspace(0, len(near) - 1, MAX_LOOKAHEAD_CANDIDATES).astype(int))]
        remaining = self._cost_at(path[tried])
        free, line_cost = self.graph.clear_line(point, path[tried])
        path_cost = self._cost_at(path[:1])[0] - remaining
        max_line_cost = path_cost * MAX_LINE_COST_RATIO + 2 * self.graph.grid.resolution
        good = np.flatnonzero(free & (line_cost <= max_line_cost))
        best = int(good[-1]) if len(good) else 0
        return np.asarray(path[tried[best]])

    def _cost_at(self, points: Array) -> Array:
        cost = self.cost.ravel()[self.graph.grid.cell_of(points)]
        return np.where(np.isfinite(cost), cost, 0.0)

    def _entry_cell(self, point: Array) -> int | None:
        """First cell of the path from ``point``: its own, or one within about a footprint; None if there is none."""
        grid = self.graph.grid
        cell = int(grid.cell_of(np.asarray(point)))
        if np.isfinite(self.cost.ravel()[cell]):
            return cell
        within = self.graph.min_clearance + 2 * grid.resolution
        near = grid.cells_near(point, within)
        distance, cost = np.hypot(*(grid.centres(near) - point).T), self.cost.ravel()[near]
        total = np.where(distance <= within, distance + cost * 1e-3, np.inf)
        return int(near[np.argmin(total)]) if np.isfinite(total).any() else None


def cost_near_walls(clearance: Array, min_clearance: float) -> Array:
    """Cost of a metre at a clearance (N,) m: 1 far from walls, and most at ``min_clearance``."""
    closeness = np.clip(1 - (clearance - min_clearance) / WALL_COST_RANGE_M, 0, 1)
    return np.asarray(1 + MAX_WALL_COST * closeness**2)


def _dilate(cells: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    """Dilates a mask (rows, columns) bool by a square of ``by`` cells to each side."""
    for _ in range(2):  # one axis after the other; the transpose swaps them
        dilated = cells.copy()
        for shift in range(1, by + 1):
            dilated[shift:] |= cells[:-shift]
            dilated[:-shift] |= cells[shift:]
        cells = dilated.T
    return cells


def _edges(free: npt.NDArray[np.bool_], resolution: float) -> csr_matrix:
    """Matrix (cells, cells) of edge lengths in m between free cells, in both directions."""
    rows, columns = free.shape
    index = np.arange(free.size).reshape(free.shape)

    def shifted(values: Any, down: int, right: int, move: tuple[int, int]) -> Any:
        """``values`` at offset (down, right) from every cell from which ``move`` stays on the grid."""
        d, r = move
        top, left = max(0, -d), max(0, -r)
        height, width = rows - abs(d), columns - abs(r)
        return values[top + down : top + down + height, left + right : left + right + width]

    # The empty arrays are for a map of one cell, on which no move is possible.
    starts, ends = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    lengths = [np.zeros(0)]
    for move in MOVES:
        d, r = move
        if abs(d) >= rows or abs(r) >= columns:
            continue
        possible = shifted(free, 0, 0, move) & shifted(free, d, r, move)
        for passed in _passed_cells(d, r):
            possible = possible & shifted(free, *passed, move)
        starts.append(shifted(index, 0, 0, move)[possible])
        ends.append(shifted(index, d, r, move)[possible])
        lengths.append(np.full(int(possible.sum()), resolution * float(np.hypot(d, r))))
    a, b, length = np.concatenate(starts), np.concatenate(ends), np.tile(np.concatenate(lengths), 2)
    both = np.concatenate([a, b]), np.concatenate([b, a])
    return csr_matrix((length, both), shape=(free.size, free.size))


def _passed_cells(down: int, right: int) -> list[tuple[int, int]]:
    """Offsets of the cells that a move passes over, besides its start and end."""
    if abs(down) + abs(right) == 3:
        half = (int(np.sign(down)), 0) if abs(down) == 2 else (0, int(np.sign(right)))
        return [half, (int(np.sign(down)), int(np.sign(right)))]
    return [(down, 0), (0, right)] if down and right else []
