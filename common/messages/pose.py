"""Pose and velocity as parts of messages."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.limits import Angle, Coordinate, Speed
from common.messages.wire import Message


class Pose(Message):
    """A pose in the plane, in the frame that the containing field states."""

    x: Coordinate  # m
    y: Coordinate  # m
    yaw: Angle = 0.0  # rad, counter-clockwise from x

    def array(self) -> npt.NDArray[np.float64]:
        """(3,) x, y, yaw in m and rad."""
        return np.array([self.x, self.y, self.yaw])

    @classmethod
    def of(cls, pose: npt.ArrayLike) -> Pose:
        """Creates a pose from (3,) x, y, yaw in m and rad."""
        x, y, yaw = np.asarray(pose, float)
        return cls(x=float(x), y=float(y), yaw=float(yaw))


class Twist(Message):
    """A velocity in base_link (geometry_msgs/Twist, in the plane)."""

    vx: Speed = 0.0  # m/s, forward
    vy: Speed = 0.0  # m/s, left; 0 for a differential drive
    wz: Speed = 0.0  # rad/s, counter-clockwise

    def array(self) -> npt.NDArray[np.float64]:
        """(3,) vx, vy, wz in m/s and rad/s."""
        return np.array([self.vx, self.vy, self.wz])
