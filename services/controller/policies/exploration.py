"""Exploration: where to drive next in a building of which a part is unknown.

The candidates are tours: from the robot through viewpoints, from which a scan sees the frontier between known free and
unknown space, and back to where exploration began. The expected free energy of a tour in nats is

    G(tour) = NATS_PER_METRE * cost - information about the map

The cost is the length of the path in m, where a metre near a wall counts for up to two. A scan shows whether a frontier
cell is free or occupied, which is worth ln 2, times `MISS_PROBABILITY` for each earlier scan that should have shown it
and did not. At `MIN_VIEWPOINT_NATS` a viewpoint is worth a detour of 150 m, so the tour has all that are worth a stop
(up to `MAX_VIEWPOINTS`), by a short path (as Kulich, Faigl & Preucil 2011 choose goals). The robot drives only to its
first viewpoint, as the next map has another frontier.

Approximations: the viewpoints are chosen greedily by their information, as if the scanner saw all around; what lies
beyond the frontier is not predicted; and a scan shows nothing of cells so far away that its beams are farther apart
than the cells of the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.scan_geometry import Sweep
from services.controller.policies.expected_free_energy import NATS_PER_METRE
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.controller.policies.visibility import visible

if TYPE_CHECKING:
    from collections.abc import Sequence

    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from common.robot.scan_geometry import Sector
    from services.controller.policies.free_space import FreeSpace

    Mask = npt.NDArray[np.bool_]
    Cells = npt.NDArray[np.intp]

MISS_PROBABILITY = 0.5  # that a scan does not show a cell that it should see
MIN_CELL_NATS = 0.1  # frontier cells with less information are given up: scans do not reach them
MIN_VIEWPOINT_NATS = 3.0  # a viewpoint that sees less than half a metre of the frontier is not worth a stop
VIEWPOINT_SPACING_M = 0.4  # of the candidate viewpoints
EXTRA_CLEARANCE_M = 0.05  # around the robot, because walls that are seen later may be nearer
MAX_VIEWPOINTS = 12  # of a tour: those with most information
MAX_SHIFT_M = 1.0  # from a place to the free cell from which its paths are planned
MIN_SHORTENING_M = 0.5  # by which a tour must be shorter to replace the present target, so that the robot goes on
UNREACHABLE_RANGE_M = 0.4  # no viewpoint is this close to a place that could not be reached
ARRIVAL_SCANS = 4  # an arrival at a viewpoint counts as this many scans: the cells in sight of it are given up
ARRIVAL_RANGE_M = 0.2  # a place this close to an arrival shows nothing in the directions that the scanner saw there
HEADINGS = 72  # tried at a viewpoint; the robot takes the one at which a scan shows most
MAX_MOVED_VIEWPOINTS = 3  # length of the parts of a tour that are tried at other places in it


@dataclass(frozen=True)
class FieldOfView:
    """What one scan sees."""

    sector: Sector
    range_m: float  # up to which its beams are as dense as the cells of the map

    @classmethod
    def of(cls, scan: Scan, cell: float) -> FieldOfView:
        """The field of view of the scanner that took a scan, for a map with cells of ``cell`` m."""
        sweep = Sweep.of(scan)
        return cls(sweep.sector(scan.mount.yaw), float(min(scan.range_max, cell / max(sweep.spacing, 1e-6))))


@dataclass(frozen=True)
class ExplorationState:
    """What is known about the building and about the exploration so far."""

    graph: FreeSpaceGraph  # of the growing map
    scans: Array  # (K, 3) base_link in map where the scans of the map were taken
    arrivals: Array  # (A, 3) base_link in map where the robot arrived at a viewpoint
    field_of_view: FieldOfView
    pose: Array  # (3,) of the robot in map
    home: Array  # (2,) m in map, where the tour ends
    target: Array | None  # (2,) m in map, the viewpoint to which the robot drives now
    unreachable: Array  # (N, 2) m in map, viewpoints that were given up
    goal_count: int = 0  # goals of users so far; if it has changed when the choice is made, the choice is not used


@dataclass(frozen=True)
class Viewpoint:
    """A place from which a scan shows something new."""

    pose: Array  # (3,) in map, with the heading at which a scan shows most
    information: float  # nats, expected of a scan from there
    tour: Array  # (V, 2) m in map, all viewpoints of the tour from this one on


@dataclass(frozen=True)
class NoPath:
    """Something is left to see, but no path can be planned from where the robot stands."""

    reason: str


@dataclass(frozen=True)
class Frontier:
    """Unknown cells beside known free ones."""

    cells: Cells  # (F,) flat indices
    information: Array  # (F,) nats, expected of a scan of each


@dataclass(frozen=True)
class CandidateViewpoints:
    """Places that may become viewpoints."""

    places: Array  # (P, 2) m in map
    sees: Mask  # (P, F) whether a frontier cell is in sight of a place, in any direction
    target: int | None  # index of the present target; None if there is none, or it cannot be reached


def choose_viewpoint(state: ExplorationState) -> Viewpoint | NoPath | None:
    """The first viewpoint of a short tour; None if returning at once has less expected free energy."""
    frontier, known = find_frontier(state), known_space(state.graph)
    min_clearance = known.min_clearance
    if frontier.information.sum() >= MIN_VIEWPOINT_NATS and known.nearest_free(state.pose[:2], min_clearance) is None:
        return NoPath(
            f"cannot plan a path from here: there is no place within {min_clearance:.2f} m of the robot with "
            f"{min_clearance:.2f} m of known free space around it; drive the robot to where there is more room, and "
            "explore again"
        )
    candidates = find_candidates(state, frontier, known)
    selected = select_viewpoints(candidates.sees, frontier.information, candidates.target)
    if not selected:
        return None
    cost = _travel_costs(known, [state.pose[:2], *candidates.places[selected], state.home])
    tour = shortest_tour(cost)
    if selected[0] == candidates.target:
        tour = _prefer_target(tour, cost)
    information = float(frontier.information[candidates.sees[selected].any(axis=0)].sum())
    returning_at_once = NATS_PER_METRE * cost[0, -1]
    if NATS_PER_METRE * _cost_of(cost, tour) - information >= returning_at_once:
        return None
    return _viewpoint(state, candidates.places[selected][tour], frontier, candidates.sees[selected[tour[0]]])


def find_frontier(state: ExplorationState) -> Frontier:
    """The unknown cells beside known free ones that are not given up."""
    free = state.graph.free
    beside = np.zeros_like(free.unknown)
    passable = ~_opaque(free)
    beside[1:] |= passable[:-1]
    beside[:-1] |= passable[1:]
    beside[:, 1:] |= passable[:, :-1]
    beside[:, :-1] |= passable[:, 1:]
    cells = np.flatnonzero(free.unknown & beside & (free.clearance > 0))
    scans = np.concatenate([state.scans, state.arrivals])
    counts = np.repeat([1, ARRIVAL_SCANS], [len(state.scans), len(state.arrivals)])
    misses = counts @ (_in_sight(state, scans[:, :2], cells) & _in_sector(state, scans, cells))
    information = np.log(2) * MISS_PROBABILITY**misses
    kept = information >= MIN_CELL_NATS
    return Frontier(cells[kept], information[kept])


def known_space(graph: FreeSpaceGraph) -> FreeSpaceGraph:
    """The graph of the places that are known to be free, with `EXTRA_CLEARANCE_M`."""
    free = graph.free
    return FreeSpaceGraph(
        replace(free, clearance=np.where(free.unknown, -1.0, free.clearance)), graph.radius + EXTRA_CLEARANCE_M
    )


def find_candidates(state: ExplorationState, frontier: Frontier, known: FreeSpaceGraph) -> CandidateViewpoints:
    """The place of the robot, places on a lattice that it can reach, and its present target."""
    grid = known.grid
    field = known.cost_field(state.pose[:2], known.min_clearance)
    if field is None or not len(frontier.cells):
        return CandidateViewpoints(np.zeros((0, 2)), np.zeros((0, len(frontier.cells)), bool), None)
    step = max(1, round(VIEWPOINT_SPACING_M / grid.resolution))
    lattice = np.zeros(grid.shape, bool)
    lattice[step // 2 :: step, step // 2 :: step] = True
    cells = np.flatnonzero(np.isfinite(field.cost) & lattice)
    places, target = np.concatenate([field.goal[None], grid.centres(cells)]), None
    if state.target is not None and np.isfinite(field.cost.ravel()[grid.cell_of(state.target)]):
        places, target = np.concatenate([places, state.target[None]]), len(places)
    sees = _in_sight(state, places, frontier.cells)
    if len(state.unreachable):
        distance = np.hypot(*np.moveaxis(places[:, None] - state.unreachable, -1, 0)).min(axis=1)
        sees &= (distance > UNREACHABLE_RANGE_M)[:, None]
    if len(state.arrivals):
        near = np.hypot(*np.moveaxis(places[:, None] - state.arrivals[:, :2], -1, 0)) < ARRIVAL_RANGE_M
        sees &= ~(near @ _in_sector(state, state.arrivals, frontier.cells))
    return CandidateViewpoints(places, sees, target)


def select_viewpoints(sees: Mask, information: Array, target: int | None = None) -> list[int]:
    """Indices of places that together see all cells worth a stop, chosen greedily by the information that each adds.

    ``sees`` (P, F) is whether a place sees a cell, and ``information`` (F,) that of the cells in nats. The place
    ``target`` comes first if it is worth a stop by itself.
    """
    selected: list[int] = []
    left = information.copy()
    while len(selected) < MAX_VIEWPOINTS and len(sees):
        added = sees @ left
        best = int(np.argmax(added))
        if not selected and target is not None and added[target] >= MIN_VIEWPOINT_NATS:
            best = target
        if added[best] < MIN_VIEWPOINT_NATS:
            break
        selected.append(best)
        left[sees[best]] = 0.0
    return selected


def shortest_tour(cost: Array) -> list[int]:
    """Order of the N places between the first and the last row of ``cost`` (N + 2, N + 2), numbered from 0.

    By cheapest insertion, then by 2-opt and Or-opt moves as long as they make it shorter.
    """
    count = len(cost) - 2
    tour: list[int] = []
    for _ in range(count):
        options = [
            [*tour[:at], place, *tour[at:]]
            for place in range(count)
            if place not in tour
            for at in range(len(tour) + 1)
        ]
        tour = min(options, key=lambda option: _cost_of(cost, option))
    while True:
        options = [tour, *_variations(tour)]
        best = min(options, key=lambda option: _cost_of(cost, option))
        if _cost_of(cost, best) >= _cost_of(cost, tour) - 1e-9:
            return tour
        tour = best


def _variations(tour: list[int]) -> list[list[int]]:
    """Tours with one part reversed, or moved elsewhere."""
    found, count = [], len(tour)
    for begin in range(count):
        for end in range(begin + 1, count + 1):
            part, rest = tour[begin:end], [*tour[:begin], *tour[end:]]
            found.append([*tour[:begin], *part[::-1], *tour[end:]])
            if len(part) <= MAX_MOVED_VIEWPOINTS:
                found += [[*rest[:at], *part, *rest[at:]] for at in range(len(rest) + 1)]
    return found


def _prefer_target(tour: list[int], cost: Array) -> list[int]:
    """The shortest tour that begins with place 0, the present target, unless ``tour`` is clearly shorter."""
    if tour[0] == 0:
        return tour
    target_first = [0, *(place + 1 for place in shortest_tour(cost[1:, 1:]))]
    return target_first if _cost_of(cost, target_first) < _cost_of(cost, tour) + MIN_SHORTENING_M else tour


def _cost_of(cost: Array, tour: Sequence[int]) -> float:
    """Cost in m of a tour, from the start to the end."""
    return float(sum(cost[a, b] for a, b in pairwise([0, *(place + 1 for place in tour), len(cost) - 1])))


def _travel_costs(graph: FreeSpaceGraph, places: Sequence[Array]) -> Array:
    """Costs (N, N) m of the paths between places (2,) m; a path to or from a place in unknown space is very long."""
    longest = 10.0 * sum(graph.grid.shape) * graph.grid.resolution
    cells = graph.grid.cell_of(np.array(places))
    rows = []
    for place in places:
        field = graph.cost_field(place, MAX_SHIFT_M)
        rows.append(np.full(len(cells), longest) if field is None else np.minimum(field.cost.ravel()[cells], longest))
    cost = np.array(rows)
    return np.asarray(np.minimum(cost, cost.T))  # a path may begin, but not end, beside the known space


def _opaque(free: FreeSpace) -> Mask:
    """Cells (rows, columns) that may block a beam: walls and unknown ones."""
    return np.asarray(free.unknown | (free.clearance < free.grid.resolution / 2 - 1e-9))


def _in_sight(state: ExplorationState, places: Array, cells: Cells) -> Mask:
    """Whether nothing hides the cells (F,) with these flat indices from a scanner at places (P, 2) m; (P, F)."""
    free = state.graph.free
    size, corner = free.grid.resolution, np.array(free.grid.origin)
    targets = (free.grid.centres(cells) - corner) / size
    reach, own_radius = state.field_of_view.range_m / size, state.graph.radius / size
    return np.asarray(visible(_opaque(free), (places - corner) / size, targets, reach, own_radius))


def _in_sector(state: ExplorationState, poses: Array, cells: Cells) -> Mask:
    """Whether cells (F,) lie in the directions that the scanner sees from poses (P, 3); (P, F)."""
    sector = state.field_of_view.sector
    offset = state.graph.grid.centres(cells) - poses[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, None, 2] - sector.centre
    return np.asarray(np.abs(se2.wrap(bearing)) <= sector.half + 1e-9)


def _viewpoint(state: ExplorationState, tour: Array, frontier: Frontier, sees: Mask) -> Viewpoint:
    """The first place of a tour (V, 2) m as a viewpoint; it sees the frontier cells in the mask ``sees`` (F,)."""
    place, cells, information = tour[0], frontier.cells[sees], frontier.information[sees]
    middle = (information[:, None] * (state.graph.grid.centres(cells) - place)).sum(axis=0)
    towards_middle = np.arctan2(middle[1], middle[0]) - state.field_of_view.sector.centre
    headings = se2.wrap(towards_middle + np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False))
    poses = np.column_stack([np.tile(place, (HEADINGS, 1)), headings])
    shown = _in_sector(state, poses, cells) @ information
    best = int(np.argmax(shown))  # the first, towards the middle, if the scanner sees all around
    return Viewpoint(poses[best], float(shown[best]), tour)
