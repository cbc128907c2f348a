"""Exploration: where to drive next in a building of which a part is unknown.

A policy is a tour: from the robot through places from which a scanner sees cells at the edge of what is known, and back
to where exploration began. Its expected free energy in nats is

    G(tour) = NATS_PER_METRE * length - information about the map

A cell at the edge is free or occupied, which a scan tells: ln 2, times `MISS_PROBABILITY` for each earlier scan that
should have told it and did not. At `MIN_VIEW_NATS` a view is worth a way of 150 m, so the tour takes in all that is
worth seeing, by the shortest way (as Kulich, Faigl & Preucil 2011 choose goals). Only its first place is driven to, as
the next map has other edges.

Approximations: the views are chosen greedily by what they tell; what lies beyond the edge is not predicted; and a scan
tells nothing of what it sees at a distance where its beams are farther apart than the cells of the map.
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

MISS_PROBABILITY = 0.5  # that a scan does not tell whether a cell that it should see is free
MIN_CELL_NATS = 0.1  # cells that tell less are given up: scans do not reach them
MIN_VIEW_NATS = 3.0  # a view of less than half a metre of the edge is not worth stopping for
VIEW_SPACING_M = 0.4
SPARE_ROOM_M = 0.05
MAX_VIEWS = 12  # of a tour; those that tell most
CHANGE_M = 0.5  # by which a tour with another first place must be shorter, so that the robot does not dither
UNREACHABLE_RANGE_M = 0.4  # around a place that could not be reached, no other is tried
ARRIVAL_SCANS = 4  # an arrival counts as so many scans, as more of them would tell nothing new
ARRIVAL_RANGE_M = 0.2  # a view this close to an arrival tells nothing of what was in sight there


@dataclass(frozen=True)
class ScannerView:
    """What one scan sees."""

    sector: Sector
    range_m: float  # up to which its beams are as dense as the cells of the map

    @classmethod
    def of(cls, scan: Scan, cell: float) -> ScannerView:
        """The view of the scanner that took a scan, for a map with cells of ``cell`` m."""
        sweep = Sweep.of(scan)
        return cls(sweep.sector(scan.mount.yaw), float(min(scan.range_max, cell / max(sweep.spacing, 1e-6))))


@dataclass(frozen=True)
class Survey:
    """What is known of the building and of the exploration so far."""

    graph: FreeSpaceGraph  # of the growing map
    scans: Array  # (K, 3) base_link in map where the scans of the map were taken
    arrivals: Array  # (A, 3) base_link in map where the robot arrived at a view
    view: ScannerView
    pose: Array  # (3,) of the robot in map
    home: Array  # (2,) m in map, where the tour ends
    target: Array | None  # (2,) m in map, to which the robot drives now
    unreachable: Array  # (N, 2) m in map, places to which no way was found


@dataclass(frozen=True)
class View:
    """A place from which a scan tells something about the map."""

    pose: Array  # (3,) in map, facing the edge of what is known
    nats: float  # that a scan from there is expected to tell
    tour: Array  # (V, 2) m in map, the places of the whole tour from this one on, without its end


@dataclass(frozen=True)
class Frontier:
    """Unknown cells beside known free ones."""

    cells: Cells  # (F,) flat indices
    nats: Array  # (F,) that a scan of each is expected to tell


def choose_view(survey: Survey) -> View | None:
    """The first place of the tour of least expected free energy; None if no view is worth the way."""
    edge, known = frontier_of(survey), known_space(survey.graph)
    places, gain, first = candidate_views(survey, edge, known)
    chosen = cover(gain, edge.nats, first)
    if not chosen:
        return None
    cost = _costs_between(known, [survey.pose[:2], *places[chosen], survey.home])
    tour = shortest_tour(cost)
    if chosen[0] == first and tour[0] != 0:
        kept = [0, *(place + 1 for place in shortest_tour(cost[1:, 1:]))]  # from the present target on
        tour = kept if _length(cost, kept) < _length(cost, tour) + CHANGE_M else tour
    energy = NATS_PER_METRE * _length(cost, tour) - float(edge.nats[gain[chosen].any(axis=0)].sum())
    if energy >= NATS_PER_METRE * cost[0, -1]:  # that of returning at once
        return None
    return _view(survey, places[chosen][tour], edge, gain[chosen[tour[0]]])


def frontier_of(survey: Survey) -> Frontier:
    """The edge of what is known, where scans still tell something."""
    free = survey.graph.free
    beside = np.zeros_like(free.unknown)
    passable = ~_opaque(free)
    beside[1:] |= passable[:-1]
    beside[:-1] |= passable[1:]
    beside[:, 1:] |= passable[:, :-1]
    beside[:, :-1] |= passable[:, 1:]
    cells = np.flatnonzero(free.unknown & beside & (free.clearance > 0))
    scans = np.concatenate([survey.scans, np.repeat(survey.arrivals, ARRIVAL_SCANS, axis=0)])
    misses = np.sum(_seen(survey, scans[:, :2], cells) & _in_sector(survey, scans, cells), axis=0)
    nats = np.log(2) * MISS_PROBABILITY**misses
    return Frontier(cells[nats >= MIN_CELL_NATS], nats[nats >= MIN_CELL_NATS])


def known_space(graph: FreeSpaceGraph) -> FreeSpaceGraph:
    """The graph of the places that are known to be free, with some room to spare: walls seen later may be nearer."""
    free = graph.free
    return FreeSpaceGraph(
        replace(free, clearance=np.where(free.unknown, -1.0, free.clearance)), graph.radius + SPARE_ROOM_M
    )


def candidate_views(survey: Survey, edge: Frontier, known: FreeSpaceGraph) -> tuple[Array, Mask, int | None]:
    """Places (P, 2) m that can be reached, and which cells of the edge a scan from each of them sees (P, F).

    The first place is that of the robot. Also returns the index of the present target, or None if it cannot be reached.
    """
    grid = known.grid
    field = known.cost_field(survey.pose[:2], known.min_clearance)
    if field is None or not len(edge.cells):
        return np.zeros((0, 2)), np.zeros((0, len(edge.cells)), bool), None
    reachable = np.isfinite(field.cost)
    step = max(1, round(VIEW_SPACING_M / grid.resolution))
    lattice = np.zeros(grid.shape, bool)
    lattice[step // 2 :: step, step // 2 :: step] = True
    cells = np.flatnonzero(reachable & lattice)
    places = np.concatenate([field.goal[None], grid.centres(cells)])
    first = None
    if survey.target is not None and np.isfinite(field.cost.ravel()[grid.cell_of(survey.target)]):
        places, first = np.concatenate([places, survey.target[None]]), len(places)
    gain = _seen(survey, places, edge.cells)
    if len(survey.unreachable):
        distance = np.hypot(*np.moveaxis(places[:, None] - survey.unreachable, -1, 0)).min(axis=1)
        gain &= (distance > UNREACHABLE_RANGE_M)[:, None]
    if len(survey.arrivals):
        near = np.hypot(*np.moveaxis(places[:, None] - survey.arrivals[:, :2], -1, 0)) < ARRIVAL_RANGE_M
        gain &= ~(near @ _in_sector(survey, survey.arrivals, edge.cells))
    return places, gain, first


def cover(gain: Mask, nats: Array, first: int | None = None) -> list[int]:
    """Places that together see all cells worth seeing, chosen greedily by the information that each adds.

    ``gain`` (P, F) says which cells each place sees, and ``nats`` (F,) what these tell. Place ``first`` is taken first
    if it tells enough by itself.
    """
    chosen: list[int] = []
    left = nats.copy()
    while len(chosen) < MAX_VIEWS and len(gain):
        total = gain @ left
        best = int(np.argmax(total))
        if not chosen and first is not None and total[first] >= MIN_VIEW_NATS:
            best = first
        if total[best] < MIN_VIEW_NATS:
            break
        chosen.append(best)
        left[gain[best]] = 0.0
    return chosen


def shortest_tour(cost: Array) -> list[int]:
    """Order of the N places between the first and the last row of ``cost`` (N + 2, N + 2), numbered from 0.

    By cheapest insertion, then by moving and reversing parts of the tour as long as that makes it shorter.
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
        tour = min(options, key=lambda option: _length(cost, option))
    while True:
        options = [tour, *_variations(tour)]
        best = min(options, key=lambda option: _length(cost, option))
        if _length(cost, best) >= _length(cost, tour) - 1e-9:
            return tour
        tour = best


def _variations(tour: list[int]) -> list[list[int]]:
    """Tours with one part reversed, or moved elsewhere."""
    found, count = [], len(tour)
    for begin in range(count):
        for end in range(begin + 1, count + 1):
            part, rest = tour[begin:end], [*tour[:begin], *tour[end:]]
            found.append([*tour[:begin], *part[::-1], *tour[end:]])
            if len(part) <= 3:
                found += [[*rest[:at], *part, *rest[at:]] for at in range(len(rest) + 1)]
    return found


def _length(cost: Array, tour: Sequence[int]) -> float:
    """Length in m of a tour with its way from the start and to the end."""
    return float(sum(cost[a, b] for a, b in pairwise([0, *(place + 1 for place in tour), len(cost) - 1])))


def _costs_between(graph: FreeSpaceGraph, places: Sequence[Array]) -> Array:
    """Costs (N, N) m of the ways between places (2,) m; a way that is not known counts as very long."""
    longest = 10.0 * sum(graph.grid.shape) * graph.grid.resolution
    cells = graph.grid.cell_of(np.array(places))
    rows = []
    for place in places:
        field = graph.cost_field(place, 1.0)
        rows.append(np.full(len(cells), longest) if field is None else np.minimum(field.cost.ravel()[cells], longest))
    cost = np.array(rows)
    return np.asarray(np.minimum(cost, cost.T))  # a place may lie beside the known space, in one direction only


def _opaque(free: FreeSpace) -> Mask:
    """Cells (rows, columns) through which nothing is known to be seen: walls, and unknown ones."""
    return np.asarray(free.unknown | (free.clearance < free.grid.resolution / 2 - 1e-9))


def _seen(survey: Survey, places: Array, cells: Cells) -> Mask:
    """Whether a scanner at places (P, 2) m that looks all round sees the cells (F,) with these flat indices; (P, F)."""
    free = survey.graph.free
    size, corner = free.grid.resolution, np.array(free.grid.origin)
    targets = (free.grid.centres(cells) - corner) / size
    reach, blind = survey.view.range_m / size, survey.graph.radius / size
    return np.asarray(visible(_opaque(free), (places - corner) / size, targets, reach, blind))


def _in_sector(survey: Survey, poses: Array, cells: Cells) -> Mask:
    """Whether cells (F,) lie in the directions that the scanner sees from poses (P, 3); (P, F)."""
    sector = survey.view.sector
    offset = survey.graph.grid.centres(cells) - poses[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, None, 2] - sector.centre
    return np.asarray(np.abs(se2.wrap(bearing)) <= sector.half + 1e-9)


def _view(survey: Survey, tour: Array, edge: Frontier, sees: Mask) -> View:
    """The first place of a tour (V, 2) m, which sees these cells of the edge (F,)."""
    place, nats = tour[0], edge.nats[sees]
    middle = (nats[:, None] * (survey.graph.grid.centres(edge.cells[sees]) - place)).sum(axis=0)
    heading = float(se2.wrap(np.arctan2(middle[1], middle[0]) - survey.view.sector.centre))
    return View(np.array([*place, heading]), float(nats.sum()), tour)
