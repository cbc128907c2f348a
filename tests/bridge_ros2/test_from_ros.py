"""Conversion of ROS messages to presage messages."""

from __future__ import annotations

import numpy as np
import pytest

from common.limits import MAX_DISTANCE_M
from common.messages.ros_messages import IDENTITY, Mount, Transform
from common.runtime import safety
from services.bridge_ros2.from_ros import dead_reckoning_of, odom_of, pose_of, scan_of
from services.bridge_ros2.ros_types import LASER_SCAN, ODOMETRY, POSE_STAMPED, decode
from tests.bridge_ros2 import cdr


def laser(ranges, **fields):
    return decode(LASER_SCAN, cdr.laser_scan(5, ranges, **fields))


def test_plain_scan():
    scan = scan_of(laser([1, 2, 3, 4, 5]), Mount((0.2, 0.1, 0.3)), 77)
    np.testing.assert_allclose(scan.angles(), [-1, -0.5, 0, 0.5, 1])
    np.testing.assert_array_equal(scan.ranges, np.array([1, 2, 3, 4, 5], np.float32))
    assert scan.mount.array().tolist() == [0.2, 0.1, 0.3]
    assert (scan.stamp_ns, scan.frame_id, scan.range_max) == (77, "laser", 10.0)
    assert scan.scan_time == pytest.approx(0.1)


def test_unmeasured_ranges():
    inf, nan = np.inf, np.nan
    scan = scan_of(laser([0.0, nan, inf, -inf, 0.05, 11.0, -1.0, 10.0, 0.1]), Mount(), 0)
    expected = np.array([0, 0, inf, -inf, -inf, inf, 0, inf, 0.1], np.float32)
    np.testing.assert_array_equal(scan.ranges, expected)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("step", [0.5, -0.5])
def test_directions_of_beams(upside_down, step):
    """Whatever the order of beams and the side that is up: the same points in base_link."""
    ranges, mount = np.array([1.0, 2.0, 3.0, 4.0], np.float32), Mount((0.5, -0.2, 0.7), upside_down)
    scan = scan_of(laser(ranges.tolist(), angle_min=0.2, angle_increment=step), mount, 0)
    assert scan.angle_increment > 0
    angles = np.float32(0.2) + step * np.arange(4)
    in_laser = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(4)], axis=-1)
    roll = np.diag([1.0, -1.0, -1.0]) if upside_down else np.eye(3)
    c, s = np.cos(0.7), np.sin(0.7)
    expected = (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ roll @ in_laser.T).T[:, :2] + [0.5, -0.2]
    found = safety.scan_points(scan)
    order = np.argsort(np.hypot(*(found - [0.5, -0.2]).T))
    np.testing.assert_allclose(found[order], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("step", "stated", "expected"), [(0.5, 0.01, 0.01), (-0.5, 0.01, -0.01), (0.5, 0.05, 0.0), (0.5, np.nan, 0.0)]
)
def test_times_of_beams(step, stated, expected):
    """Beams that are put into another order keep their times; a scan of 0.1 s cannot take 0.2 s."""
    scan = scan_of(laser([1, 2, 3, 4, 5], angle_increment=step, time_increment=stated), Mount(), 0)
    assert scan.time_increment == pytest.approx(expected)


def test_full_circle():
    scan = scan_of(
        laser([1.0] * 360, angle_min=0.0, angle_increment=np.deg2rad(1), angle_max=np.deg2rad(359)), Mount(), 0
    )
    assert scan.angle_min == 0
    assert len(scan.ranges) == 360
    missing = scan_of(laser([1.0] * 5, angle_increment=0.0), Mount(), 0)  # without an increment
    assert missing.angle_increment == pytest.approx(0.5)


@pytest.mark.parametrize("unlimited", [float(np.finfo(np.float32).max), np.inf])
def test_unlimited_range(unlimited):
    scan = scan_of(laser([1.0, 2.0, np.inf], range_max=unlimited), Mount(), 0)
    assert scan.range_max == MAX_DISTANCE_M
    assert scan.ranges.tolist() == [1.0, 2.0, np.inf]


@pytest.mark.parametrize(
    "wrong",
    [
        {"ranges": []},
        {"ranges": [1.0] * 32_769},
        {"angle_min": np.nan},
        {"range_max": 0.0},
        {"range_max": np.nan},
        {"angle_increment": 0.0, "angle_max": -1.0},
    ],
    ids=lambda wrong: str(wrong)[:40],
)
def test_invalid_scans(wrong):
    with pytest.raises(ValueError, match="scan"):
        scan_of(laser(**{"ranges": [1.0, 1.0], **wrong}), Mount(), 0)


def odometry(x=1.0, y=2.0, yaw=0.0, twist=(0.3, 0.0, 0.5), covariance=(0.0,) * 36):
    return decode(ODOMETRY, cdr.odometry(9, cdr.planar_pose(x, y, yaw), twist, "base_footprint", covariance))


def test_covariance_of_odometry():
    six = np.arange(36.0)
    odom = odom_of(dead_reckoning_of(odometry(yaw=0.4, covariance=six.tolist()), None))
    np.testing.assert_allclose(odom.pose.array(), [1, 2, 0.4])
    assert (odom.twist.vx, odom.twist.wz, odom.stamp_ns) == (0.3, 0.5, 9)
    np.testing.assert_array_equal(odom.covariance, [[0, 1, 5], [6, 7, 11], [30, 31, 35]])
    assert not dead_reckoning_of(odometry(covariance=[np.nan] * 36), None).covariance.any()
    with pytest.raises(ValueError, match="not finite"):
        dead_reckoning_of(odometry(twist=(np.inf, 0, 0)), None)
    with pytest.raises(ValueError, match=r"at \(500000, 2\) m, more than 10000 m from its origin"):
        dead_reckoning_of(odometry(x=5e5), None)


def test_odometry_of_another_frame():
    """The child frame is 1 m ahead of the base: it swings where the base only turns."""
    ahead = Transform(np.array([1.0, 0, 0]), np.eye(3))
    dead = dead_reckoning_of(odometry(x=0.0, y=1.0, yaw=np.pi / 2, twist=(0.0, 0.5, 0.5)), ahead)
    np.testing.assert_allclose(dead.pose, [0, 0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(dead.twist, [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(dead_reckoning_of(odometry(), IDENTITY).pose, [1, 2, 0])


def test_frame_of_a_pose():
    def message(frame):
        return decode(POSE_STAMPED, cdr.pose_stamped(cdr.planar_pose(3, 4, 1), frame))

    for frame in ("map", "/map", ""):
        np.testing.assert_allclose(pose_of(message(frame), "map").array(), [3, 4, 1])
    with pytest.raises(ValueError, match="frame 'odom', not 'map'"):
        pose_of(message("odom"), "map")
