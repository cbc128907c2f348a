"""tf and odometry."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from services.bridge_ros2.frames import DeadReckoning, OdometryBuffer
from services.bridge_ros2.odometry import MountAndOdometry
from services.bridge_ros2.ros_types import TF_MESSAGE, decode
from tests.bridge_ros2 import cdr

SECOND = 10**9


def turned(roll=0.0, pitch=0.0, yaw=0.0):
    """Quaternion of fixed-axis angles, rad (REP-103)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(np.array([roll, pitch, yaw]) / 2), np.cos(np.array([roll, pitch, yaw]) / 2)
    return cdr.quaternion(
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def tf(*each):
    """A tf message of transforms given as (parent, child, (x, y, z), rotation, stamp)."""
    transforms = [
        {
            "header": cdr.header(stamp, parent), "child_frame_id": child,
            "transform": {"translation": cdr.vector(*at), "rotation": rotation},
        }
        for parent, child, at, rotation, stamp in each
    ]  # fmt: skip
    return decode(TF_MESSAGE, cdr.encode(TF_MESSAGE, {"transforms": transforms}))


@pytest.mark.parametrize(("roll", "upside_down"), [(0.0, False), (np.pi, True)])
def test_mounting_over_joints(roll, upside_down):
    motion = MountAndOdometry("base_link", "odom")
    motion.add_tf(tf(
        ("base_footprint", "base_link", (0, 0, 0.1), turned(), 0),
        ("base_link", "tower", (0.1, 0, 0.5), turned(yaw=np.pi / 2), 0),
        ("/tower", "/laser", (0.2, 0, 0), turned(roll=roll), 0),
    ))  # fmt: skip
    mount = motion.mount_for("laser")
    np.testing.assert_allclose(mount.pose, [0.1, 0.2, np.pi / 2], atol=1e-12)
    assert mount.upside_down == upside_down
    assert motion.mount() == mount


def test_inclined_scanner():
    motion = MountAndOdometry("base_link", "odom")
    motion.add_tf(tf(("base_link", "laser", (0, 0, 0), turned(pitch=np.deg2rad(20)), 0)))
    with pytest.raises(ValueError, match="inclined by 20"):
        motion.mount_for("laser")


def test_unconnected_laser():
    motion = MountAndOdometry("base_link", "odom")
    motion.add_tf(tf(("base_footprint", "rplidar_link", (0, 0, 0), turned(), 0)))
    with pytest.raises(
        ValueError, match=r"does not connect laser with base_link.*base_footprint, rplidar_link.*--mount"
    ):
        motion.mount_for("laser")


def test_unconnected_odometry():
    motion = MountAndOdometry("base_link", "odom")
    assert motion.child_in_base("base_link") is None
    assert motion.unconnected_frame == ""
    assert motion.child_in_base("/wheels") is None
    assert motion.unconnected_frame == "wheels"
    motion.add_tf(tf(("wheels", "base_link", (0.5, 0, 0), turned(), 0)))
    np.testing.assert_allclose(motion.child_in_base("wheels").planar(), [-0.5, 0, 0])
    assert motion.unconnected_frame == ""


def test_other_children_of_the_odom_frame():
    """Only transforms of the base are odometry, whatever the stamps of others."""
    motion = MountAndOdometry("base_link", "odom")
    for k in range(3):
        motion.add_tf(tf(
            ("odom", "base_footprint", (0.1 * k, 0, 0), turned(), 10**9 + k * 10**8),
            ("base_footprint", "base_link", (0, 0, 0), turned(), 0),
            ("odom", "person", (5.0, k, 0), turned(), 10**9 + k * 10**8 + 10**7),
            ("odom", "marker", (7.0, 0, 0), turned(), 0),
        ))  # fmt: skip
    np.testing.assert_allclose(motion.at(10**9 + 2 * 10**8).pose, [0.2, 0, 0], atol=1e-9)
    np.testing.assert_allclose(motion.at(10**9 + 5 * 10**7).pose, [0.05, 0, 0], atol=1e-9)


def test_invalid_transforms():
    motion = MountAndOdometry("base_link", "odom")
    motion.add_tf(tf(
        ("base_link", "a", (np.nan, 0, 0), turned(), 0), ("base_link", "b", (0, 0, 0), cdr.quaternion(w=0.0), 0),
        ("x", "y", (0, 0, 0), turned(), 0), ("y", "x", (0, 0, 0), turned(), 0),  # a cycle
    ))  # fmt: skip
    for frame in ("a", "b", "x"):
        with pytest.raises(ValueError, match="does not connect"):
            motion.mount_for(frame)


def test_two_odometries_are_not_mixed():
    """While the topic pauses, the odometry in tf, which has drifted elsewhere, does not stand in for it at once."""
    motion, stall = MountAndOdometry("base_link", "odom"), 10**9 // 2
    for stamp in range(10**9, 14 * 10**9, stall):
        motion.add_tf(tf(("odom", "base_link", (5, 0, 0), turned(), stamp)))
    motion.add_odometry(dead(10**9, (1, 0, 0)))
    assert motion.at(10**9).pose[0] == 1
    assert motion.at(10**9 + stall) is None
    assert motion.at_by_tf(13 * 10**9).pose[0] == 5
    assert motion.at(13 * 10**9).pose[0] == 5  # the topic has been silent for 12 s


def dead(stamp, pose, twist=(0.0, 0.0, 0.0)):
    return DeadReckoning(stamp, np.array(pose, float), np.array(twist, float), np.zeros((3, 3)))


def test_interpolated_odometry():
    odometer = OdometryBuffer()
    assert odometer.at(0) is None
    odometer.add(dead(0, [0, 0, 0]))
    odometer.add(dead(SECOND // 2, [1, 0, np.pi / 2], [1.0, 0.0, 0.5]))
    middle = odometer.at(SECOND // 4)
    np.testing.assert_allclose(middle.pose, [0.5, 0, np.pi / 4])
    beyond = odometer.at(SECOND // 2 + SECOND // 10)
    np.testing.assert_allclose(beyond.pose, [1, 0.1, np.pi / 2 + 0.05])  # forward is along y here
    assert odometer.at(SECOND) is None  # too far beyond
    assert odometer.at(-1) is None
    odometer.add(dead(SECOND // 4, [9, 9, 9]))  # late: skipped
    np.testing.assert_allclose(odometer.at(SECOND // 4).pose, middle.pose)
    odometer.add(dead(60 * SECOND, [2, 0, 0]))
    assert odometer.at(0) is None  # too old
    odometer.add(dead(0, [3, 0, 0]))  # the simulation was restarted
    np.testing.assert_allclose(odometer.at(0).pose, [3, 0, 0])


@pytest.mark.parametrize("ran", [1.5, 5.0, 9.9, 3600.0])
def test_clock_set_back(ran):
    """Independent of how long the simulation ran before its restart."""
    odometer, motion = OdometryBuffer(), MountAndOdometry("base_link", "odom")
    for k in range(int(min(ran, 12) * 20)):
        stamp = round((ran - min(ran, 12)) * SECOND) + k * SECOND // 20
        odometer.add(dead(stamp, [k, 0, 0]))
        motion.add_tf(tf(("odom", "base_link", (k, 0, 0), turned(), stamp)))
    for k in range(5):
        odometer.add(dead(k * SECOND // 20, [0.1 * k, 0, 0], [2.0, 0, 0]))
        motion.add_tf(tf(("odom", "base_link", (0.1 * k, 0, 0), turned(), k * SECOND // 20)))
    for found in (odometer.at(SECOND // 8), motion.at(SECOND // 8)):
        np.testing.assert_allclose(found.pose, [0.25, 0, 0], atol=1e-9)
    assert abs(odometer.at(SECOND // 5).pose[0] - 0.4) < 1e-9  # the odometry before the restart has no influence


def test_odometry_by_tf():
    """The base is 0.5 m ahead of the child frame of the odometry."""
    motion = MountAndOdometry("base_link", "odom")
    motion.add_tf(tf(("wheels", "base_link", (0.5, 0, 0), turned(), 0)))
    for k in range(3):
        motion.add_tf(tf(("odom", "wheels", (0.1 * k, 0, 0), turned(yaw=0.2 * k), k * SECOND // 10)))
    found = motion.at(2 * SECOND // 10)
    np.testing.assert_allclose(found.pose, se2.compose([0.2, 0, 0.4], [0.5, 0, 0]))
    assert found.twist[2] == pytest.approx(2.0)
    motion.add_odometry(dead(2 * SECOND // 10, [7, 7, 0]))
    assert motion.at(2 * SECOND // 10).pose[0] == 7  # for the estimator, the topic has priority
    assert motion.at_by_tf(2 * SECOND // 10).pose[0] == found.pose[0]  # but the published transform has to match tf
