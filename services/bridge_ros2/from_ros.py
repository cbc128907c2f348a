"""Converts ROS messages to presage messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import ValidationError

from common.errors import first_fault
from common.geometry import se2
from common.geometry.se2 import Array
from common.limits import MAX_BEAMS, MAX_COORDINATE_M, MAX_DISTANCE_M, MAX_SPEED
from common.messages.definitions import Odom, Pose, Scan, Twist
from common.messages.ros_messages import Mount, Transform, plausible_time_increment, read_pose, stamp_of
from common.robot.ranges import normalise_driver_ranges
from services.bridge_ros2.frames import DeadReckoning

PLANE = [0, 1, 5]  # indices of x, y, yaw in the 6 x 6 covariance of a ROS pose


def scan_of(message: Any, mount: Mount, stamp_ns: int) -> Scan:
    """Converts a sensor_msgs/LaserScan to a Scan with counter-clockwise beams. Raises ValueError if it is invalid.

    The beams of a scanner that is mounted upside down or turns clockwise are reversed. Ranges are converted by
    `common.robot.ranges`.
    """
    beams = len(message.ranges)
    first, step = float(message.angle_min), float(message.angle_increment)
    if not 2 <= beams <= MAX_BEAMS:
        raise ValueError(f"a scan of {beams} beams, not 2 to {MAX_BEAMS}")
    if step == 0:  # some drivers do not set it
        step = (float(message.angle_max) - first) / (beams - 1)
    nearest, farthest = float(message.range_min), float(message.range_max)
    if not np.isfinite([first, step, nearest]).all() or step == 0 or not farthest > max(nearest, 0.0):
        raise ValueError(
            f"angles from {first:g} by {step:g} rad, ranges from {nearest:g} to {farthest:g} m: no scanner has those"
        )
    farthest = min(farthest, MAX_DISTANCE_M)  # some drivers write the largest float, or infinity, for "no limit"
    ranges = np.asarray(message.ranges, np.float32)
    side = -1.0 if mount.upside_down else 1.0
    first, step = side * first, side * step
    period = float(message.scan_time)
    period = period if 0 < period < 3600 else 0.0
    time_increment = plausible_time_increment(message)
    if step < 0:
        first, step, ranges = first + step * (beams - 1), -step, ranges[::-1]
        time_increment = -time_increment
    return Scan(
        stamp_ns=stamp_ns,
        angle_min=float(se2.wrap(first)),
        angle_increment=step,
        range_min=max(nearest, 0.0),
        range_max=farthest,
        ranges=normalise_driver_ranges(ranges, nearest, farthest),
        mount=Pose.of(mount.pose),
        scan_time=period,
        time_increment=time_increment,
        frame_id=(message.header.frame_id or "laser")[:64],
    )


def dead_reckoning_of(message: Any, child_in_base: Transform | None) -> DeadReckoning:
    """Converts a nav_msgs/Odometry to the pose and velocity of the base. Raises ValueError if it is invalid.

    ``child_in_base`` is the pose of the message's child frame in the base, or None if the child frame is the base.
    """
    pose = read_pose(message.pose.pose.position, message.pose.pose.orientation).planar()
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    twist = np.array([linear.x, linear.y, angular.z], float)
    if not (np.abs(twist) <= MAX_SPEED).all():
        raise ValueError(f"velocity {twist.tolist()} (m/s, m/s, rad/s) is not finite, or above {MAX_SPEED:g}")
    if child_in_base is not None:
        child = child_in_base.planar()
        pose = se2.compose(pose, se2.inverse(child))
        x, y = se2.rotate(float(child[2]), twist[:2])
        twist = np.array([x + twist[2] * child[1], y - twist[2] * child[0], twist[2]])
    if not (np.abs(pose[:2]) <= MAX_COORDINATE_M).all():
        x, y = pose[:2]
        raise ValueError(f"the odometry is at ({x:g}, {y:g}) m, more than {MAX_COORDINATE_M:g} m from its origin")
    return DeadReckoning(stamp_of(message.header), pose, twist, _covariance(message.pose.covariance))


def _covariance(six: Any) -> Array:
    """Covariance (3, 3) of x, y, yaw; zeros, which mean unknown in ROS, if a value is not finite."""
    found = np.asarray(six, float).reshape(6, 6)[np.ix_(PLANE, PLANE)]
    return found if np.isfinite(found).all() else np.zeros((3, 3))


def odom_of(odometry: DeadReckoning) -> Odom:
    """Converts dead reckoning to an Odom message."""
    vx, vy, wz = (float(v) for v in odometry.twist)
    return Odom(
        stamp_ns=odometry.stamp_ns,
        pose=Pose.of(odometry.pose),
        twist=Twist(vx=vx, vy=vy, wz=wz),
        covariance=odometry.covariance,
    )


def pose_of(message: Any, frame: str) -> Pose:
    """Pose of a PoseStamped or PoseWithCovarianceStamped. Raises ValueError if it is not in ``frame``."""
    frame_id = message.header.frame_id.strip("/")
    if frame_id not in ("", frame):
        raise ValueError(f"it is in the frame {frame_id!r}, not {frame!r}: in rviz set the fixed frame to {frame}")
    pose = getattr(message.pose, "pose", message.pose)
    try:
        return Pose.of(read_pose(pose.position, pose.orientation).planar())
    except ValidationError as error:
        raise ValueError(first_fault(error)) from None
