"""Navigation on a ROS map: free space from its cells, paths through doors, refused goals."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.occupancy_grid import FREE, UNKNOWN, OccupancyGrid
from common.geometry.world import World
from common.robot.base import Robot
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.planner import GeodesicPolicy
from services.controller.policies.straight_line import StraightLinePolicy
from tests.common.geometry.maps import rooms

WORLD = World(name="rooms", grid=OccupancyGrid.of(rooms(400), 0.05, (-10.0, -10.0, 0.0)))


@pytest.mark.parametrize("origin", [(-10.0, -10.0, 0.0), (3.0, 1.0, 0.5)])
def test_free_space_matches_the_cells(origin):
    world = World(name="rooms", grid=OccupancyGrid.of(rooms(200), 0.05, origin))
    free = FreeSpace.of(world)
    centres = free.grid.centres()
    inner = np.abs(free.clearance.ravel()) > 1e-6  # exactly at an edge the sign is undefined
    assert np.array_equal((free.clearance.ravel() > 0)[inner], (world.grid.values_at(centres) == FREE)[inner])
    np.testing.assert_allclose(free.clearance.ravel(), world.clearance(centres), atol=1e-9)


def test_path_between_rooms_keeps_clear_of_cells():
    policy = GeodesicPolicy(Robot(), WORLD)
    start, goal = np.array([-6.5, -6.5]), np.array([5.0, 5.0])
    start, goal = (policy.free.grid.centres([policy.graph.nearest_free(place)])[0] for place in (start, goal))
    assert policy.refusal(goal) is None
    field = policy.graph.cost_field(goal)
    path = field.path(start)
    assert len(path) > 20
    between = np.linspace(path[:-1], path[1:], 5).reshape(-1, 2)
    assert WORLD.clearance(between).min() > Robot().radius - 0.01


def test_goals_in_unknown_or_occupied_cells_are_refused():
    row, column = np.argwhere(WORLD.grid.values == UNKNOWN)[0]
    unknown = WORLD.grid.shapes.points_in_cells(np.array([[column, row]]), 0.5)[0]
    policy, straight_line = GeodesicPolicy(Robot(), WORLD), StraightLinePolicy(Robot(), None, WORLD)
    for goal in (unknown, np.array([50.0, 50.0])):
        assert "is inside something, or off the map; the nearest place that can be reached is" in policy.refusal(goal)
        assert "is inside something" in straight_line.refusal(goal)


def test_map_of_one_cell():
    world = World(name="dot", grid=OccupancyGrid.of(np.array([[FREE]], np.uint8), 0.05, (0.0, 0.0, 0.0)))
    policy = GeodesicPolicy(Robot(), world)
    assert "goal refused" in policy.refusal(np.array([0.02, 0.02]))
    assert policy.graph.cost_field(np.array([0.02, 0.02])) is None
