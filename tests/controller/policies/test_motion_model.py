"""Predicted motion within the robot's limits, and the selection of an action."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.robot.robot import Robot
from common.robot.scan_geometry import Sector
from common.runtime import safety
from services.controller.policies.motion_model import (
    HOLD_S,
    braking_speed,
    rollouts,
    turn_rate,
    turn_to_lookahead,
)
from services.controller.policies.motion_selection import Surroundings, remaining_distance, select_motion

ROBOT = Robot()
both_drives = pytest.mark.parametrize("robot", [ROBOT, Robot(drive="differential")], ids=lambda robot: robot.drive)
PERIOD = 1 / 15
speeds = st.floats(-1, 1).map(lambda v: round(v, 3))


def no_walls(places):
    return np.full(places.shape[:-1], np.inf)


def around(points=(), *, moving=False, **more):
    points = np.array(points, float).reshape(-1, 2)
    return Surroundings(no_walls, points, np.full(len(points), moving), 0.3, 0.33, **more)


@settings(max_examples=15)
@given(speeds, speeds, speeds, speeds)
def test_differential_rollout(v0, w0, v, w):
    robot, fine = Robot(drive="differential"), 1e-2 / 3
    poses, times, stands = rollouts(np.array([v0, 0, w0]), np.array([[v, 0, w, HOLD_S, HOLD_S]]), robot)
    velocity, pose, simulated = np.array([v0, 0.0, w0]), np.zeros(3), []
    for number in range(round(times[-1] / fine)):
        braking, before = (number + 0.5) * fine >= HOLD_S, velocity
        velocity = safety.ramp(velocity, np.zeros(3) if braking else np.array([v, 0, w]), robot, fine)
        if braking and before[0]:  # it stays on its arc, unless it can stop turning only later
            on_arc = before[2] * velocity[0] / before[0]
            velocity[2] = max(velocity[2], on_arc, key=abs)
        pose = se2.compose(pose, velocity * fine)
        simulated.append(pose)
    expected = np.array(simulated)[np.round(times / fine).astype(int) - 1]
    np.testing.assert_allclose(poses[0, :, :2], expected[:, :2], atol=0.02)
    assert np.abs(se2.wrap(poses[0, :, 2] - expected[:, 2])).max() < 0.06
    after = poses[0, times > stands[0] + 1 / 15, :2]
    assert not len(after) or np.hypot(*(after - after[-1]).T).max() < 1e-9


@given(st.floats(0.01, 20))
def test_braking_speed_covers_the_distance(distance):
    v = braking_speed(distance, ROBOT)
    assert v <= ROBOT.max_speed
    if v < ROBOT.max_speed:
        assert v * HOLD_S + v**2 / (2 * ROBOT.acceleration) == pytest.approx(distance)


@given(st.floats(-np.pi, np.pi))
def test_turn_is_braked_in_time(angle):
    left, rate, max_change = angle, 0.0, ROBOT.turn_acceleration * PERIOD
    for _ in range(120):
        rate += float(np.clip(turn_rate(left, ROBOT) - rate, -max_change, max_change))
        left -= rate * PERIOD
        assert abs(left) <= abs(angle) + 1e-9
        assert np.sign(left) * np.sign(angle) >= 0 or abs(left) < 0.12  # hardly any overshoot
    assert abs(left) < 0.02


@both_drives
@given(x=st.floats(-4, 4), y=st.floats(-4, 4), v=speeds, w=speeds)
def test_distance_after_selection(robot, x, y, v, w):
    current, goal = np.array([v, 0.0, w]), np.array([x, y])
    selected = select_motion(current, goal, around(), robot)
    poses, _, _ = rollouts(current, np.array([[0, 0, 0, HOLD_S, HOLD_S]]), robot)
    to_go, if_braking = (remaining_distance(each, goal, robot, around()) for each in (selected.poses, poses[0]))
    assert to_go.mean() + to_go[-1] <= if_braking.mean() + if_braking[-1] + 0.02 * np.hypot(*current[:2]) + 1e-9
    assert np.hypot(*selected.action[:2]) <= robot.max_speed + 1e-9
    assert abs(selected.action[2]) <= robot.max_turn + 1e-9
    assert not selected.hindered
    assert robot.drive == "holonomic" or selected.action[1] == 0


@both_drives
def test_speed_is_kept_up_to_the_goal(robot):
    """With a quadratic prior the slope, and with it the speed, would decrease towards the goal."""
    pose, velocity, steps, goal = np.zeros(3), np.zeros(3), 0, np.array([4.0, 0.0])
    while np.hypot(*(goal - pose[:2])) > 0.05 and steps < 200:
        selected = select_motion(velocity, se2.rotate(-pose[2], goal - pose[:2]), around(), robot)
        velocity = safety.ramp(velocity, selected.action, robot, PERIOD)
        pose, steps = se2.compose(pose, velocity * PERIOD), steps + 1
    least = 4.0 / robot.max_speed + robot.max_speed / robot.acceleration  # accelerate, cruise, brake
    assert steps * PERIOD < 1.12 * least
    assert pose[0] < 4.06  # no overshoot


@both_drives
@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), max_size=12), st.integers(0, 100))
def test_selected_motion(robot, points, seed):
    v, w = np.random.default_rng(seed).uniform([0, -1], [0.5, 1])
    surroundings = around([p for p in points if np.hypot(*p) > 0.35])
    selected = select_motion(np.array([v, 0, w]), np.array([1.5, 0.7]), surroundings, robot)
    if selected.action.any():
        assert surroundings.gaps(selected.poses[None], np.zeros(len(selected.poses))).min() >= -1e-3


@pytest.mark.parametrize(
    ("point", "moving", "hindered"), [((1.6, 0.0), False, False), ((1.6, 0.0), True, True), ((0.0, 0.5), False, False)]
)
def test_moving_and_static_obstacles(point, moving, hindered):
    """Driving at a moving one, the robot must be able to stop before it arrives."""
    surroundings = around([point], moving=moving)
    selected = select_motion(np.array([0.6, 0.0, 0.0]), np.array([3.0, 0.0]), surroundings, ROBOT)
    assert selected.hindered == hindered
    assert (np.hypot(*selected.action[:2]) < 0.6) == hindered


def test_unseen_directions():
    behind, view = np.array([-3.0, 0.0]), Sector(0.0, np.deg2rad(135))
    action = select_motion(np.zeros(3), behind, around(field_of_view=view), ROBOT).action
    assert abs(np.arctan2(action[1], action[0])) <= np.pi / 2 + 1e-9  # the body is wide
    assert abs(turn_to_lookahead(np.zeros(3), action, behind, ROBOT, may_turn=True)[2]) > 1.0
    kept = select_motion(np.zeros(3), behind, around(field_of_view=view, may_turn=False), ROBOT).action
    assert 0 < np.hypot(*kept[:2]) <= 0.25 + 1e-9


@pytest.mark.parametrize("bearing", np.deg2rad([100, 135, 180]))
def test_holonomic_base_turns_before_it_drives_to_what_it_does_not_see(bearing):
    """If it drove at once, it would turn slowly, and go a long way round."""
    goal, view = 2.5 * np.array([np.cos(bearing), np.sin(bearing)]), Sector(0.0, np.deg2rad(135))
    pose, velocity, path = np.zeros(3), np.zeros(3), [np.zeros(2)]
    while np.hypot(*(goal - pose[:2])) > 0.05 and len(path) < 200:
        lookahead = se2.rotate(-pose[2], goal - pose[:2])
        action = select_motion(velocity, lookahead, around(field_of_view=view), ROBOT).action
        velocity = safety.ramp(
            velocity, turn_to_lookahead(velocity, action, lookahead, ROBOT, may_turn=True), ROBOT, PERIOD
        )
        pose = se2.compose(pose, velocity * PERIOD)
        path.append(pose[:2])
    assert np.hypot(*np.diff(path, axis=0).T).sum() < 1.1 * 2.5
    least = 2.5 / ROBOT.max_speed + ROBOT.max_speed / ROBOT.acceleration
    assert len(path) * PERIOD < least + 2.0  # s, for the turn


@pytest.mark.parametrize("period", [0.025, 1 / 15, 0.1, 0.2])
def test_braking_base_that_turns_stays_on_its_line(period):
    """It brakes along y with all its acceleration, and turns towards a point beside the line meanwhile."""
    pose, velocity = np.zeros(3), np.array([0.0, 0.7, -0.6])
    while np.hypot(*velocity[:2]) > 1e-3:
        lookahead = se2.rotate(-pose[2], np.array([2.0, 2.0]))
        action = turn_to_lookahead(velocity, np.zeros(3), lookahead, ROBOT, may_turn=True, period=period)
        velocity = safety.ramp(velocity, action, ROBOT, period)
        step = se2.rotate(pose[2] + velocity[2] * period / 2, velocity[:2]) * period
        pose = np.array([*(pose[:2] + step), pose[2] + velocity[2] * period])
    assert abs(pose[2]) > 0.3
    assert abs(pose[0]) < 0.015
    assert pose[1] == pytest.approx(0.7**2 / 2 - 0.7 * period / 2, abs=0.02)  # it brakes once per period
