"""Converts presage messages to ROS messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.geometry import se2
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.se2 import Array
from common.messages.definitions import Belief, Pose
from services.bridge_ros2.from_ros import PLANE
from services.bridge_ros2.ros_types import (
    OCCUPANCY_GRID,
    POSE_ARRAY,
    POSE_WITH_COVARIANCE,
    TWIST,
    TWIST_STAMPED,
    header,
    make,
)


def is_publishable(belief: Belief) -> bool:
    """Whether the pose of a belief is published to ROS: only while the robot is tracked, not if lost or ambiguous."""
    return belief.state == "tracking"


def pose_message(belief: Belief, frame: str) -> Any | None:
    """PoseWithCovarianceStamped at the scan's stamp. Returns None if the belief has no covariance.

    In the 6 x 6 covariance, the rows and columns of x, y and yaw are those of the belief. All others are 0, as in AMCL.
    """
    if belief.covariance is None:
        return None
    six = np.zeros((6, 6))
    six[np.ix_(PLANE, PLANE)] = belief.covariance
    pose = make("geometry_msgs/msg/PoseWithCovariance", pose=_pose(belief.pose), covariance=six.ravel())
    return make(POSE_WITH_COVARIANCE, header=header(belief.stamp_ns, frame), pose=pose)


def hypotheses_message(belief: Belief, frame: str) -> Any:
    """PoseArray of the belief's hypotheses, the best first."""
    poses = [each.pose for each in belief.hypotheses] or [belief.pose]
    return make(POSE_ARRAY, header=header(belief.stamp_ns, frame), poses=[_pose(each) for each in poses])


def correction(belief: Pose, odometry: Array | None) -> Array:
    """Pose (3,) of odom in map, such that odometry (3,) of the same stamp leads to the belief.

    Without odometry, the pose of base_link in map.
    """
    return belief.array() if odometry is None else se2.compose(belief.array(), se2.inverse(odometry))


def transform_message(pose: Array, stamp_ns: int, parent: str, child: str) -> Any:
    """TFMessage of one transform."""
    transform = make(
        "geometry_msgs/msg/Transform",
        translation=_vector(float(pose[0]), float(pose[1])),
        rotation=_quaternion(float(pose[2])),
    )
    stamped = make(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=transform,
    )
    return make("tf2_msgs/msg/TFMessage", transforms=[stamped])


def map_message(grid: OccupancyGrid, frame: str) -> Any:
    """OccupancyGrid as published by nav2's map_server, except for the stamp, which is 0."""
    x, y, yaw = grid.origin
    info = make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=header(0, frame).stamp,
        resolution=grid.resolution,
        width=grid.width,
        height=grid.height,
        origin=_pose(Pose(x=x, y=y, yaw=yaw)),
    )
    cells = grid.values.ravel().view(np.int8)  # the unsigned 255 becomes -1, which means unknown
    return make(OCCUPANCY_GRID, header=header(0, frame), info=info, data=cells)


def twist_message(twist: Array, stamp_ns: int | None, frame: str) -> tuple[str, Any]:
    """Type and message of a velocity (3,) in base_link: TwistStamped, or Twist if ``stamp_ns`` is None."""
    vx, vy, wz = (float(v) for v in twist)
    plain = make(TWIST, linear=_vector(vx, vy), angular=_vector(0.0, 0.0, wz))
    if stamp_ns is None:
        return TWIST, plain
    return TWIST_STAMPED, make(TWIST_STAMPED, header=header(stamp_ns, frame), twist=plain)


def _vector(x: float, y: float, z: float = 0.0) -> Any:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(yaw: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))


def _pose(pose: Pose) -> Any:
    position = make("geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=0.0)
    return make("geometry_msgs/msg/Pose", position=position, orientation=_quaternion(pose.yaw))
