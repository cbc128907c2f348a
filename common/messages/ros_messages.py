"""Reads stamps, transforms and scanner mounts from ROS messages, however decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from common.geometry.se2 import Array

MAX_TILT_RAD = np.deg2rad(5)  # the scan plane of a scanner tilted further does not match a planar map


@dataclass(frozen=True)
class Transform:
    """Pose of a child frame in its parent frame."""

    translation: Array  # (3,) m
    rotation: Array  # (3, 3)

    def then(self, child: Transform) -> Transform:
        """Pose in this parent frame of a frame whose pose in this child frame is ``child``."""
        return Transform(self.translation + self.rotation @ child.translation, self.rotation @ child.rotation)

    def inverse(self) -> Transform:
        """Pose of the parent in the child."""
        return Transform(-self.rotation.T @ self.translation, self.rotation.T)

    def planar(self) -> Array:
        """(3,) projection to the plane: x and y in m, yaw of the x axis in rad."""
        return np.array([*self.translation[:2], np.arctan2(self.rotation[1, 0], self.rotation[0, 0])])

    def difference(self, other: Transform) -> float:
        """Largest difference between the translations (m) or elements of the rotation matrices (about rad)."""
        moved, turned = np.abs(self.translation - other.translation), np.abs(self.rotation - other.rotation)
        return float(max(moved.max(), turned.max()))


IDENTITY = Transform(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class Mount:
    """Mounting of the scanner on the base."""

    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x m, y m, yaw rad of the laser's x axis, in base_link
    upside_down: bool = False  # the z axis points to the floor, so angles increase clockwise seen from above


def stamp_of(header: Any) -> int:
    """Stamp of a std_msgs/Header in ns."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def read_rotation(q: Any) -> Array:
    """(3, 3) rotation matrix of a geometry_msgs/Quaternion; raises ValueError if it is not a unit quaternion."""
    xyzw = np.array([q.x, q.y, q.z, q.w], float)
    norm = float(np.linalg.norm(xyzw))
    if not np.isfinite(norm) or abs(norm - 1) > 0.1:
        raise ValueError(f"quaternion {xyzw.tolist()} is not a rotation")
    x, y, z, w = xyzw / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_pose(position: Any, orientation: Any) -> Transform:
    """Reads a geometry_msgs/Pose or Transform; raises ValueError if it is not finite or not a rotation."""
    translation = np.array([position.x, position.y, position.z], float)
    if not np.isfinite(translation).all():
        raise ValueError(f"position {translation.tolist()} m is not finite")
    return Transform(translation, read_rotation(orientation))


def mount_of(transform: Transform) -> Mount:
    """Mounting of a scanner from the pose of its frame in the base.

    Raises ValueError if it is neither level nor upside down.
    """
    up = float(transform.rotation[2, 2])
    if abs(up) < np.cos(MAX_TILT_RAD):
        tilt = np.rad2deg(np.arccos(np.clip(abs(up), 0, 1)))
        raise ValueError(f"the scanner is inclined by {tilt:.0f} degrees; it has to be mounted level or upside down")
    x, y, yaw = (float(v) for v in transform.planar())
    return Mount((x, y, yaw), upside_down=up < 0)


def plausible_time_increment(scan: Any) -> float:
    """Time between two beams of a LaserScan in s; 0 if the driver states none, or one longer than the scan takes."""
    increment, longest = float(scan.time_increment), float(scan.scan_time)
    longest = longest if 0 < longest < 1 else 1.0
    return increment if 0 < increment * (len(scan.ranges) - 1) <= longest else 0.0
