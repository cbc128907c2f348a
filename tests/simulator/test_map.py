"""A ROS map in the simulator: rays, contacts, refused poses, furniture."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.world import Obstacle, World
from common.messages.definitions import Twist
from common.robot.scanner import SCANNERS
from services.simulator import physics
from services.simulator.simulation import Setup, Simulation
from tests.common.geometry.maps import rooms

SCANNER = SCANNERS["tim571"]
ORIGIN = (-3.0, 2.0, 0.4)


@pytest.fixture(scope="module")
def world():
    return World(name="rooms", grid=OccupancyGrid.of(rooms(260), 0.05, ORIGIN))


@pytest.fixture
def simulation(world):
    made = Simulation(Setup(world, SCANNER, people=2, obstacle_stop=False))
    yield made
    made.close()


def test_rays_match_exact_ranges_to_a_millimetre(world, simulation, monkeypatch):
    monkeypatch.setattr(physics, "MAX_WALLS_PER_BODY", 200)  # so that the map is split into several bodies
    rng = np.random.default_rng(0)
    poses = np.column_stack([world.sample_free(40, rng, 0.27), rng.uniform(-np.pi, np.pi, 40)])
    lasers = se2.compose(poses, np.array(SCANNER.mount))
    exact = SCANNER.limit(world.ray_distances(lasers, SCANNER.angles()))
    split = Simulation(Setup(world, SCANNER))
    for made in (simulation, split):
        seen = made.sample(poses, None, None)
        wrong = ~np.isclose(seen, exact, atol=1e-3)
        assert wrong.mean() < 3e-4  # beams that pass within a millimetre of a cell's edge
        assert np.median(np.abs(seen - exact)[np.isfinite(exact)]) < 1e-5
    split.close()


def test_cells_stop_the_robot(world, simulation):
    wall = int(np.argmax(simulation._cast_rays(simulation.physics.pose()[None], SCANNER, people=False)[0] < 2.5))
    heading = float(SCANNER.angles()[wall])
    turned = np.array([*simulation.physics.pose()[:2], heading])
    simulation.physics.place(turned)
    for _ in range(60):
        simulation.command(simulation.stamp_ns, Twist(vx=0.8))
        simulation.advance()
        if simulation.observe()[1].contact:
            break
    assert simulation.observe()[1].contact
    assert 0.2 < world.clearance(simulation.physics.pose()[:2])[0] < 0.3  # a body of 0.25 m


def test_poses_in_occupied_or_unknown_cells_are_refused(world, simulation):
    for kind in (OCCUPIED, UNKNOWN):
        row, column = np.argwhere(world.grid.values == kind)[7]
        x, y = world.grid.shapes.points_in_cells(np.array([[column, row]]), 0.5)[0]
        with pytest.raises(UserError, match="inside a wall or outside"):
            simulation.teleport(np.array([x, y, 0.0]))
        with pytest.raises(UserError, match="inside a wall or outside"):
            simulation.sample(np.array([[x, y, 0.0]]), 10, None)


def test_furniture_on_a_map(world, simulation):
    here = simulation.physics.pose()
    before = simulation._cast_rays(here[None], people=False)[0]
    place = here[:2] + 0.6 * np.array([np.cos(here[2]), np.sin(here[2])])
    simulation.change_obstacle("add", "crate", Obstacle(circle={"center": tuple(place.tolist()), "radius": 0.1}))
    assert simulation.world.grid is world.grid
    ahead = len(before) // 2
    assert simulation._cast_rays(here[None], people=False)[0][ahead] == pytest.approx(
        0.3, abs=1e-3
    )  # the laser is 0.2 m ahead
    assert simulation.world.clearance(place)[0] < 0
    simulation.change_obstacle("remove", "crate", None)
    assert np.array_equal(simulation._cast_rays(here[None], people=False)[0], before)
