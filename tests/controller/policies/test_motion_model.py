"""Predicted motion within the robot's limits, and the choice of an action."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.robot.base import Robot
from common.robot.scan_geometry import Sector
from common.runtime import safety
from services.controller.policies.action_selection import Surroundings, select_action, to_go
from services.controller.policies.motion_model import (
    HOLD_S,
    braking_speed,
    candidate_actions,
    rollouts,
    turn_rate,
    turn_to_attractor,
)

DRIVES = [Robot(), Robot(drive="differential")]
PERIOD = 1 / 15
speeds = st.floats(-1, 1).map(lambda v: round(v, 3))


def no_walls(places):
    return np.full(places.shape[:-1], np.inf)


def around(points=(), moving=(), known=no_walls, **more):
    points = np.array(points, float).reshape(-1, 2)
    return Surroundings(known, points, np.array(moving, bool).reshape(-1), 0.3, 0.33, **more)


@settings(max_examples=15)
@given(speeds, speeds, speeds, speeds)
def test_differential_rollout_matches_a_fine_simulation(v0, w0, v, w):
    robot = Robot(drive="differential")
    poses, times, stands = rollouts(np.array([v0, 0, w0]), np.array([[v, 0, w]]), robot)
    fine, velocity, pose, count = 1e-3, np.array([v0, 0.0, w0]), np.zeros(3), 0
    for number in range(round(times[-1] / fine)):
        wanted = np.array([v, 0, w]) if (number + 0.5) * fine < HOLD_S else np.zeros(3)
        velocity = safety.ramp(velocity, wanted, robot, fine)
        pose = se2.compose(pose, velocity * fine)
        if count < len(times) and abs((number + 1) * fine - times[count]) < fine / 2:
            np.testing.assert_allclose(poses[0, count, :2], pose[:2], atol=0.02)
            assert abs(se2.wrap(poses[0, count, 2] - pose[2])) < 0.06
            count += 1
    after = poses[0, times > stands[0] + 1 / 15, :2]
    assert not len(after) or np.hypot(*(after - after[-1]).T).max() < 1e-9


@given(st.floats(0.01, 20))
def test_braking_speed_covers_the_distance(distance):
    robot = Robot()
    v = braking_speed(distance, robot)
    assert v <= robot.max_speed
    if v < robot.max_speed:
        assert v * HOLD_S + v**2 / (2 * robot.acceleration) == pytest.approx(distance)


@given(st.floats(-np.pi, np.pi))
def test_turn_is_braked_in_time(angle):
    robot, left, rate = Robot(), angle, 0.0
    for _ in range(120):
        wanted = turn_rate(left, robot)
        rate += float(np.clip(wanted - rate, -robot.turn_acceleration * PERIOD, robot.turn_acceleration * PERIOD))
        left -= rate * PERIOD
        assert abs(left) <= abs(angle) + 1e-9
        assert np.sign(left) * np.sign(angle) >= 0 or abs(left) < 0.12  # hardly any overshoot
    assert abs(left) < 0.02


@pytest.mark.parametrize("robot", DRIVES, ids=lambda robot: robot.drive)
@given(x=st.floats(-4, 4), y=st.floats(-4, 4), v=speeds, w=speeds)
def test_choice_never_increases_the_distance(robot, x, y, v, w):
    current, goal = np.array([v, 0.0, w]), np.array([x, y])
    choice = select_action(current, goal, around(), robot)
    poses, _, _ = rollouts(current, np.zeros((1, 3)), robot)
    assert to_go(choice.motion[-1], goal, robot) <= to_go(poses[0, -1], goal, robot) + 1e-9
    assert np.hypot(*choice.action[:2]) <= robot.max_speed + 1e-9
    assert abs(choice.action[2]) <= robot.max_turn + 1e-9
    assert not choice.hindered
    assert robot.drive == "holonomic" or choice.action[1] == 0


@pytest.mark.parametrize("robot", DRIVES, ids=lambda robot: robot.drive)
def test_speed_is_kept_up_to_the_goal(robot):
    """With a quadratic prior the slope, and with it the speed, would decrease towards the goal."""
    pose, velocity, taken = np.zeros(3), np.zeros(3), 0
    goal = np.array([4.0, 0.0])
    while np.hypot(*(goal - pose[:2])) > 0.05 and taken < 200:
        choice = select_action(velocity, se2.rotate(-pose[2], goal - pose[:2]), around(), robot)
        velocity = safety.ramp(velocity, choice.action, robot, PERIOD)
        pose, taken = se2.compose(pose, velocity * PERIOD), taken + 1
    least = 4.0 / robot.max_speed + robot.max_speed / robot.acceleration  # accelerate, cruise, brake
    assert taken * PERIOD < 1.12 * least
    assert pose[0] < 4.06  # no overshoot


@pytest.mark.parametrize("robot", DRIVES, ids=lambda robot: robot.drive)
@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), max_size=12), st.integers(0, 100))
def test_chosen_motion_is_free_until_standstill(robot, points, seed):
    points = [p for p in points if np.hypot(*p) > 0.35]
    v, w = np.random.default_rng(seed).uniform([0, -1], [0.5, 1])
    here = around(points, [False] * len(points))
    choice = select_action(np.array([v, 0, w]), np.array([1.5, 0.7]), here, robot)
    if choice.action.any():
        gaps = here.gaps(choice.motion[None], np.zeros(len(choice.motion)))
        assert gaps.min() >= -1e-3


def test_moving_obstacle_slows_the_robot_and_static_one_does_not():
    robot, current, goal = Robot(), np.array([0.6, 0.0, 0.0]), np.array([3.0, 0.0])
    still = select_action(current, goal, around([(1.6, 0.0)], [False]), robot)
    walking = select_action(current, goal, around([(1.6, 0.0)], [True]), robot)
    assert np.hypot(*still.action[:2]) > 0.6
    assert np.hypot(*walking.action[:2]) < 0.6  # driving at them it must be able to stop before they arrive
    assert walking.hindered
    assert not still.hindered
    beside = select_action(current, goal, around([(0.0, 0.5)], [False]), robot)
    assert beside.action[0] > 0.6


def test_stops_before_a_wall_across_the_path():
    wall = [(0.4, y) for y in np.linspace(-2, 2, 81)]
    choice = select_action(np.zeros(3), np.array([3.0, 0.0]), around(wall, [False] * 81), Robot(drive="differential"))
    assert choice.hindered
    assert choice.motion[-1, 0] < 0.4 - 0.33 + 1e-3


def test_turns_or_slows_towards_unseen_directions():
    behind, view = np.array([-3.0, 0.0]), Sector(0.0, np.deg2rad(135))
    choice = select_action(np.zeros(3), behind, around(view=view), Robot())
    assert abs(np.arctan2(choice.action[1], choice.action[0])) <= np.pi / 2 + 1e-9  # the body is wide
    assert abs(turn_to_attractor(choice.action, behind, Robot(), may_turn=True)[2]) > 1.0
    kept = select_action(np.zeros(3), behind, around(view=view, may_turn=False), Robot())
    assert 0 < np.hypot(*kept.action[:2]) <= 0.25 + 1e-9


def test_candidates_contain_standing_and_the_current_velocity():
    for robot in DRIVES:
        actions = candidate_actions(np.array([0.3, 0.0, 0.1]), np.array([1.0, 0.2]), robot)
        np.testing.assert_array_equal(actions[:2], [[0, 0, 0], [0.3, 0, 0.1]])
        assert len(actions) < 130
