"""Conversion of presage messages to ROS messages."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.occupancy_grid import OccupancyGrid
from common.messages.definitions import Pose
from services.bridge_ros2 import to_ros
from services.bridge_ros2.ros_types import OCCUPANCY_GRID, encode
from tests.bridge_ros2 import cdr
from tests.bridge_ros2.messages import belief


def test_covariance():
    """ROS has x, y, z, roll, pitch, yaw; only x, y and yaw are known."""
    covariance = to_ros.pose_message(belief(), "map").pose.covariance.reshape(6, 6)
    planar = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
    assert planar.tolist() == [[0.01, 0.002, 0.003], [0.002, 0.04, 0.005], [0.003, 0.005, 0.09]]
    assert np.count_nonzero(covariance) == 9


def test_no_covariance():
    assert to_ros.pose_message(belief(covariance=False), "map") is None


@pytest.mark.parametrize("state", ["localising", "ambiguous", "lost"])
def test_untracked_robot(state):
    assert not to_ros.is_publishable(belief(state))
    assert to_ros.is_publishable(belief())


def test_map_to_odom():
    odometry, pose = np.array([1.0, 2.0, 3.0]), Pose(x=-4.0, y=5.0, yaw=-2.0)
    np.testing.assert_allclose(se2.compose(to_ros.correction(pose, odometry), odometry), pose.array())
    np.testing.assert_array_equal(to_ros.correction(pose, None), pose.array())


def test_map():
    """Cells are listed by row from the lower left corner: 0 free, 100 occupied, -1 unknown."""
    grid = OccupancyGrid.of(np.array([[0, 100, 255], [0, 0, 0]], np.uint8), 0.05, (-1.0, 2.0, np.pi / 2))
    read = cdr.decode(OCCUPANCY_GRID, encode(OCCUPANCY_GRID, to_ros.map_message(grid, "map")))
    assert (read.header.frame_id, read.info.width, read.info.height) == ("map", 3, 2)
    assert read.info.resolution == pytest.approx(0.05)
    assert list(read.data) == [0, 100, -1, 0, 0, 0]
    origin = read.info.origin
    assert (origin.position.x, origin.position.y) == (-1.0, 2.0)
    assert (origin.orientation.z, origin.orientation.w) == pytest.approx((np.sqrt(0.5), np.sqrt(0.5)))
