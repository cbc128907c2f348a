"""Robots other than the default: radius and limits decide where they drive, and how fast."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from common.geometry.world import Obstacle, World
from common.messages.definitions import CmdVel, Twist
from common.robot.base import Robot
from common.robot.self_filter import SelfFilter
from services.bridge_ros2.command_gate import CommandGate
from services.controller.policies.planner import GeodesicPolicy
from services.simulator.simulation import Setup, Simulation
from tests.controller.policies.test_planner import SCANNER, drive

BURGER = Robot(drive="differential", radius=0.105, max_speed=0.22, max_turn=2.84, acceleration=0.5, turn_acceleration=3)
HEAVY = Robot(drive="differential", radius=0.4, max_speed=0.6, max_turn=0.8, acceleration=0.4, turn_acceleration=0.6)
CENTRED = SCANNER.model_copy(update={"mount": (0.0, 0.0, 0.0)})


def two_rooms(gap):
    """A wall across, with a door of ``gap`` m in the middle."""
    side = (3 - gap) / 2
    walls = [Obstacle(box={"center": (3.0, y), "size": (0.2, side)}) for y in (side / 2, 3 - side / 2)]
    return World(name="two", boundary=[(0, 0), (6, 0), (6, 3), (0, 3)], obstacles=walls)


@pytest.mark.parametrize(("robot", "gap"), [(BURGER, 0.45), (HEAVY, 1.3)])
def test_drives_through_a_fitting_door_within_its_limits(robot, gap):
    world = two_rooms(gap)
    poses, statuses, contacts = drive(world, robot, (1.0, 1.5, 2.0), (5.0, 1.5), 900, scanner=CENTRED)
    assert statuses[-1].state == "reached", statuses[-1]
    assert not contacts
    assert world.clearance(poses[:, :2]).min() >= robot.radius
    steps = np.array([b - a for a, b in itertools.pairwise(poses)])
    speed = np.hypot(*steps[:, :2].T) * 15
    assert 0.8 * robot.max_speed < speed.max() <= robot.max_speed * 1.02
    turn = np.abs((steps[:, 2] + np.pi) % (2 * np.pi) - np.pi) * 15
    assert turn.max() <= robot.max_turn * 1.02
    assert np.abs(np.diff(speed)).max() * 15 <= robot.acceleration * 1.1


def test_door_fits_a_small_robot_only():
    world, goal = two_rooms(0.45), np.array([5.0, 1.5])
    for robot, fits in ((BURGER, True), (Robot(), False)):
        policy = GeodesicPolicy(robot, world)
        graph = policy.graph
        here, there = (graph.nearest_free(np.array(at)) for at in ((1.0, 1.5), goal))
        assert (graph.component[here] == graph.component[there]) is np.bool_(fits)


# Parts of the robot in deg and m; the last is closer than the scanner's minimum range.
POSTS = ((25, 0.12), (-110, 0.15), (110, 0.02))


def with_posts(scan):
    """The scan, with three posts of the robot itself in it, each 4 degrees wide."""
    ranges = scan.ranges.copy()
    for at, away in POSTS:
        beams = np.abs(np.rad2deg(scan.angles()) - at) <= 2
        ranges[beams] = away if away > scan.range_min else -np.inf
    return scan.model_copy(update={"ranges": ranges})


@pytest.mark.parametrize(
    "self_filter", [SelfFilter(tuple(tuple(np.deg2rad([at - 3, at + 3])) for at, _ in POSTS)), SelfFilter(radius=0.2)]
)
@pytest.mark.parametrize("kind", ["holonomic", "differential"])
def test_robot_in_its_own_scan_drives_with_a_self_filter(kind, self_filter):
    """It also still sees and avoids the box. Without a self filter the robot does not move."""
    world = World(name="hall", boundary=[(0, 0), (8, 0), (8, 4), (0, 4)])
    box = Obstacle(name="box", circle={"center": (4.0, 2.0), "radius": 0.3})
    robot, found = Robot(drive=kind), world.with_obstacles([box])

    def run(limit, seen):
        return drive(found, robot, (1.0, 2.0, 0.0), (7.0, 2.0), limit, known=world, seen=seen, stop=False)

    _, statuses, contacts = run(600, lambda scan: self_filter.mask_for_planning(with_posts(scan)))
    assert statuses[-1].state == "reached", statuses[-1]
    assert not contacts
    poses, statuses, _ = run(150, with_posts)
    assert statuses[-1].state != "reached"
    assert np.hypot(*(poses[-1] - poses[0])[:2]) < 0.5


def test_obstacle_stop_of_the_bridge_with_a_self_filter():
    world, robot = World(name="hall", boundary=[(0, 0), (8, 0), (8, 4), (0, 4)]), Robot()
    simulation = Simulation(Setup(world, SCANNER, robot, (1.0, 2.0, 0.0)))
    scan = with_posts(simulation.observe()[2])
    simulation.close()
    command, self_filter, outputs = CmdVel(stamp_ns=scan.stamp_ns, twist=Twist(vx=0.3)), SelfFilter(radius=0.2), []
    for shown in (scan, self_filter.mask_for_bus(scan), self_filter.mask_for_planning(scan)):
        gate = CommandGate(robot)
        gate.add_scan(shown, 0.0)
        outputs.append(gate.command(command, 0.01))
    assert outputs[0] is None or not outputs[0].any()
    assert outputs[1][0] > 0
    assert outputs[2][0] > 0
