"""Cost over free space: paths around walls, of nearly the shortest length, and visible lookahead points."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.world import World
from services.controller.policies.free_space import FreeSpace, Grid
from services.controller.policies.geodesic_field import (
    MAX_WALL_COST,
    OBSTACLE_GAP_M,
    WALL_COST_RANGE_M,
    WALL_GAP_M,
    FreeSpaceGraph,
    cost_near_walls,
)
from tests.common.geometry.maps import rooms
from tests.controller.driving import box, free_space, path_length, room, shipped

RADIUS = 0.27
NAMES = ("corridor", "maze", "office")
EMPTY = room(10, 6)


@functools.cache
def graph_of(name: str) -> FreeSpaceGraph:
    return FreeSpaceGraph(free_space(name), RADIUS)


@pytest.fixture
def empty():
    return FreeSpaceGraph(FreeSpace.of(EMPTY), RADIUS)


@given(st.floats(-3, 13), st.floats(-3, 9))
def test_interpolation_is_exact_for_a_plane(x, y):
    grid = Grid.over(EMPTY)
    centres = grid.centres()
    values = (2 * centres[:, 0] - 3 * centres[:, 1] + 1).reshape(grid.shape)
    inner = np.clip([x, y], [0.05, 0.05], [9.95, 5.95])  # beyond the outermost centres it is constant
    assert grid.interpolate(values, np.array([x, y])) == pytest.approx(2 * inner[0] - 3 * inner[1] + 1)
    assert grid.cell_of(centres).tolist() == list(range(grid.cell_count))


@pytest.mark.parametrize(
    "world",
    [shipped("office"), World(name="map", grid=OccupancyGrid.of(rooms(200), 0.05, (3.0, 1.0, 0.5)))],
    ids=lambda world: world.name,
)
def test_grid_clearance_matches_the_world(world):
    points = world.sample_free(2000, np.random.default_rng(0), 0.1)
    distance = np.abs(FreeSpace.of(world).clearance_at(points) - world.clearance(points))
    assert distance.max() < 0.05  # less than half a cell, at corners
    assert np.median(distance) < 1e-3


def test_cost_without_walls_is_the_distance(empty):
    goal = np.array([2.05, 3.05])
    field, clear = empty.cost_field(goal), (empty.clearance > RADIUS + 0.4).ravel()
    exact = np.hypot(*(empty.grid.centres() - goal).T)
    ratio = (field.cost.ravel() / np.maximum(exact, 1e-9))[clear & (exact > 0.5)]
    assert ratio.min() > 1 - 1e-9
    assert ratio.max() < 1.0275  # 16 neighbours


def follow_lookahead(field, here, room) -> float:
    """Length in m of the way to the goal along lookahead points, each in straight line within ``room``."""
    travelled = 0.0
    while np.hypot(*(here - field.goal)) >= 0.01:
        point = field.lookahead_point(here, field.path(here))
        assert shapely.covers(room, shapely.LineString([here, point])), (here, point)
        distance = float(np.hypot(*(point - here)))
        step = min(0.3, distance)
        here, travelled = here + (point - here) * step / max(distance, 1e-9), travelled + step
        assert travelled < 100
    return travelled


@pytest.mark.parametrize("name", NAMES)
def test_nearly_shortest_paths(name):
    world, graph, rng = shipped(name), graph_of(name), np.random.default_rng(1)
    inner = shapely.buffer(world.free_space, -(RADIUS + WALL_GAP_M) + 0.05)  # the grid may cut corners by 5 cm
    wide, reached = shapely.buffer(world.free_space, -1.0), 0
    for start, goal in world.sample_free(24, rng, RADIUS + WALL_GAP_M).reshape(-1, 2, 2):
        field = graph.cost_field(goal)
        path = field.path(start)
        assert field.reaches(start) == bool(len(path))
        if not len(path):
            continue
        reached += 1
        np.testing.assert_array_equal(path[0], start)
        assert np.hypot(*(path[-1] - goal)) < 0.1
        # Start and goal may be closer to walls; between them the path is clear.
        assert shapely.covers(inner, shapely.LineString(path[2:-2])) or len(path) < 6
        straight = float(np.hypot(*(goal - start)))
        assert path_length(path) >= straight - 1e-9
        if shapely.covers(wide, shapely.LineString([start, goal])):
            assert path_length(path) < 1.06 * straight + 0.2
        if world.has_room(start, 0.4) and world.has_room(goal, 0.4):
            # The lookahead point shortens the detours of the grid.
            assert follow_lookahead(field, start, inner) <= path_length(path) + 0.05
    assert reached >= 9


def test_path_around_an_obstacle(empty):
    start, goal = np.array([1.0, 3.0]), np.array([9.0, 3.0])
    free = path_length(empty.cost_field(goal).path(start))
    wall = np.stack([np.full(41, 5.0), np.linspace(1.0, 5.0, 41)], axis=-1)
    empty.set_obstacles(wall)
    detour = empty.cost_field(goal).path(start)
    assert np.hypot(*(detour[:, None] - wall).transpose(2, 0, 1)).min() >= RADIUS + WALL_GAP_M - 0.06
    assert path_length(detour) > free + 1.0
    empty.set_obstacles(np.stack([np.full(60, 5.0), np.linspace(0.05, 5.95, 60)], axis=-1))
    assert not empty.cost_field(goal).reaches(start)
    assert len(empty.cost_field(goal).path(start)) == 0
    empty.set_obstacles(np.zeros((0, 2)))
    assert path_length(empty.cost_field(goal).path(start)) == pytest.approx(free)


def test_where_to_wait_for_an_occupied_goal(empty):
    """A robot waits on its side of an obstacle, but as near to the goal as a straight way leads; others, nearest."""
    goal = np.array([5.0, 3.0])
    empty.set_obstacles(np.stack([np.linspace(4.0, 6.0, 41), np.full(41, 3.1)], axis=-1))
    starts = np.array([[5.0, 5.0], [5.0, 1.5], [1.0, 5.5]])
    places = [empty.cost_field_around_obstacles(goal, 2.0, start).goal for start in starts]
    assert (places[0] - [5.0, 3.1])[1] > RADIUS
    assert (places[1] - [5.0, 3.1])[1] < -RADIUS
    for place, nearest in ((places[0], 0.5), (places[1], 0.3), (places[2], 0.3)):
        assert np.hypot(*(place - goal)) < nearest


def test_robot_close_to_an_obstacle(empty):
    """Its path leads around the obstacle, also from within the gap that motions keep."""
    empty.set_obstacles(np.stack([np.full(41, 5.0), np.linspace(2.0, 4.0, 41)], axis=-1))
    goal, start = np.array([8.0, 3.0]), np.array([4.72, 3.05])
    path = empty.cost_field_around_obstacles(goal, 2.0, start).path(start)
    assert path_length(path) == pytest.approx(path_length(empty.cost_field(goal).path(start)))
    assert path_length(path) > 4.0


@pytest.mark.parametrize("door", [0.0, 1.0])
@pytest.mark.parametrize("start", [(5.0, 2.0), (8.0, 4.0)])
def test_waiting_on_the_right_side_of_a_wall(door, start):
    """The place to wait is near along the way without the obstacle, not as the crow flies."""
    world = room(10, 8, box(5 - door / 2, 5, 10 - door, 0.05, "wall"))
    graph = FreeSpaceGraph(FreeSpace.of(world), RADIUS)
    x, y = (each.ravel() for each in np.meshgrid(np.arange(3.9, 6.1, 0.05), np.arange(4.0, 4.8, 0.05)))
    graph.set_obstacles(np.stack([x, y], axis=-1))
    field = graph.cost_field_around_obstacles(np.array([5.0, 4.62]), 2.0, np.array(start))
    assert field.goal[1] < 4.7
    assert field.reaches(np.array(start))
    assert field.cost_from(field.goal) == 0


@pytest.mark.parametrize("name", NAMES)
def test_costs_around_obstacles(name):
    """Computed only where obstacles change them, the costs near the robot are those of all paths around them."""
    world, graph, rng = shipped(name), FreeSpaceGraph(free_space(name), RADIUS), np.random.default_rng(4)
    (x0, y0, x1, y1), compared = world.bounds, 0
    for start, goal in world.sample_free(20, rng, RADIUS + WALL_GAP_M).reshape(-1, 2, 2):
        graph.set_obstacles(rng.uniform((x0, y0), (x1, y1), (rng.integers(1, 12), 2)))
        everywhere, found = graph.cost_field(goal, 0.3), graph.cost_field_around_obstacles(goal, 0.3, start)
        if everywhere is None or graph.nearest_free(goal) != graph.nearest_free(goal, map_only=True):
            continue
        robot = everywhere.cost_from(start)
        assert found.cost_from(start) == pytest.approx(robot)
        np.testing.assert_allclose(found.path(start), everywhere.path(start))
        near = everywhere.cost <= robot
        np.testing.assert_allclose(found.cost[near], everywhere.cost[near], rtol=1e-9)
        assert np.isinf(found.cost[graph.clearance < graph.min_clearance]).all()
        compared += 1
    assert compared >= 3


@pytest.mark.parametrize("name", ["corridor", "office"])
def test_graph_of_present_obstacles(name):
    graph, rng = FreeSpaceGraph(free_space(name), RADIUS), np.random.default_rng(2)
    x0, y0, x1, y1 = shipped(name).bounds
    for count in (40, 3, 200, 0):
        points = rng.uniform((x0 - 1, y0 - 1), (x1 + 1, y1 + 1), (count, 2))  # some beyond the map
        graph.set_obstacles(points)
        rebuilt = FreeSpaceGraph(graph.free, RADIUS)
        rebuilt.set_obstacles(points)
        distance = np.hypot(*(graph.grid.centres()[:, None] - points).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        exact = np.minimum(graph.free.clearance.ravel(), distance - (OBSTACLE_GAP_M - WALL_GAP_M))
        clearance = graph.clearance.ravel()
        relevant = exact < graph.min_clearance + WALL_COST_RANGE_M
        np.testing.assert_allclose(clearance[relevant], exact[relevant], rtol=0, atol=1e-12)
        assert (clearance[~relevant] >= graph.min_clearance + WALL_COST_RANGE_M).all()
        expected = cost_near_walls(exact, graph.min_clearance)
        np.testing.assert_allclose(graph.cost_per_metre.ravel(), expected, rtol=0, atol=1e-12)
        assert 1 <= expected.min() <= expected.max() <= 1 + 2 * MAX_WALL_COST
        assert (expected[~relevant] == 1).all()
        place = graph.grid.centres([graph.nearest_free(np.array([(x0 + x1) / 2, (y0 + y1) / 2]))])[0]
        assert np.array_equal(graph.cost_field(place).cost, rebuilt.cost_field(place).cost)


def test_path_keeps_away_from_a_wall(empty):
    path = empty.cost_field(np.array([9.0, 0.35])).path(np.array([1.0, 0.35]))
    assert path[len(path) // 2, 1] > 0.5
    assert path_length(path) < 8.3


def test_rooms_without_a_door():
    graph = FreeSpaceGraph(FreeSpace.of(room(10, 6, box(5, 3, 0.2, 6))), RADIUS)
    a, b = np.array([2.0, 3.0]), np.array([8.0, 3.0])
    left, right = (int(graph.component[graph.nearest_free(point)]) for point in (a, b))
    assert left != right
    assert not graph.cost_field(b).reaches(a)
    assert graph.grid.centres([graph.nearest_free(b, component=left)])[0][0] < 5


@given(x=st.floats(-2, 6), y=st.floats(-2, 5), within=st.floats(0, 2))
def test_cells_near_a_point(x, y, within):
    grid = Grid((-1.0, 0.5), 0.25, (12, 20))
    found = grid.cells_near(np.array([x, y]), within)
    near = np.flatnonzero(np.hypot(*(grid.centres() - [x, y]).T) <= within)
    assert set(near.tolist()) <= set(found.tolist())
    assert len(set(found.tolist())) == len(found) <= (2 * within / 0.25 + 2) ** 2
