"""Robots that are not the shipped one: their own radius and limits decide where they go, and how fast."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from common.robot import Robot
from common.world import Obstacle, World
from services.controller.pilot import Pilot
from tests.controller.test_pilot import SCANNER, drive

BURGER = Robot(drive="differential", radius=0.105, max_speed=0.22, max_turn=2.84, acceleration=0.5, turn_acceleration=3)
HEAVY = Robot(drive="differential", radius=0.4, max_speed=0.6, max_turn=0.8, acceleration=0.4, turn_acceleration=0.6)
CENTRED = SCANNER.model_copy(update={"mount": (0.0, 0.0, 0.0)})


def two_rooms(gap):
    """A wall across, with a door of ``gap`` m in the middle."""
    side = (3 - gap) / 2
    walls = [Obstacle(box={"center": (3.0, y), "size": (0.2, side)}) for y in (side / 2, 3 - side / 2)]
    return World(name="two", boundary=[(0, 0), (6, 0), (6, 3), (0, 3)], obstacles=walls)


@pytest.mark.parametrize(("robot", "gap"), [(BURGER, 0.45), (HEAVY, 1.3)])
def test_each_goes_through_its_own_door_within_its_own_limits(robot, gap):
    world = two_rooms(gap)
    poses, said, contacts = drive(world, robot, (1.0, 1.5, 2.0), (5.0, 1.5), 900, scanner=CENTRED)
    assert said[-1].state == "reached", said[-1]
    assert not contacts
    assert world.clearance(poses[:, :2]).min() >= robot.radius
    steps = np.array([b - a for a, b in itertools.pairwise(poses)])
    speed = np.hypot(*steps[:, :2].T) * 15
    assert 0.8 * robot.max_speed < speed.max() <= robot.max_speed * 1.02
    turn = np.abs((steps[:, 2] + np.pi) % (2 * np.pi) - np.pi) * 15
    assert turn.max() <= robot.max_turn * 1.02
    assert np.abs(np.diff(speed)).max() * 15 <= robot.acceleration * 1.1


def test_a_door_too_narrow_for_one_is_not_for_another():
    world, goal = two_rooms(0.45), np.array([5.0, 1.5])
    for robot, fits in ((BURGER, True), (Robot(), False)):
        pilot = Pilot(robot, world)
        roads = pilot.roads
        here, there = (roads.nearest_free(np.array(at)) for at in ((1.0, 1.5), goal))
        assert (roads.component[here] == roads.component[there]) is np.bool_(fits)
