"""Reads stamps, transforms and scanner mounts from ROS messages, however decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from common.geometry.se2 import Array

TILT = np.deg2rad(5)  # a scanner inclined by more does not see a plane of the map


@dataclass(frozen=True)
class Transform:
    """Pose of a child frame in its parent."""

    translation: Array  # (3,) m
    rotation: Array  # (3, 3)

    def then(self, child: Transform) -> Transform:
        """The child's child in this one's parent."""
        return Transform(self.translation + self.rotation @ child.translation, self.rotation @ child.rotation)

    def inverse(self) -> Transform:
        """The parent in the child."""
        return Transform(-self.rotation.T @ self.translation, self.rotation.T)

    def planar(self) -> Array:
        """(3,) x m, y m, yaw rad of the x axis."""
        return np.array([*self.translation[:2], np.arctan2(self.rotation[1, 0], self.rotation[0, 0])])

    def apart(self, other: Transform) -> float:
        """The largest difference in m, or between elements of the rotations, which is about rad."""
        moved, turned = np.abs(self.translation - other.translation), np.abs(self.rotation - other.rotation)
        return float(max(moved.max(), turned.max()))


IDENTITY = Transform(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class Mount:
    """How the scanner sits on the base."""

    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x m, y m, yaw rad in base_link, of the laser's x axis
    upside_down: bool = False  # its z axis points to the floor: angles grow clockwise seen from above


def stamp_of(header: Any) -> int:
    """Ns of a std_msgs/Header."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def read_rotation(q: Any) -> Array:
    """(3, 3) of a geometry_msgs/Quaternion; raises ValueError where it is none."""
    xyzw = np.array([q.x, q.y, q.z, q.w], float)
    norm = float(np.linalg.norm(xyzw))
    if not np.isfinite(norm) or abs(norm - 1) > 0.1:
        raise ValueError(f"quaternion {xyzw.tolist()} is no rotation")
    x, y, z, w = xyzw / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_pose(position: Any, orientation: Any) -> Transform:
    """Of a geometry_msgs/Pose or Transform; raises ValueError where a number is none."""
    translation = np.array([position.x, position.y, position.z], float)
    if not np.isfinite(translation).all():
        raise ValueError(f"position {translation.tolist()} m is not finite")
    return Transform(translation, read_rotation(orientation))


def mount_of(transform: Transform) -> Mount:
    """Of the laser in the base; raises ValueError where it is inclined: neither upright nor upside down."""
    up = float(transform.rotation[2, 2])
    if abs(up) < np.cos(TILT):
        inclined = np.rad2deg(np.arccos(np.clip(abs(up), 0, 1)))
        raise ValueError(f"the scanner is inclined by {inclined:.0f} degrees; it has to lie level, or upside down")
    x, y, yaw = (float(v) for v in transform.planar())
    return Mount((x, y, yaw), upside_down=up < 0)
