"""Ranges from pybullet against the exact ray caster over the same world; a ROS map as the world."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.world import Obstacle, World, known_worlds
from common.robot.scanner import SCANNERS
from services.simulator import pybullet_physics
from services.simulator.simulation import Simulation, SimulationSetup
from tests.common.geometry.maps import rooms
from tests.simulator.driving import FORWARD, drive, shipped

SCANNER = SCANNERS["tim571"]
MM = 1e-3


@functools.cache
def simulation_of(name: str) -> Simulation:
    return Simulation(SimulationSetup(shipped(name), SCANNER))


@pytest.fixture(scope="module")
def rooms_map():
    return World(name="rooms", grid=OccupancyGrid.of(rooms(260), 0.05, (-3.0, 2.0, 0.4)))


def exact_ranges(world, poses, angles=None):
    lasers = se2.compose(np.atleast_2d(poses), np.array(SCANNER.mount))
    return world.ray_distances(lasers, SCANNER.angles() if angles is None else angles)


@pytest.mark.parametrize("name", known_worlds())
@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_ranges_match_to_a_millimetre(name, seed):
    """Where a beam grazes an edge, the range of any beam within 1 mm of it is a correct result."""
    world, rng = shipped(name), np.random.default_rng(seed)
    poses = np.column_stack([world.sample_free(2, rng, 0.27), rng.uniform(-np.pi, np.pi, 2)])
    seen, exact = simulation_of(name).sample(poses, None, None), exact_ranges(world, poses)
    off = np.abs(seen - exact) > MM
    for row, beam in np.argwhere(off):
        sideways = MM / min(seen[row, beam], exact[row, beam])
        near = exact_ranges(world, poses[row], SCANNER.angles()[beam] + np.linspace(-sideways, sideways, 41))
        assert near.min() - MM <= seen[row, beam] <= near.max() + MM, (poses[row], beam)
    assert off.mean() < 0.01  # few beams graze an edge


def test_range_limits(make):
    pose = np.array([[3.0, 1.5, 0.0]])
    short = SCANNER.model_copy(update={"range_max": 3.0, "range_min": 1.0, "sigma": 0.0})
    exact, seen = exact_ranges(shipped("corridor"), pose), make("corridor", short).sample(pose, None, None)
    assert np.isposinf(seen[exact > 3.001]).all()
    assert np.isneginf(seen[exact < 0.999]).all()
    assert np.isfinite(seen[(exact > 1.001) & (exact < 2.999)]).all()


def test_noise_of_the_scanner():
    pose = np.tile([[3.0, 1.5, 1.0]], (20, 1))
    clean, a, b, c = (simulation_of("corridor").sample(pose, 622, seed) for seed in (None, 1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert np.std(a - clean) == pytest.approx(SCANNER.sigma, rel=0.02)
    assert abs(np.mean(a - clean)) < 0.001


def test_sample_inside_a_wall_is_refused():
    with pytest.raises(UserError, match=r"1 of 2 poses .* such as \(6\.80, 3\.95\)"):
        simulation_of("corridor").sample(np.array([[3.0, 1.5, 0.0], [6.8, 3.95, 0.0]]), None, None)


def test_sample_does_not_disturb_the_run(make):
    plain, disturbed = (make("corridor", seed=5) for _ in range(2))
    for _ in range(3):
        disturbed.sample(np.array([[9.0, 1.0, 0.0]]), None, 3)
        assert plain.observe() == disturbed.observe()
        plain.advance()
        disturbed.advance()


@pytest.mark.parametrize("walls_per_body", [200, pybullet_physics.MAX_WALLS_PER_BODY])
def test_map_rays_match_to_a_millimetre(make, rooms_map, monkeypatch, walls_per_body):
    monkeypatch.setattr(
        pybullet_physics, "MAX_WALLS_PER_BODY", walls_per_body
    )  # 200 splits the map into several bodies
    rng = np.random.default_rng(0)
    poses = np.column_stack([rooms_map.sample_free(40, rng, 0.27), rng.uniform(-np.pi, np.pi, 40)])
    exact, seen = SCANNER.limit(exact_ranges(rooms_map, poses)), make(rooms_map, SCANNER).sample(poses, None, None)
    assert (~np.isclose(seen, exact, atol=MM)).mean() < 3e-4  # beams that pass within a millimetre of a cell's edge
    assert np.median(np.abs(seen - exact)[np.isfinite(exact)]) < 1e-5


def test_map_stops_the_robot(make, rooms_map):
    simulation = make(rooms_map, SCANNER, obstacle_stop=False)
    here = simulation.physics.pose()
    beam = int(np.argmax(exact_ranges(rooms_map, here)[0] < 2.5))
    simulation.physics.place(np.array([*here[:2], here[2] + SCANNER.angles()[beam]]))
    assert drive(simulation, FORWARD, 4)[-1].contact
    assert 0.2 < rooms_map.clearance(simulation.physics.pose()[:2])[0] < 0.3  # a body of 0.27 m


@pytest.mark.parametrize("kind", [OCCUPIED, UNKNOWN])
def test_occupied_map_cells(make, rooms_map, kind):
    simulation = make(rooms_map)
    row, column = np.argwhere(rooms_map.grid.values == kind)[7]
    place = np.array([*rooms_map.grid.geometry.points_in_cells(np.array([[column, row]]), 0.5)[0], 0.0])
    with pytest.raises(UserError, match="is inside something, or off the map"):
        simulation.teleport(place)
    with pytest.raises(UserError, match="inside a wall or outside"):
        simulation.sample(place[None], 10, None)


def test_furniture_on_a_map(make, rooms_map):
    simulation = make(rooms_map, SCANNER)
    here = simulation.physics.pose()
    before = simulation.sample(here[None], None, None)[0]
    place = se2.compose(here, np.array([0.6, 0.0, 0.0]))[:2]
    simulation.change_obstacle("add", "crate", Obstacle(circle={"center": tuple(place.tolist()), "radius": 0.1}))
    assert simulation.world.grid is rooms_map.grid
    ahead = simulation.sample(here[None], None, None)[0][len(before) // 2]
    assert ahead == pytest.approx(0.3, abs=1e-3)  # the laser is 0.2 m ahead
    simulation.change_obstacle("remove", "crate", None)
    assert np.array_equal(simulation.sample(here[None], None, None)[0], before)
