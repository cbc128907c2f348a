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


@given(twists, clouds, st.floats(safety.REACTION_TIME_S, 2))
def test_stopping_distance(twist, points, hold):
    limited, held = safety.limit_velocity(twist, points, ROBOT, hold=hold)
    speed = np.hypot(*limited[:2])
    assert speed <= np.hypot(*twist[:2]) + 1e-12
    assert limited[2] == twist[2]
    assert held == (speed < np.hypot(*twist[:2]) - 1e-12)
    if speed < 1e-9:
        return
    stop = speed * hold + speed**2 / (2 * ROBOT.acceleration)
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


def scan_of(ranges: np.ndarray) -> Scan:
    """A scan like that of the shipped scanner, 270° with 622 beams."""
    return Scan(
        stamp_ns=0, angle_min=-0.75 * np.pi, angle_increment=1.5 * np.pi / 621, range_min=0.05, range_max=8.3,
        ranges=ranges,
    )  # fmt: skip


BEAMS = scan_of(np.zeros(622)).angles()


def ranges_to_wall(distance: float, bearing: float = 0.0) -> np.ndarray:
    """Ranges (622,) m to a straight wall ``distance`` m away, perpendicular to ``bearing`` rad."""
    towards = np.cos(BEAMS - bearing)
    return np.where(towards > 0.1, distance / np.maximum(towards, 0.1), np.inf)


@given(st.floats(0.2, 3), st.floats(-3, 3))
def test_points_of_a_straight_wall_lie_on_it(distance, bearing):
    points = safety.scan_points(scan_of(ranges_to_wall(distance, bearing)))
    assert points @ [np.cos(bearing), np.sin(bearing)] == pytest.approx(distance, abs=1e-5)


def test_noise_hardly_moves_the_stop():
    """A robot that drives at a wall stops near its margin, not before the nearest of hundreds of noisy end points."""
    gaps = np.arange(0, 0.15, 0.002)  # m between robot and wall

    def first_free(points: list[np.ndarray]) -> float:
        creeping = np.array([0.02, 0, 0])
        return gaps[np.argmax([safety.limit_velocity(creeping, cloud, ROBOT)[0][0] > 0.01 for cloud in points])]

    stops, raw_stops = [], []
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 0.02, 622)
        ranges = [ranges_to_wall(ROBOT.radius + gap) + noise for gap in gaps]
        stops.append(first_free([safety.scan_points(scan_of(each)) for each in ranges]))
        ends = [np.stack([each * np.cos(BEAMS), each * np.sin(BEAMS)], axis=-1) for each in ranges]
        raw_stops.append(first_free([each[np.isfinite(each).all(axis=1)] for each in ends]))
    assert min(stops) > ROBOT.margin - 0.01
    assert np.median(stops) - ROBOT.margin < (np.median(raw_stops) - ROBOT.margin) / 2


@pytest.mark.parametrize("beams", [1, 2, 5])
def test_thin_post_before_a_wall(beams):
    ranges = ranges_to_wall(0.5)
    post = slice(311, 311 + beams)
    ranges[post] = 0.4
    points = safety.scan_points(scan_of(ranges))
    assert np.hypot(*points.T).min() == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize(("radius", "distance"), [(0.01, 0.35), (0.03, 0.4), (0.2, 0.6)])
def test_round_post_keeps_its_place(radius, distance):
    """The mean of points of a curved surface lies behind it by millimetres at most."""
    across = distance * np.sin(BEAMS)
    hit = (np.abs(across) < radius) & (np.cos(BEAMS) > 0)
    depth = distance * np.cos(BEAMS) - np.sqrt(np.maximum(radius**2 - across**2, 0))
    points = safety.scan_points(scan_of(np.where(hit, depth, np.inf)))
    assert points[:, 0].min() < distance - radius + 0.004
    assert (np.hypot(points[:, 0] - distance, points[:, 1]) > radius - 0.008).all()


def test_end_of_a_wall_seen_at_a_grazing_angle_stays():
    """A thin wall along x that begins 0.35 m ahead and 0.05 m aside."""
    bearing = np.clip(BEAMS, 1e-6, None)
    along = 0.05 / np.tan(bearing)
    hit = (BEAMS > 0) & (along > 0.35) & (along < 1.4)
    ranges = np.where(hit, 0.05 / np.sin(bearing), np.inf)
    nearest = ranges[hit].min()
    assert np.hypot(*safety.scan_points(scan_of(ranges)).T).min() == pytest.approx(nearest, abs=1e-3)


def test_too_close_beams_are_not_averaged():
    ranges = np.full(622, 0.1)
    ranges[311] = -np.inf
    points = safety.scan_points(scan_of(ranges))
    assert np.sort(np.hypot(*points.T))[:2] == pytest.approx([0.05, 0.1], abs=1e-3)


@pytest.mark.parametrize("front", [0.29, 0.5])
@pytest.mark.parametrize(("width", "too_far"), [(0.02, 1e-6), (0.005, 0.045)])
def test_post_close_to_a_wall(front, width, too_far):
    ahead = np.abs(BEAMS) < 1
    on_post = ahead & (np.abs(front * np.tan(BEAMS)) < width / 2)
    for depth in (0.02, 0.04, 0.055, 0.07):
        wall = np.where(ahead, (front + depth) / np.cos(BEAMS), np.inf)
        points = safety.scan_points(scan_of(np.where(on_post, front / np.cos(BEAMS), wall)))
        assert points[:, 0].min() <= front + too_far
