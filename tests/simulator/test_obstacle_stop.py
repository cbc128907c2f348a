"""Obstacle stop alone: commands that ignore obstacles lead to no contact."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.messages.definitions import Twist
from common.robot.robot import Robot
from tests.simulator.driving import FORWARD, SCANNER, contacts, drive, speed

CASES = {"corridor": "holonomic", "maze": "differential", "office": "holonomic"}
POSES = 6  # in each world
FRONT = np.deg2rad(13)  # to either side; all that the front can touch is then within the scanner's 270 deg


def starts(world, rng, count):
    """Free poses (count, 3) that look at a corner or edge of a wall or furniture 0.4 to 4 m away."""
    found = []
    while len(found) < count:
        edge = world.segments[rng.integers(0, len(world.segments))]
        share = 0.0 if rng.random() < 0.4 else rng.random()
        target = edge[:2] * (1 - share) + edge[2:] * share
        if len(world.circles) and rng.random() < 0.15:
            x, y, radius = world.circles[rng.integers(len(world.circles))]
            target = np.array([x, y]) + se2.rotate(rng.uniform(-np.pi, np.pi), [radius, 0])
        yaw = rng.uniform(-np.pi, np.pi)
        place = target - se2.rotate(yaw, [rng.uniform(0.4, 4.0), 0])
        if world.has_room(place, Robot().radius + 0.02):
            found.append([*place, yaw + rng.normal(0, 0.05)])  # slightly past the target
    return np.array(found)


def drive_at(simulation, pose, twist):
    """Truths while a twist is commanded, from standstill at ``pose`` (3,) until the robot stands again."""
    simulation.teleport(pose)
    truths = drive(simulation, twist, 1)
    while max(map(speed, truths[-2:])) > 1e-3 and len(truths) < 90:
        truths += drive(simulation, twist, 1 / 15)
    return truths


@pytest.mark.parametrize("world", CASES)
def test_no_contact_at_1_m_s(make, world):
    simulation, rng = make(world, robot=Robot(drive=CASES[world])), np.random.default_rng(len(world))
    fastest, stopped = [], 0
    for pose in starts(simulation.world, rng, POSES):
        angle = rng.uniform(-FRONT, FRONT) if CASES[world] == "holonomic" else 0.0
        # The pose is turned by the same angle, so that the robot still drives at the target.
        truths = drive_at(simulation, pose - [0, 0, angle], Twist(vx=float(np.cos(angle)), vy=float(np.sin(angle))))
        assert not contacts(truths), (pose, angle)
        fastest.append(max(map(speed, truths)))
        stopped += truths[-1].stopped
        simulation.teleport(pose)
        assert not contacts(drive(simulation, Twist(vx=1.0, wz=float(rng.uniform(-2, 2))), 2)), pose
    assert max(fastest) > 0.9
    assert stopped > POSES / 2


@pytest.mark.parametrize("latency", [0.1, 0.3])
def test_late_commands(make, latency):
    simulation = make("corridor", robot=Robot(latency=latency))
    simulation.teleport(np.array([14.5, 1.5, 0.0]))
    truths = drive(simulation, FORWARD, 6.0)
    assert not contacts(truths)
    assert max(map(speed, truths)) > 0.9
    assert speed(truths[-1]) < 0.05


def test_random_commands_among_furniture(make):
    simulation, rng = make("office"), np.random.default_rng(0)
    for _ in range(15):
        # Mostly into the field of view: forward and sideways.
        twist = Twist(vx=abs(rng.uniform(-0.7, 0.7)), vy=rng.uniform(-0.7, 0.7))
        assert not contacts(drive(simulation, twist, 1.0) + drive(simulation, Twist(wz=2.0), 0.5))


def test_contact_without_the_obstacle_stop(make):
    """Shows that the tests above can fail."""
    simulation = make("office", SCANNER.with_beams(61), obstacle_stop=False)
    poses = starts(simulation.world, np.random.default_rng(0), 6)
    assert sum(bool(contacts(drive_at(simulation, pose, FORWARD))) for pose in poses) > 3


def test_scanner_sees_the_front_of_the_body():
    """The front of the body, ``FRONT`` to either side, is within the field of view."""
    at_edge = se2.rotate(np.deg2rad(90) + FRONT, [Robot().radius, 0])
    bearing = np.arctan2(at_edge[1] - SCANNER.mount[1], at_edge[0] - SCANNER.mount[0])
    assert float(se2.wrap(bearing)) < -SCANNER.angle_min
