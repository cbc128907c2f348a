"""Worlds converted to occupancy grids."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.rasterisation import rasterise
from common.geometry.world import Obstacle, World, load_world
from tests.common.geometry.maps import HUT, TURNED


def test_ros_map():
    world = World(name="map", grid=OccupancyGrid.of(HUT, 0.5, TURNED))
    assert rasterise(world) == world.grid  # keeps its cells
    at = world.grid.to_map(np.array([[2.75, 1.25]]))[0]  # column 5, row 2
    values = rasterise(world.with_obstacles([Obstacle(circle={"center": tuple(at), "radius": 0.01})])).values
    assert np.argwhere(values != HUT).tolist() == [[2, 5]]
    assert values[2, 5] == OCCUPIED


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
def test_polygons(name):
    """Cells away from edges agree with the world, and no free cell is next to an unknown one."""
    world = load_world(name)
    grid = rasterise(world)
    x0, y0, x1, y1 = world.bounds
    places = np.random.default_rng(0).uniform([x0 - 0.05, y0 - 0.05], [x1 + 0.05, y1 + 0.05], (2000, 2))
    clearance, values = world.clearance(places), grid.values_at(places)
    assert (values[clearance > grid.resolution] == FREE).all()
    assert (values[clearance < -grid.resolution] != FREE).all()
    for axis in (0, 1):
        for step in (1, -1):
            assert not ((grid.values == FREE) & (np.roll(grid.values, step, axis) == UNKNOWN)).any()


def test_thin_walls():
    thin = Obstacle(box={"center": (2.013, 1.0), "size": (0.004, 2.0)})
    values = rasterise(World(name="w", boundary=[(0, 0), (4, 0), (4, 2), (0, 2)], obstacles=[thin])).values
    inside = (values == FREE).any(axis=1)
    assert (values[inside, 30:-30] == OCCUPIED).any(axis=1).all()
