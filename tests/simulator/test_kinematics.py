"""The kinematic simulation against pybullet's: scans, free drives, and contacts."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.shapes import Circle, Obstacle
from common.geometry.world import load_world
from common.messages.definitions import Twist
from common.robot.scanner import SCANNERS
from services.simulator import physics
from services.simulator.simulation import Simulation, SimulationSetup

SCANNER = SCANNERS["tim571"].model_copy(update={"sigma": 0.0, "sigma_relative": 0.0})


def simulations(world="office", **setup):
    return [
        Simulation(SimulationSetup(load_world(world), SCANNER, obstacle_stop=False, engine=engine, **setup))
        for engine in ("pybullet", "kinematic")
    ]


def drive(simulation, twists):
    poses, contacts = [], 0
    for twist in twists:
        simulation.command(simulation.stamp_ns, Twist(vx=twist[0], vy=twist[1], wz=twist[2]))
        simulation.advance()
        _, truth, _ = simulation.observe()
        poses.append(truth.pose.array())
        contacts += truth.contact
    return np.array(poses), contacts


@pytest.mark.parametrize("world", ["corridor", "office", "maze"])
def test_scans(world):
    """Within 1 mm, except for beams that pass a corner."""
    both = simulations(world)
    rng = np.random.default_rng(1)
    poses = np.column_stack([both[0].world.sample_free(40, rng, 0.3), rng.uniform(-np.pi, np.pi, 40)])
    found, expected = (simulation.sample(poses, 400, None) for simulation in both)
    same = np.isclose(found, expected, atol=1e-3)
    assert same.mean() > 0.999


def test_people_in_scans():
    both = simulations(people=5)
    for simulation in both:
        simulation.physics.move_people(np.array([[3.0 + k, 4.0] for k in range(5)]))
    ranges = [s._cast_rays(np.array([[5.0, 3.0, 1.5]]))[0] for s in both]
    assert np.isclose(*ranges, atol=1e-3).mean() > 0.99
    without = both[1]._cast_rays(np.array([[5.0, 3.0, 1.5]]), people=False)[0]
    assert (without > ranges[1] + 0.1).sum() > 10


def test_free_drives():
    """Trajectories without contact: within 0.01 mm and 0.001 deg."""
    rng = np.random.default_rng(4)
    twists = np.repeat(rng.uniform([-0.3, -0.3, -1.0], [0.3, 0.3, 1.0], (8, 3)), 20, axis=0)
    (expected, touched), (found, touched_too) = (drive(s, twists) for s in simulations())
    assert not touched
    assert not touched_too
    off = se2.between(expected, found)
    assert np.hypot(*np.diff(expected[:, :2], axis=0).T).sum() > 1  # m
    assert np.hypot(off[:, 0], off[:, 1]).max() < 1e-5
    assert np.abs(off[:, 2]).max() < np.deg2rad(1e-3)


def test_contact_stops_the_robot():
    (hit, touched), (stopped, touched_too) = (drive(s, [(0.8, 0.0, 0.0)] * 120) for s in simulations("corridor"))
    assert touched
    assert touched_too
    assert np.hypot(*(hit[-1] - stopped[-1])[:2]) < 0.05
    assert load_world("corridor").clearance(stopped[-1, :2])[0] >= 0.27 - 1e-9
    robot = simulations("corridor")[1]
    drive(robot, [(0.8, 0.0, 0.0)] * 120)
    away, _ = drive(robot, [(-0.5, 0.0, 0.5)] * 45)
    assert np.hypot(*(away[-1] - stopped[-1])[:2]) > 0.2  # it is not stuck


def test_furniture_comes_and_goes():
    simulation = simulations("corridor")[1]
    before = simulation._cast_rays(simulation.physics.pose()[None])[0]
    simulation.change_obstacle("add", "post", Obstacle(circle=Circle(center=(3.0, 2.4), radius=0.2)))
    assert (simulation._cast_rays(simulation.physics.pose()[None])[0] < before - 0.1).any()
    simulation.change_obstacle("remove", "post", None)
    np.testing.assert_array_equal(simulation._cast_rays(simulation.physics.pose()[None])[0], before)


def test_choice_of_the_engine(monkeypatch):
    assert physics.choose_engine("auto") == "pybullet"
    monkeypatch.setattr(physics, "find_spec", lambda name: None)
    assert physics.choose_engine("auto") == physics.choose_engine("kinematic") == "kinematic"
    with pytest.raises(UserError, match="pybullet is not installed"):
        physics.choose_engine("pybullet")
