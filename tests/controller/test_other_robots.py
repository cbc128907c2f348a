"""Robots other than the default: radius and limits decide where they drive, and how fast."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from common.messages.definitions import CmdVel, Twist
from common.robot.robot import Robot
from common.robot.self_filter import SelfFilter
from services.bridge_ros2.command_gate import CommandGate
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.simulator.simulation import Simulation, SimulationSetup
from tests.controller.driving import KINDS, SCANNER, box, drive, goal, room

BURGER = Robot(drive="differential", radius=0.105, max_speed=0.22, max_turn=2.84, acceleration=0.5, turn_acceleration=3)
HEAVY = Robot(drive="differential", radius=0.4, max_speed=0.6, max_turn=0.8, acceleration=0.4, turn_acceleration=0.6)
CENTRED = SCANNER.model_copy(update={"mount": (0.0, 0.0, 0.0)})
HALL = room(6, 4)
# Parts of the robot in deg and m; the last is closer than the scanner's minimum range.
POSTS = ((25, 0.12), (-110, 0.15), (110, 0.02))
FILTERS = SelfFilter(tuple(tuple(np.deg2rad([at - 3, at + 3])) for at, _ in POSTS)), SelfFilter(radius=0.2)
STANDING = np.zeros(3)


def two_rooms(gap):
    """A wall across, with a door of ``gap`` m in the middle."""
    side = (3 - gap) / 2
    return room(6, 3, box(3.0, side / 2, 0.2, side, "a"), box(3.0, 3 - side / 2, 0.2, side, "b"))


@pytest.mark.parametrize(("robot", "gap"), [(BURGER, 0.45), (HEAVY, 1.3)], ids=["burger", "heavy"])
def test_fitting_door(robot, gap):
    world = two_rooms(gap)
    poses, statuses, contacts = drive(world, robot, (2.0, 1.5, 1.0), goal(4.2, 1.5), 400, scanner=CENTRED)
    assert (statuses[-1].state, contacts) == ("reached", 0), statuses[-1]
    assert world.clearance(poses[:, :2]).min() >= robot.radius
    steps = np.diff(poses, axis=0)
    speed = np.hypot(*steps[:, :2].T) * 15
    assert 0.8 * robot.max_speed < speed.max() <= robot.max_speed * 1.02
    turn = np.abs((steps[:, 2] + np.pi) % (2 * np.pi) - np.pi) * 15
    assert turn.max() <= robot.max_turn * 1.02
    assert np.abs(np.diff(speed)).max() * 15 <= robot.acceleration * 1.1


def test_door_fits_a_small_robot_only():
    free = FreeSpace.of(two_rooms(0.45))
    for robot, fits in ((BURGER, True), (Robot(), False)):
        graph = FreeSpaceGraph(free, robot.radius)
        here, there = (graph.nearest_free(np.array(place)) for place in ((1.0, 1.5), (5.0, 1.5)))
        assert (graph.component[here] == graph.component[there]) == fits


def with_posts(scan):
    """The scan, with three posts of the robot itself in it, each 4 degrees wide."""
    ranges = scan.ranges.copy()
    for bearing, distance in POSTS:
        beams = np.abs(np.rad2deg(scan.angles()) - bearing) <= 2
        ranges[beams] = distance if distance > scan.range_min else -np.inf
    return scan.model_copy(update={"ranges": ranges})


@pytest.mark.parametrize(("kind", "self_filter"), list(zip(KINDS, FILTERS, strict=True)))
def test_robot_in_its_own_scan(kind, self_filter):
    """It also still sees and avoids the box. Without a self filter the robot does not move."""
    robot, found = Robot(drive=kind), room(6, 4, box(3.0, 2.0, 0.5, 0.5))

    def run(limit, seen):
        return drive(found, robot, (1.0, 2.0, 0.0), goal(5.0, 2.0), limit, known=HALL, seen=seen, stop=False)

    _, statuses, contacts = run(400, lambda scan: self_filter.correct_and_mask(with_posts(scan), STANDING))
    assert (statuses[-1].state, contacts) == ("reached", 0), statuses[-1]
    poses, statuses, _ = run(60, with_posts)
    assert statuses[-1].state != "reached"
    assert np.hypot(*(poses[-1] - poses[0])[:2]) < 0.5


def test_obstacle_stop_of_the_bridge():
    with closing(Simulation(SimulationSetup(HALL, SCANNER, Robot(), (1.0, 2.0, 0.0)))) as simulation:
        scan = with_posts(simulation.observe()[2])
    command, self_filter, outputs = CmdVel(stamp_ns=scan.stamp_ns, twist=Twist(vx=0.3)), SelfFilter(radius=0.2), []
    for shown in (scan, self_filter.mask_for_bus(scan), self_filter.correct_and_mask(scan, STANDING)):
        gate = CommandGate(Robot())
        gate.add_scan(shown, 0.0)
        outputs.append(gate.command(command, 0.01))
    assert outputs[0] is None or not outputs[0].any()
    assert outputs[1][0] > 0
    assert outputs[2][0] > 0
