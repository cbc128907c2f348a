"""The goal as a preference: the cost of the path to it through free space.

A quadratic prior on the goal pulls straight at it, through walls. It is replaced by ``-ln p(x) = lambda d(x)``, where d
is the geodesic distance to the goal and a metre near a wall counts for more. The slope of this prior is lambda
everywhere, as if it were a Gaussian whose precision, lambda / d, grows as the robot approaches, so the attraction does
not vanish on the last metres.

Distances come from Dijkstra's algorithm on a grid with 16 neighbours (`grid_paths`). They are at most 2.7 % longer than
the true ones. The robot does not follow the grid: it drives towards the lookahead point, which is the farthest point of
the path to which a straight line is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label
from scipy.spatial import cKDTree

from services.controller.policies.grid_paths import NO_CELL, cheapest_paths, repaired_paths

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.controller.policies.free_space import FreeSpace

WALL_GAP_M = 0.03  # minimum distance between footprint and wall; the obstacle stop needs 0.02 m, and noise 0.01 m
# Minimum gap between footprint and unmapped obstacles: more than the scanner's noise, 0.02 m, and half a cell of
# `obstacles`, 0.025 m, together.
OBSTACLE_GAP_M = 0.06
WALL_COST_RANGE_M = 0.35  # range of clearances beyond the minimum within which a metre costs more
MAX_WALL_COST = 1.0  # additional cost of a metre at the minimum clearance
UNKNOWN_COST = 30.0  # additional cost of a metre where nothing is known: a path through it is the last resort
LOOKAHEAD_RANGE_M = 3.0  # length of the path within which the lookahead point is chosen, for slow robots
MAX_LOOKAHEAD_CANDIDATES = 12  # points of the path that are tried, evenly spaced
MAX_LINE_COST_RATIO = 1.02  # cost of the straight line to the lookahead point, relative to the path on the grid
WAITING_RANGE_M = 4.0  # cost of the path to an occupied goal within which a robot chooses the place where it waits
# Weight of the cost of the path that remains from there, if the obstacle were gone. As it is more than 1, the robot
# drives as near as it can without a detour.
REMAINING_WEIGHT = 2.0
# The search for paths around obstacles ends at the robot's cost without obstacles plus the first margin. If that does
# not reach the robot, it is repeated with the next.
SEARCH_MARGINS_M = (10.0, 60.0, np.inf)


class FreeSpaceGraph:
    """The free cells, and what a metre costs in them, given the walls and the temporary obstacles."""

    def __init__(self, free: FreeSpace, radius: float) -> None:
        """Starts without temporary obstacles, for a footprint of ``radius`` m."""
        self.free, self.grid, self.radius = free, free.grid, radius
        self.min_clearance = radius + WALL_GAP_M
        self._extra_cost_per_metre = UNKNOWN_COST * free.unknown  # the part that does not depend on clearance
        # (rows, columns) m, to walls; to temporary obstacles it is less than the distance, because their gap is wider
        self.clearance = free.clearance.copy()
        self.cost_per_metre = self._extra_cost_per_metre + cost_near_walls(free.clearance, self.min_clearance)
        # (cells,) number of the part of the free space, without temporary obstacles
        self.component = label(free.clearance >= self.min_clearance)[0].ravel()
        self._centres = self.grid.centres()
        self._near_obstacles = np.zeros(0, np.intp)  # cells whose clearance temporary obstacles have reduced
        self._known_paths: tuple[int, Array, npt.NDArray[np.int32]] | None = None  # to one cell, without obstacles

    def set_obstacles(self, points: Array) -> None:
        """Replaces the temporary obstacles by ``points`` (K, 2) m in map."""
        self._set_clearance(self._near_obstacles, self.free.clearance.ravel()[self._near_obstacles])
        self._near_obstacles = np.zeros(0, np.intp)
        if not len(points):
            return
        additional_gap = OBSTACLE_GAP_M - WALL_GAP_M
        range_m = self.min_clearance + WALL_COST_RANGE_M + additional_gap
        cells = np.unique(self.grid.cell_of(points))
        rows, columns = np.divmod(cells, self.grid.shape[1])
        margin = int(range_m / self.grid.resolution) + 1
        top, left = max(0, rows.min() - margin), max(0, columns.min() - margin)
        window = np.zeros((rows.max() + margin + 1 - top, columns.max() + margin + 1 - left), bool)
        window = window[: self.grid.shape[0] - top, : self.grid.shape[1] - left]
        window[rows - top, columns - left] = True
        rows, columns = np.nonzero(_dilate(window, margin))
        near = (rows + top) * self.grid.shape[1] + columns + left
        distance, _ = cKDTree(points).query(self._centres[near], distance_upper_bound=range_m)
        clearance = distance - additional_gap
        reduced = clearance < self.clearance.ravel()[near]
        self._near_obstacles = near[reduced]
        self._set_clearance(self._near_obstacles, clearance[reduced])

    def _set_clearance(self, cells: npt.NDArray[np.intp], clearance: Array) -> None:
        self.clearance.ravel()[cells] = clearance
        extra = self._extra_cost_per_metre.ravel()[cells]
        self.cost_per_metre.ravel()[cells] = extra + cost_near_walls(clearance, self.min_clearance)

    def set_extra_cost_per_metre(self, cost: Array) -> None:
        """Replaces the additional cost (rows, columns) of a metre in each cell, also that of unknown cells."""
        self._extra_cost_per_metre, self._known_paths = cost, None
        self.cost_per_metre = cost + cost_near_walls(self.clearance, self.min_clearance)

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

    def cost_field(self, point: Array, within: float = np.inf) -> CostField | None:
        """Costs from all cells to the free cell nearest to ``point`` (2,) m, or None if none is within ``within`` m."""
        cell = self.nearest_free(point, within)
        if cell is None:
            return None
        return self._field(point, cell, *self._paths_to(cell))

    def cost_field_around_obstacles(self, point: Array, within: float, position: Array) -> CostField | None:
        """The `cost_field` for a robot at ``position`` (2,) m.

        If obstacles occupy the point, it leads to the place where the robot should wait. Where paths around obstacles
        cost more than the robot's and a margin, the costs are those without obstacles, so that most of the map need not
        be searched.
        """
        goal = self.nearest_free(point, within, map_only=True)
        start = self.nearest_free(position, self.min_clearance + 2 * self.grid.resolution)
        if goal is None or start is None:
            return self.cost_field(point, within)
        if self._known_paths is None or self._known_paths[0] != goal:
            self._known_paths = goal, *self._paths_to(goal, map_only=True)
        known = self._known_paths[1:]
        if not len(self._near_obstacles):
            return self._field(point, goal, *known)
        cell_cost = self._cell_cost()
        end: int | None = goal
        if np.isinf(cell_cost.ravel()[goal]):
            end = self._waiting_cell(point, within, start, cell_cost, known[0])
        if end is None:
            return None
        for margin in SEARCH_MARGINS_M:
            limit = known[0][start] + margin
            cost, next_cell = repaired_paths(cell_cost, known, self._near_obstacles, end, limit)
            if cost[start] <= limit:
                break
        if np.isfinite(limit):
            beyond = np.isinf(cost)
            cost[beyond], next_cell[beyond] = known[0][beyond], known[1][beyond]
        cost[np.isinf(cell_cost.ravel())] = np.inf
        return self._field(point, end, np.maximum(cost - known[0][end], 0.0), next_cell)

    def _paths_to(self, cell: int, *, map_only: bool = False) -> tuple[Array, npt.NDArray[np.int32]]:
        return cheapest_paths(self._cell_cost(map_only=map_only), np.array([cell]), np.zeros(1))

    def _cell_cost(self, *, map_only: bool = False) -> Array:
        """Cost (rows, columns) of crossing each cell along its side; +inf where a cell is not free."""
        cost, clearance = self.cost_per_metre, self.clearance
        if map_only:
            clearance = self.free.clearance
            cost = self._extra_cost_per_metre + cost_near_walls(clearance, self.min_clearance)
        return np.where(clearance >= self.min_clearance, self.grid.resolution * cost, np.inf)

    def _field(self, point: Array, cell: int, cost: Array, next_cell: npt.NDArray[np.int32]) -> CostField:
        goal = np.array(point, float)
        if float(self.grid.interpolate(self.clearance, goal)) < self.min_clearance:
            goal = self._centres[cell]
        return CostField(self, goal, cost.reshape(self.grid.shape), next_cell)

    def _waiting_cell(self, point: Array, within: float, start: int, cell_cost: Array, remaining: Array) -> int | None:
        """The free cell within ``within`` m of an occupied ``point`` at which a robot should wait; None without one.

        It has the least sum of the path to it from the cell ``start`` and `REMAINING_WEIGHT` times the ``remaining``
        (cells,) cost, that of the path on to the point without obstacles. Without the former, the robot would drive
        around an obstacle that occupies its goal, because the rear, which it does not see, seems free. Far from the
        point, it is the cell with the least remaining cost.
        """
        cells = self.grid.cells_near(point, within)
        near = np.hypot(*(self._centres[cells] - point).T) <= within
        cells = cells[near & np.isfinite(cell_cost.ravel()[cells]) & np.isfinite(remaining[cells])]
        if not len(cells):
            return None
        weighted = REMAINING_WEIGHT * remaining[cells]
        limit = WAITING_RANGE_M + float(weighted.min())
        cost = cheapest_paths(cell_cost, np.array([start]), np.zeros(1), limit)[0][cells] + weighted
        best = int(np.argmin(cost))
        return int(cells[best if cost[best] <= limit else np.argmin(weighted)])  # above the limit, costs are not known

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
    goal: Array  # (2,) m in map, moved to where the robot can stand, or waits if obstacles occupy the goal
    cost: Array  # (rows, columns) m to go, more near walls; +inf where the goal cannot be reached
    next_cell: npt.NDArray[np.int32]  # (cells,) flat index of the next cell on the path to the goal, or `NO_CELL`

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
        while (cell := int(self.next_cell[cell])) != NO_CELL:
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
