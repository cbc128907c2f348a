"""Cost over free space: paths around walls, of nearly the shortest length, and visible attractors."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.world import World, load_world
from services.controller.policies.free_space import FreeSpace, Grid
from services.controller.policies.geodesic_field import (
    MAX_WALL_COST,
    WALL_COST_RANGE_M,
    WALL_GAP_M,
    FreeSpaceGraph,
    slowness,
)

RADIUS = 0.27
NAMES = ("corridor", "maze", "office")
GRAPHS = {name: FreeSpaceGraph(FreeSpace.of(load_world(name)), RADIUS) for name in NAMES}
EMPTY = World(name="hall", boundary=[(0, 0), (10, 0), (10, 6), (0, 6)])


def length(path):
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


@given(st.floats(-3, 13), st.floats(-3, 9))
def test_interpolation_is_exact_for_a_plane(x, y):
    grid = Grid.over(EMPTY)
    centres = grid.centres()
    values = (2 * centres[:, 0] - 3 * centres[:, 1] + 1).reshape(grid.shape)
    inner = np.clip([x, y], [0.05, 0.05], [9.95, 5.95])  # beyond the outermost centres it is constant
    assert grid.interpolate(values, np.array([x, y])) == pytest.approx(2 * inner[0] - 3 * inner[1] + 1)
    assert grid.cell_of(centres).tolist() == list(range(grid.cells))


def test_grid_clearance_matches_the_world():
    world, rng = load_world("office"), np.random.default_rng(0)
    points = world.sample_free(2000, rng, 0.1)
    distance = np.abs(FreeSpace.of(world).clearance_at(points) - world.clearance(points))
    assert distance.max() < 0.05  # less than half a cell, at corners
    assert np.median(distance) < 1e-3


def test_cost_without_walls_is_the_distance():
    graph = FreeSpaceGraph(FreeSpace.of(EMPTY), RADIUS)
    goal = np.array([2.05, 3.05])
    field = graph.cost_field(goal)
    rows, columns = np.nonzero(graph.clearance > RADIUS + 0.4)
    centres = graph.grid.centres(rows * graph.grid.shape[1] + columns)
    exact = np.hypot(*(centres - goal).T)
    ratio = field.cost[rows, columns][exact > 0.5] / exact[exact > 0.5]
    assert ratio.min() > 1 - 1e-9
    assert ratio.max() < 1.0275  # 16 neighbours


@pytest.mark.parametrize("name", NAMES)
def test_paths_keep_clear_and_are_nearly_shortest(name):
    world, graph, rng = load_world(name), GRAPHS[name], np.random.default_rng(1)
    room = shapely.buffer(world.free_space, -(RADIUS + WALL_GAP_M) + 0.05)  # the grid may cut corners by 5 cm
    places = world.sample_free(40, rng, RADIUS + WALL_GAP_M).reshape(-1, 2, 2)
    reached = 0
    for start, goal in places:
        field = graph.cost_field(goal)
        path = field.path(start)
        if not len(path):
            assert not field.reaches(start)
            continue
        reached += 1
        np.testing.assert_array_equal(path[0], start)
        assert np.hypot(*(path[-1] - goal)) < 0.1
        # Start and goal may be closer to walls; between them the path is clear.
        assert shapely.covers(room, shapely.LineString(path[2:-2])) or len(path) < 6
        straight = float(np.hypot(*(goal - start)))
        assert length(path) >= straight - 1e-9
        if shapely.covers(shapely.buffer(world.free_space, -1.0), shapely.LineString([start, goal])):
            assert length(path) < 1.06 * straight + 0.2
    assert reached >= 15


@pytest.mark.parametrize("name", NAMES)
def test_following_the_attractor_leads_to_the_goal(name):
    world, graph, rng = load_world(name), GRAPHS[name], np.random.default_rng(2)
    for start, goal in world.sample_free(20, rng, 0.4).reshape(-1, 2, 2):
        field, here, travelled = graph.cost_field(goal), start, 0.0
        first = length(field.path(start)) if field.reaches(start) else None
        for _ in range(200):
            if first is None or np.hypot(*(here - field.goal)) < 0.01:
                break
            point = field.attractor(here, field.path(here))
            ok, _ = graph.clear_line(here, point[None])
            assert ok[0], (start, goal, here, point)
            step = min(0.3, float(np.hypot(*(point - here))))
            travelled += step
            here = here + (point - here) * step / max(float(np.hypot(*(point - here))), 1e-9)
        else:
            pytest.fail(f"not there from {start} to {goal}")
        # The attractor shortens the detours of the grid.
        assert first is None or travelled <= first + 0.05


def test_path_around_an_obstacle_and_after_its_removal():
    graph = FreeSpaceGraph(FreeSpace.of(EMPTY), RADIUS)
    start, goal = np.array([1.0, 3.0]), np.array([9.0, 3.0])
    free = length(graph.cost_field(goal).path(start))
    wall = np.stack([np.full(41, 5.0), np.linspace(1.0, 5.0, 41)], axis=-1)
    graph.set_obstacles(wall)
    detour = graph.cost_field(goal).path(start)
    assert np.hypot(*(detour[:, None] - wall).transpose(2, 0, 1)).min() >= RADIUS + WALL_GAP_M - 0.06
    assert length(detour) > free + 1.0
    graph.set_obstacles(np.stack([np.full(60, 5.0), np.linspace(0.05, 5.95, 60)], axis=-1))
    closed = graph.cost_field(goal)
    assert not closed.reaches(start)
    assert len(closed.path(start)) == 0
    graph.set_obstacles(np.zeros((0, 2)))
    assert length(graph.cost_field(goal).path(start)) == pytest.approx(free)


@pytest.mark.parametrize("world", GRAPHS)
def test_graph_depends_on_present_obstacles_only(world):
    graph, rng = FreeSpaceGraph(GRAPHS[world].free, RADIUS), np.random.default_rng(2)
    x0, y0, x1, y1 = load_world(world).bounds
    for count in (40, 3, 200, 1, 0):
        points = rng.uniform((x0 - 1, y0 - 1), (x1 + 1, y1 + 1), (count, 2))  # some beyond the map
        graph.set_obstacles(points)
        rebuilt = FreeSpaceGraph(graph.free, RADIUS)
        rebuilt.set_obstacles(points)
        distance = np.hypot(*(graph.grid.centres()[:, None] - points).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        exact = np.minimum(graph.free.clearance.ravel(), distance)
        relevant = exact < graph.min_clearance + WALL_COST_RANGE_M
        assert np.allclose(graph.clearance.ravel()[relevant], exact[relevant], rtol=0, atol=1e-12)
        assert (graph.clearance.ravel()[~relevant] >= graph.min_clearance + WALL_COST_RANGE_M).all()
        assert np.allclose(graph.slowness.ravel(), slowness(exact, graph.min_clearance), rtol=0, atol=1e-12)
        goal = graph.nearest_free(np.array([(x0 + x1) / 2, (y0 + y1) / 2]))
        place = graph.grid.centres([goal])[0]
        assert np.array_equal(graph.cost_field(place).cost, rebuilt.cost_field(place).cost)


def test_slowness_is_between_one_and_its_maximum():
    for graph in GRAPHS.values():
        assert graph.slowness.min() >= 1
        assert graph.slowness.max() <= 1 + MAX_WALL_COST
        far = graph.clearance > RADIUS + 0.5
        assert (graph.slowness[far] == 1).all()


def test_path_keeps_away_from_a_wall():
    graph = FreeSpaceGraph(FreeSpace.of(EMPTY), RADIUS)
    path = graph.cost_field(np.array([9.0, 0.35])).path(np.array([1.0, 0.35]))
    assert path[len(path) // 2, 1] > 0.5
    assert length(path) < 8.3


def test_rooms_without_a_door_are_two_components():
    wall = [{"box": {"center": (5, 3), "size": (0.2, 6)}}]
    graph = FreeSpaceGraph(FreeSpace.of(World(name="two", boundary=EMPTY.boundary, obstacles=wall)), RADIUS)
    left, right = (graph.nearest_free(np.array(point)) for point in ([2.0, 3.0], [8.0, 3.0]))
    assert graph.component[left] != graph.component[right]
    assert not graph.cost_field(np.array([8.0, 3.0])).reaches(np.array([2.0, 3.0]))
    near = graph.nearest_free(np.array([8.0, 3.0]), component=int(graph.component[left]))
    assert graph.grid.centres([near])[0][0] < 5
