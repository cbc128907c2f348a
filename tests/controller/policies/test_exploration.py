"""The choice of the next viewpoint, on small grids and against brute force."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, permutations

import numpy as np
import pytest

from common.robot.scan_geometry import ALL_ROUND, Sector
from services.controller.policies.exploration import (
    MIN_VIEWPOINT_NATS,
    ExplorationState,
    FieldOfView,
    NoPath,
    choose_viewpoint,
    find_candidates,
    find_frontier,
    known_space,
    select_viewpoints,
    shortest_tour,
)
from services.controller.policies.free_space import FreeSpace, Grid
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.controller.policies.visibility import visible

CELL, RADIUS = 0.1, 0.1


def exploration_state_of(
    rows: str, pose=(1.2, 1.2, 0.0), *, radius=RADIUS, scans=(), arrivals=(), sector=ALL_ROUND, target=None
) -> ExplorationState:
    """What is known of a map that is drawn with # wall, . free, ? unknown, the highest row first.

    Each character is a square of 8 by 8 cells.
    """
    drawn = np.array([list(row) for row in rows.split()])[::-1].repeat(8, axis=0).repeat(8, axis=1)
    grid = Grid((0.0, 0.0), CELL, drawn.shape)
    centres, walls = grid.centres(), grid.centres(np.flatnonzero(drawn == "#"))
    clearance = np.full(grid.cell_count, 9.0)
    if len(walls):
        clearance = np.abs(centres[:, None] - walls).max(axis=2).min(axis=1) - CELL / 2
    graph = FreeSpaceGraph(FreeSpace(grid, clearance.reshape(grid.shape), drawn == "?"), radius)
    return ExplorationState(
        graph,
        np.reshape(scans, (-1, 3)),
        np.reshape(arrivals, (-1, 3)),
        FieldOfView(sector, 5.0),
        np.array(pose),
        np.array(pose[:2]),
        target,
        np.zeros((0, 2)),
    )


CORRIDOR = """
########
#......?
########"""
CLOSED = """
#####
#...#
#####"""
BEND = """
#?####
#.####
#.####
#....?
######"""
# From the start in the middle, there is more to see on the left, behind a longer way.
CROSSROADS = """
#?########
#.########
#.....####
#####....?
##########"""


def test_cells_that_are_seen():
    opaque = np.zeros((5, 9), bool)
    opaque[:, 4] = True
    opaque[4, 4] = False
    places, targets = np.array([[1.5, 2.5]]), np.array([[3.5, 2.5], [7.5, 2.5], [1.5, 4.5]])
    assert visible(opaque, places, targets, 20.0, 1.0).tolist() == [[True, False, True]]
    assert visible(opaque, places, targets, 1.9, 1.0).tolist() == [[False, False, False]]


def test_frontier():
    state = exploration_state_of(CORRIDOR)
    frontier = find_frontier(state)
    x, y = state.graph.grid.centres(frontier.cells).T
    assert np.allclose(x, 5.65)
    assert np.allclose(np.sort(y), 0.85 + 0.1 * np.arange(8))
    assert np.allclose(frontier.information, np.log(2))
    assert not len(find_frontier(exploration_state_of(CLOSED)).cells)


@pytest.mark.parametrize(("yaw", "halved"), [(0.0, True), (np.pi, False)])
def test_each_scan_that_saw_nothing_halves_the_information(yaw, halved):
    """Only scans that looked there count."""
    frontier = find_frontier(exploration_state_of(CORRIDOR, scans=[(1.2, 1.2, yaw)], sector=Sector(0.0, np.pi / 2)))
    assert np.allclose(frontier.information.max(), np.log(2))  # the cells beside the walls are not in full view
    assert bool(np.isclose(frontier.information.min(), np.log(2) / 2)) is halved


def test_information_of_a_viewpoint_is_that_of_the_cells_it_sees():
    """Against a line from each place to each cell, sampled densely."""
    state = exploration_state_of(CROSSROADS, pose=(2.8, 2.0, 0.0))
    frontier, known = find_frontier(state), known_space(state.graph)
    candidates = find_candidates(state, frontier, known)
    assert len(candidates.places) > 3
    centres, free = state.graph.grid.centres(frontier.cells), state.graph.free
    opaque = (free.unknown | (free.clearance < 0)).ravel()
    for place, row in zip(candidates.places, candidates.sees, strict=True):
        for cell, says in zip(centres, row, strict=True):
            line = place + np.linspace(0, 1, 200)[:, None] * (cell - place)
            line = line[np.hypot(*(line - cell).T) > 2 * CELL]
            clear = not opaque[state.graph.grid.cell_of(line)].any()
            assert clear or not says  # what is seen is in sight; at the edge of a shadow the reverse need not hold


def test_selected_viewpoints_are_worth_a_stop():
    seen = np.array([[1, 1, 0, 0, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 1]], bool)
    nats = np.array([2.0, 2.0, 2.0, 2.0, MIN_VIEWPOINT_NATS - 0.1])
    assert select_viewpoints(seen, nats) == [1]  # 6 nats; then place 0 adds 2 and place 2 adds 2.9, which are too few
    assert select_viewpoints(seen, nats + 1.1) == [1, 2, 0]
    assert select_viewpoints(seen, nats + 1.1, target=0) == [0, 1, 2]
    assert select_viewpoints(seen, np.zeros(5)) == []


@pytest.mark.parametrize("seed", range(10))
def test_tour_is_the_shortest_of_all(seed):
    places = np.random.default_rng(seed).uniform(0, 10, (7, 2))
    cost = np.hypot(*np.moveaxis(places[:, None] - places, -1, 0))

    def length(tour):
        return sum(cost[a, b] for a, b in pairwise([0, *(place + 1 for place in tour), len(cost) - 1]))

    best = min(length(tour) for tour in permutations(range(5)))
    assert length(shortest_tour(cost)) <= 1.02 * best


def test_choice_is_the_first_place_of_the_tour_of_least_expected_free_energy():
    """Against all orders of the viewpoints: both ends are worth the way, so the shorter tour decides."""
    state = exploration_state_of(CROSSROADS, pose=(2.8, 2.0, 0.0))
    viewpoint = choose_viewpoint(state)
    assert viewpoint is not None
    assert viewpoint.information >= MIN_VIEWPOINT_NATS - 1.5
    known = known_space(state.graph)
    stops = [state.pose[:2], *viewpoint.tour, state.home]

    def length(order):
        tour = [stops[0], *(stops[k] for k in order), stops[-1]]
        fields = [known.cost_field(place) for place in tour[1:]]
        return sum(
            float(field.cost.ravel()[known.grid.cell_of(place)])
            for place, field in zip(tour[:-1], fields, strict=True)
            if field is not None
        )

    orders = list(permutations(range(1, len(stops) - 1)))
    assert length(orders[0]) <= min(map(length, orders)) + 1e-6


def test_heading_between_two_frontiers():
    """A narrow view from the corner of a bend shows one of the two ends, and nothing from between the headings."""
    bend = exploration_state_of(BEND, sector=Sector(0.3, np.pi / 5))
    viewpoint = choose_viewpoint(bend)
    assert MIN_VIEWPOINT_NATS < viewpoint.information < find_frontier(bend).information.sum()
    other = choose_viewpoint(replace(bend, arrivals=viewpoint.pose[None]))
    assert abs(np.sin(other.pose[2] - viewpoint.pose[2])) > 0.5


def test_nothing_is_left_to_see():
    assert choose_viewpoint(exploration_state_of(CLOSED)) is None
    # The robot has arrived where it sees the end of the corridor, and the map is still the same.
    state = exploration_state_of(CORRIDOR)
    viewpoint = choose_viewpoint(state)
    assert viewpoint is not None
    assert choose_viewpoint(exploration_state_of(CORRIDOR, arrivals=[(*viewpoint.pose[:2], 0.0)] * 2)) is None


def test_too_little_room_to_plan():
    result = choose_viewpoint(exploration_state_of(CORRIDOR, radius=0.35))
    assert isinstance(result, NoPath)
    assert "cannot plan a path from here: there is no place within 0.43 m" in result.reason
    assert choose_viewpoint(exploration_state_of(CLOSED, radius=0.35)) is None  # nothing is left to see


def test_unreachable_places_are_not_chosen():
    shut = CORRIDOR.replace("#......?", "#..#...?")
    assert choose_viewpoint(exploration_state_of(shut)) is None
