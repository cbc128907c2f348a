"""Docking: the precision that a goal asks for, in the direction that it asks for."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.messages.definitions import CmdVel
from common.robot.robot import Robot
from services.controller.docking import LINE_LENGTH_M
from services.controller.navigator import Navigator
from services.controller.policies.planner import GeodesicPolicy
from services.controller.velocity_command import VelocityCommand
from tests.controller.driving import box, drive, goal, room

HALL = room(10, 5)
TOLERANCE, YAW_TOLERANCE = 0.003, np.deg2rad(0.5)
IMPERFECT = {"dead_band": 0.02, "turn_dead_band": 0.05, "latency": 0.05}


def dock(yaw, approach, **more):
    return goal(6.0, 2.0, yaw=yaw, tolerance=TOLERANCE, yaw_tolerance=YAW_TOLERANCE, approach=approach, **more)


@pytest.mark.parametrize(
    ("kind", "yaw", "approach"),
    [("holonomic", 0.5, 0.5), ("holonomic", 2.0, -1.0), ("differential", 0.5, 0.5), ("differential", 0.5, 0.5 - np.pi)],
    ids=["holonomic forwards", "holonomic across", "differential forwards", "differential backwards"],
)
def test_final_pose(kind, yaw, approach):
    robot, to = Robot(drive=kind, **IMPERFECT), dock(yaw, approach)
    poses, statuses, contacts = drive(HALL, robot, (3.0, 3.0, -1.0), to)
    assert (statuses[-1].state, contacts) == ("reached", 0)
    assert np.hypot(*(poses[-1, :2] - [6.0, 2.0])) <= TOLERANCE
    assert abs(se2.wrap(poses[-1, 2] - yaw)) <= YAW_TOLERANCE
    along, across = se2.rotate(-approach, poses[:, :2] - [6.0, 2.0]).T
    last = np.flatnonzero(along < -LINE_LENGTH_M + 0.05)[-1]
    assert np.abs(across[last:]).max() < 0.03


def test_obstacle_on_the_line():
    def change(simulation):
        if simulation.steps == 300:
            simulation.change_obstacle("remove", "box", None)

    blocked = room(10, 5, box(6.4, 2.0, 0.3, 0.3))
    poses, statuses, contacts = drive(
        blocked, Robot(**IMPERFECT), (3.0, 3.0, -1.0), dock(0.0, 0.0), known=HALL, change=change
    )
    assert (statuses[299].state, statuses[299].reason) == ("blocked", "an obstacle in the scan is in the way")
    assert 0.02 < 6.0 - poses[299, 0] < 0.2
    assert (statuses[-1].state, contacts) == ("reached", 0)


@pytest.mark.parametrize(
    ("to", "reason"),
    [
        (dock(0.5, 1.5), "cannot approach the goal across it"),
        (goal(0.6, 2.0, approach=0.0), "goal refused: the line to the goal is not free: (0.00, 2.00)"),
    ],
    ids=["across", "from the wall"],
)
def test_refused_approaches(to, reason):
    robot = Robot(drive="differential")
    navigator = Navigator(robot, chosen_policy=GeodesicPolicy(robot, HALL))
    navigator.on_goal(to)
    assert reason in navigator.goal_state.reason
    assert not navigator.goal_state.active


@pytest.mark.parametrize("acceleration", [1.0, 0.5, 0.2])
def test_pulses_below_the_dead_band(acceleration):
    """Their mean is the desired velocity, also if the base accelerates to a pulse in several scans: it ignores less."""
    robot = Robot(**IMPERFECT, acceleration=acceleration, turn_acceleration=acceleration)
    command, points, period_ns = VelocityCommand(robot), np.zeros((0, 2)), 25_000_000
    desired = np.array([0.003, -0.004, 0.02])
    sent: list[CmdVel] = [command.limit(k * period_ns, desired, points)[0] for k in range(1, 1500)]
    twists = np.array([each.twist.array() for each in sent])
    twists[np.hypot(*twists[:, :2].T) <= robot.dead_band, :2] = 0
    twists[np.abs(twists[:, 2]) <= robot.turn_dead_band, 2] = 0
    assert twists.mean(axis=0) == pytest.approx(desired, rel=0.05)


def test_commands_under_way():
    """With a delay of one and a half scans, half of the last command but one applies, and all of the last one."""
    command, points = VelocityCommand(Robot(acceleration=10.0)), np.zeros((0, 2))
    for stamp_ns, speed in ((0, 0.1), (100_000_000, 0.2), (200_000_000, 0.4)):
        command.limit(stamp_ns, np.array([speed, 0.0, 0.0]), points)
    ahead = command.motion_until_effect(300_000_000, 0.15)
    assert ahead == pytest.approx([0.05 * 0.2 + 0.1 * 0.4, 0, 0])
    assert not command.motion_until_effect(300_000_000, 0.0).any()


@pytest.mark.parametrize("gap_s", [10.0, 2.0])
def test_acceleration_after_a_gap(gap_s):
    """While nothing is commanded, or when the clock steps, the base has not moved on to the next velocity."""
    command, points, period_ns = VelocityCommand(Robot()), np.zeros((0, 2)), 66_666_667
    for k in range(5):
        command.limit(k * period_ns, np.array([0.2, 0.0, 0.0]), points)
    before = command.velocity
    command.limit(4 * period_ns + round(gap_s * 1e9), np.array([-1.0, 0.0, 0.0]), points)
    assert np.hypot(*(command.velocity - before)[:2]) <= 2 * period_ns * 1e-9 + 1e-9
    fresh = VelocityCommand(Robot())
    fresh.limit(0, np.ones(3), points)
    fresh.limit(round(gap_s * 1e9), np.array([1.0, 0.0, 0.0]), points)
    assert fresh.velocity[0] <= Robot().command_timeout
