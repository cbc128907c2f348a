"""Obstacle stop alone: commands that ignore obstacles lead to no contact."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Twist
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from services.simulator.simulation import Setup, Simulation

SCANNER = SCANNERS["tim571"].with_beams(271)  # a third of the beams: faster, and harder for the obstacle stop
WORLDS = ("corridor", "maze", "office")
CASES = 7  # per world and drive
FORWARD = np.deg2rad(13)  # to either side; all that the front can touch is then within the scanner's 270 deg


@cache
def simulation(world: str, drive: str) -> Simulation:
    return Simulation(Setup(load_world(world), SCANNER, robot=Robot(drive=drive)))


def targets(world, rng, count):
    """Points (count, 2) m to drive at: corners and edges of walls and furniture, sides of circles."""
    edges = world.segments[rng.integers(0, len(world.segments), count)]
    share = np.where(rng.random(count) < 0.4, 0.0, rng.random(count))[:, None]
    points = edges[:, :2] * (1 - share) + edges[:, 2:] * share
    for number in np.flatnonzero(rng.random(count) < 0.15 * (len(world.circles) > 0)):
        x, y, radius = world.circles[rng.integers(len(world.circles))]
        angle = rng.uniform(-np.pi, np.pi)
        points[number] = x + radius * np.cos(angle), y + radius * np.sin(angle)
    return points


def starts(world, rng, count):
    """Free poses (count, 3) that look at a target 0.4 to 4 m away."""
    found = []
    while len(found) < count:
        target = targets(world, rng, 1)[0]
        away, yaw = rng.uniform(0.4, 4.0), rng.uniform(-np.pi, np.pi)
        place = target - away * np.array([np.cos(yaw), np.sin(yaw)])
        if float(world.clearance(place)[0]) >= Robot().radius + 0.02:
            found.append([*place, yaw + rng.normal(0, 0.05)])  # slightly past the target
    return np.array(found)


def drive_at(simulation, pose, twist, seconds=6.0):
    """Truths while a twist is commanded, from standstill at ``pose`` (3,) until the robot stands again."""
    simulation.teleport(pose)
    truths = []
    for number in range(int(seconds * 15)):
        simulation.command(simulation.stamp_ns, twist)
        simulation.advance()
        truths.append(simulation.observe()[1])
        if number > 15 and speed(truths[-1]) < 1e-3 and speed(truths[-2]) < 1e-3:
            break
    return truths


def speed(truth) -> float:
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


def touched(truths):
    return [truth for truth in truths if truth.contact]


@pytest.mark.parametrize("drive", ["holonomic", "differential"])
@pytest.mark.parametrize("world", WORLDS)
def test_no_contact_straight_at_obstacles_at_1_m_s(world, drive):
    run, rng = simulation(world, drive), np.random.default_rng([WORLDS.index(world), len(drive)])
    fastest, held = [], 0
    for pose in starts(run.world, rng, CASES):
        angle = rng.uniform(-FORWARD, FORWARD) if drive == "holonomic" else 0.0
        # The pose is turned by the same angle, so that the robot still drives at the target.
        truths = drive_at(run, pose - [0, 0, angle], Twist(vx=float(np.cos(angle)), vy=float(np.sin(angle))))
        assert not touched(truths), (pose, angle)
        fastest.append(max(map(speed, truths)))
        held += truths[-1].stopped
    assert np.median(fastest) > 0.6
    assert max(fastest) > 0.95
    assert held > CASES / 2


@pytest.mark.parametrize("drive", ["holonomic", "differential"])
@pytest.mark.parametrize("world", WORLDS)
def test_no_contact_in_curves_at_1_m_s(world, drive):
    run, rng = simulation(world, drive), np.random.default_rng([WORLDS.index(world), len(drive), 1])
    for pose in starts(run.world, rng, CASES // 2):
        truths = drive_at(run, pose, Twist(vx=1.0, wz=float(rng.uniform(-2, 2))), 3.0)
        assert not touched(truths), pose


def test_contact_without_the_obstacle_stop():
    """Shows that the tests above can fail."""
    run = Simulation(Setup(load_world("office"), SCANNER.with_beams(61), obstacle_stop=False))
    rng = np.random.default_rng(0)
    hit = sum(bool(touched(drive_at(run, pose, Twist(vx=1.0)))) for pose in starts(run.world, rng, 10))
    run.close()
    assert hit > 5


def test_scanner_sees_the_front_of_the_body():
    """The front of the body, ``FORWARD`` to either side, is within the field of view."""
    front = np.deg2rad(90) + FORWARD
    at_edge = Robot().radius * np.array([np.cos(front), np.sin(front)])
    bearing = np.arctan2(at_edge[1] - SCANNER.mount[1], at_edge[0] - SCANNER.mount[0])
    assert float(se2.wrap(bearing)) < -SCANNER.angle_min
