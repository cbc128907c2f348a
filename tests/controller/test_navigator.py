"""The navigator: goals, limits and statuses."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from common.messages.definitions import Belief, Goal, Pose, Scan
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from services.controller.navigator import Navigator

ROOM = World(name="room", boundary=[(0, 0), (10, 0), (10, 4), (0, 4)])
SCANNER = SCANNERS["tim571"].with_beams(181)
PERIOD_NS = 66_666_667


def belief(stamp_ns, pose, state="tracking") -> Belief:
    return Belief(stamp_ns=stamp_ns, state=state, pose=Pose.of(pose), xi=np.zeros(3), free_energy=0.0, accuracy=0.0)


def scan(stamp_ns, pose, world=ROOM) -> Scan:
    ranges = world.ray_distances(se2.compose(pose, SCANNER.mount)[None], SCANNER.angles())[0]
    return Scan(
        stamp_ns=stamp_ns,
        angle_min=SCANNER.angle_min,
        angle_increment=SCANNER.angle_increment,
        range_min=0.05,
        range_max=25.0,
        ranges=ranges,
        mount=Pose.of(SCANNER.mount),
    )


def drive(navigator, pose, seconds, world=ROOM):
    """Drive a perfect robot. Returns (command, status, pose) tuples."""
    pose, log = np.array(pose, float), []
    for number in range(int(seconds * 15)):
        stamp = number * PERIOD_NS
        navigator.on_scan(scan(stamp, pose, world))
        command, status = navigator.step(belief(stamp, pose))
        log.append((command, status, pose))
        pose = se2.compose(pose, command.twist.array() * PERIOD_NS * 1e-9)
    return log


def goal(x, y, **rest) -> Goal:
    return Goal(stamp_ns=0, pose=Pose(x=x, y=y), **rest)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, -2.0])
def test_reaches_a_goal_from_any_heading_and_stands(yaw):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 1.5))
    log = drive(navigator, [1.5, 2.5, yaw], 25)
    assert log[-1][1].state == "reached"
    assert np.hypot(*(log[-1][2][:2] - [8.5, 1.5])) <= 0.2
    assert not log[-1][0].twist.array().any()
    path = sum(np.hypot(*(b[2] - a[2])[:2]) for a, b in itertools.pairwise(log))
    assert path < 1.02 * np.hypot(7, 1)


def test_commands_respect_the_limits():
    robot = Robot(max_speed=0.6, acceleration=0.5)
    navigator = Navigator(robot, world=ROOM)
    navigator.on_goal(goal(8.5, 1.5))
    twists = np.array([c.twist.array() for c, _, _ in drive(navigator, [1.5, 2.5, 0.3], 15)])
    speeds = np.linalg.norm(twists[:, :2], axis=1)
    assert speeds.max() <= 0.6 + 1e-9
    assert speeds.max() > 0.4
    changes = np.linalg.norm(np.diff(twists[:, :2], axis=0), axis=1)
    assert changes.max() <= 0.5 * PERIOD_NS * 1e-9 + 1e-6


def test_commands_have_the_stamp_of_the_belief():
    command, status = Navigator().step(belief(123, [1, 1, 0]))
    assert command.stamp_ns == status.stamp_ns == 123


def test_idle_without_goal_and_after_cancel():
    navigator = Navigator(world=ROOM)
    assert all(s.state == "idle" and not c.twist.array().any() for c, s, _ in drive(navigator, [1.5, 2, 0], 1))
    navigator.on_goal(goal(8.5, 2))
    assert drive(navigator, [1.5, 2, 0], 1)[-1][1].state == "navigating"
    navigator.on_goal(goal(8.5, 2, cancel=True))
    assert navigator.step(belief(10**10, [1.5, 2, 0]))[1].state == "idle"


@pytest.mark.parametrize(("x", "y", "why"), [(20, 20, "inside something"), (0.1, 2.0, "m from a wall")])
def test_goal_in_a_wall_is_refused(x, y, why):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(x, y))
    log = drive(navigator, [1.5, 2, 0], 1)
    assert all(s.state == "blocked" and why in s.reason for _, s, _ in log)
    assert not any(c.twist.array().any() for c, _, _ in log)


@pytest.mark.parametrize("state", ["localising", "lost", "ambiguous"])
def test_stands_until_localised(state):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    command, status = navigator.step(belief(0, [1.5, 2, 0], state))
    assert not command.twist.array().any()
    assert state in status.reason
    assert (status.state == "lost") == (state == "lost")
    for number in range(1, 5):
        command, status = navigator.step(belief(number * PERIOD_NS, [1.5, 2, 0]))
    assert command.twist.vx > 0
    assert status.state == "navigating"


def test_blocked_by_an_obstacle_without_contact():
    crossed = World(name="crossed", boundary=ROOM.boundary, obstacles=[{"box": {"center": (5, 2), "size": (0.2, 3.9)}}])
    navigator = Navigator(world=ROOM)  # the box is not in its map
    navigator.on_goal(goal(8.5, 2))
    log = drive(navigator, [1.5, 2, 0], 15, crossed)
    assert log[-1][1].state == "blocked"
    assert "in the way" in log[-1][1].reason
    assert max(pose[0] for _, _, pose in log) + Robot().radius < 4.9


def test_stops_without_a_belief_and_keeps_the_goal():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    drive(navigator, [1.5, 2, 0], 1)
    command, status = navigator.stop_without_belief(5, "no belief")
    assert (command.stamp_ns, status.reason, status.state) == (5, "no belief", "lost")
    assert not command.twist.array().any()
    for number in range(20, 25):
        command, status = navigator.step(belief(number * PERIOD_NS, [3, 2, 0]))
    assert status.state == "navigating"
    assert command.twist.vx > 0


def test_refused_goal_keeps_its_reason_without_a_belief():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, -3))
    refusal = navigator.goal_state.status(5, None)
    assert (refusal.state, refusal.refused) == ("blocked", True)
    assert navigator.stop_without_belief(5, "no belief")[1] == refusal


def test_controller_does_not_import_torch():
    code = (
        "import sys, services.controller.service; assert 'torch' not in sys.modules and 'pybullet' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
