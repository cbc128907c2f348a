"""Velocity limits and the obstacle stop, for any command and scan."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.messages.definitions import Pose, Scan
from common.robot.robot import Robot
from common.runtime import safety

ROBOT = Robot()
any_float = st.floats(allow_nan=True, allow_infinity=True)
twists = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2)).map(np.array)
clouds = st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), max_size=30).map(lambda p: np.array(p).reshape(-1, 2))


@given(st.tuples(any_float, any_float, any_float).map(np.array))
def test_clipped_commands(twist):
    clipped = safety.clip_twist(twist, ROBOT)
    assert np.hypot(*clipped[:2]) <= ROBOT.max_speed * (1 + 1e-9)
    assert abs(clipped[2]) <= ROBOT.max_turn
    if not np.isfinite(twist).all():
        assert not clipped.any()


def test_clipped_direction():
    assert safety.clip_twist(np.array([3.0, 4.0, 0.0]), ROBOT) == pytest.approx([0.6, 0.8, 0.0])
    assert safety.clip_twist(np.array([0.3, 0.4, 0.1]), Robot(drive="differential")) == pytest.approx([0.3, 0, 0.1])


@given(twists, twists, st.floats(0, 0.2))
def test_ramps(current, wanted, dt):
    after = safety.ramp(current, wanted, ROBOT, dt)
    assert np.hypot(*(after - current)[:2]) <= ROBOT.acceleration * dt + 1e-9
    assert abs(after[2] - current[2]) <= ROBOT.turn_acceleration * dt + 1e-9
    assert np.linalg.norm(after - wanted) <= np.linalg.norm(current - wanted) + 1e-9


@given(twists, clouds)
def test_stopping_distance(twist, points):
    limited, held = safety.limit_velocity(twist, points, ROBOT)
    speed = np.hypot(*limited[:2])
    assert speed <= np.hypot(*twist[:2]) + 1e-12
    assert limited[2] == twist[2]
    assert held == (speed < np.hypot(*twist[:2]) - 1e-12)
    if speed < 1e-9:
        return
    stop = speed * safety.REACTION_TIME_S + speed**2 / (2 * ROBOT.acceleration)
    ahead = limited[:2] / speed
    for travelled in np.linspace(0, stop, 20):
        gaps = np.hypot(*(points - ahead * travelled).T)
        in_front = (points - ahead * travelled) @ ahead > 0
        assert (gaps[in_front] >= ROBOT.radius - 1e-6).all()


def test_leaving_a_touched_wall():
    wall = np.column_stack([np.full(21, ROBOT.radius), np.linspace(-1, 1, 21)])
    into, held = safety.limit_velocity(np.array([0.5, 0, 0.3]), wall, ROBOT)
    assert held
    assert into == pytest.approx([0, 0, 0.3])  # turning on the spot stays free
    for twist in ([-0.5, 0, 0], [0, 0.5, 0]):
        away, held = safety.limit_velocity(np.array(twist), wall[:, ::1] + [0.02, 0], ROBOT)
        assert not held
        assert away == pytest.approx(twist)


def test_free_paths_are_not_limited():
    twist = np.array([1.0, 0, 0])
    assert safety.limit_velocity(twist, np.zeros((0, 2)), ROBOT) == (pytest.approx(twist), False)
    assert safety.limit_velocity(np.array([np.nan, 0, 0]), np.zeros((0, 2)), ROBOT)[1]


def test_scan_points_are_in_base_link():
    scan = Scan(
        stamp_ns=0, angle_min=-np.pi / 2, angle_increment=np.pi / 2, range_min=0.1, range_max=9.0,
        ranges=[1.0, np.inf, -np.inf], mount=Pose(x=0.2, y=0.0, yaw=np.pi / 2),
    )  # fmt: skip
    points = safety.scan_points(scan)
    assert points == pytest.approx(np.array([[1.2, 0.0], [0.1, 0.0]]))  # no return is no point, too close is one


def test_unmeasured_beams_are_no_obstacles():
    scan = Scan(
        stamp_ns=0, angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=9.0, ranges=[0.0, np.inf, 2.0, 0.0]
    )
    assert safety.scan_points(scan) == pytest.approx(2 * np.array([[np.cos(0.2), np.sin(0.2)]]))
