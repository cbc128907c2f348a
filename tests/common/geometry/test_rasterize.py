"""Worlds converted to occupancy grids."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.rasterize import rasterise
from common.geometry.world import Obstacle, World, load_world
from tests.common.geometry.maps import values_of

PLAN = values_of("""
#####
#..?#
#...#
#####
""")


def of_map(**rest):
    return World(name="map", grid=OccupancyGrid.of(PLAN, 0.5, (1.0, -2.0, 0.3)), **rest)


def test_a_ros_map_keeps_its_cells():
    assert rasterise(of_map()) is not None
    assert rasterise(of_map()) == of_map().grid


def test_obstacles_are_added_to_a_ros_map():
    grid = of_map().grid
    at = grid.to_map(np.array([[1.25, 0.75]]))[0]  # the third cell of the second row from below
    box = Obstacle(circle={"center": tuple(at), "radius": 0.01})
    values = rasterise(of_map(obstacles=[box])).values
    changed = values != PLAN
    assert np.argwhere(changed).tolist() == [[1, 2]]
    assert values[1, 2] == OCCUPIED


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
def test_polygons_become_free_cells_with_walls(name):
    """Cells away from edges agree with the world, and no free cell is next to an unknown one."""
    world = load_world(name)
    grid = rasterise(world)
    rng = np.random.default_rng(0)
    x0, y0, x1, y1 = world.bounds
    places = rng.uniform([x0 - 0.05, y0 - 0.05], [x1 + 0.05, y1 + 0.05], (2000, 2))
    clearance = world.clearance(places)
    said = grid.at(places)
    assert (said[clearance > grid.resolution] == FREE).all()
    assert (said[clearance < -grid.resolution] != FREE).all()
    values = grid.values
    for along in (0, 1):
        for step in (1, -1):
            beside = np.roll(values, step, axis=along)
            assert not ((values == FREE) & (beside == UNKNOWN)).any()


def test_thin_walls_are_not_lost():
    thin = Obstacle(box={"center": (2.013, 1.0), "size": (0.004, 2.0)})
    values = rasterise(World(name="w", boundary=[(0, 0), (4, 0), (4, 2), (0, 2)], obstacles=[thin])).values
    inside = (values == FREE).any(axis=1)
    middle = values[:, 30:-30]
    assert (middle[inside] == OCCUPIED).any(axis=1).all()
