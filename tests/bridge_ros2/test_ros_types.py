"""Bytes and hashes of ROS 2's messages, against what others publish and against another implementation of CDR."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.messages.ros_messages import stamp_of
from services.bridge_ros2 import ros_types as r
from services.bridge_ros2.to_ros import hypotheses_message, pose_message, transform_message, twist_message
from tests.bridge_ros2 import cdr
from tests.bridge_ros2.messages import belief

# As `ros2 topic info -v` of Iron and later prints them ("Topic type hash"), rosbag2 writes them into metadata.yaml
# (type_description_hash), and ROS's packages have them in share/PACKAGE/msg/NAME.json. Found in public logs and bags.
PUBLISHED = {
    r.LASER_SCAN: "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    r.ODOMETRY: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    r.TF_MESSAGE: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    r.TWIST: "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    r.TWIST_STAMPED: "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    r.POSE_STAMPED: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    r.POSE_WITH_COVARIANCE: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    r.POSE_ARRAY: "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
    r.OCCUPANCY_GRID: "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
}


def test_published_hashes():
    assert {name: r.type_hash(name) for name in r.USED} == PUBLISHED


def test_names_of_types():
    assert r.dds_name(r.LASER_SCAN) == "sensor_msgs::msg::dds_::LaserScan_"
    assert r.ros_name("sensor_msgs::msg::dds_::LaserScan_") == r.LASER_SCAN
    assert r.ros_name("something else") == "something else"


def test_bytes_of_a_twist():
    """Plain CDR (OMG DDS-RTPS 2.5, 10.2): representation 00 01, options 00 00, then six little-endian doubles."""
    _, message = twist_message(np.array([0.5, -0.25, 1.5]), None, "base_link")
    assert r.encode(r.TWIST, message) == b"\0\1\0\0" + struct.pack("<6d", 0.5, -0.25, 0, 0, 0, 1.5)


def test_bytes_of_a_header():
    """A string is its length with the final 0, its bytes and the 0; what follows is aligned to its own size."""
    _, message = twist_message(np.zeros(3), 5_000_000_007, "base")
    begins = b"\0\1\0\0" + struct.pack("<iI", 5, 7) + struct.pack("<I", 5) + b"base\0" + b"\0" * 7
    assert r.encode(r.TWIST_STAMPED, message) == begins + struct.pack("<6d", *[0.0] * 6)


def test_bytes_read_elsewhere():
    kind, twist = twist_message(np.array([0.5, 0.1, -0.2]), 3_000_000_001, "base_link")
    read = cdr.decode(kind, r.encode(kind, twist))
    assert (read.header.stamp.sec, read.header.stamp.nanosec, read.header.frame_id) == (3, 1, "base_link")
    assert (read.twist.linear.x, read.twist.linear.y, read.twist.angular.z) == (0.5, 0.1, -0.2)
    read = cdr.decode(r.POSE_WITH_COVARIANCE, r.encode(r.POSE_WITH_COVARIANCE, pose_message(belief(), "map")))
    assert (read.pose.pose.position.x, read.pose.pose.position.y) == (3.0, -1.5)
    assert read.pose.covariance[0] == 0.01
    assert len(read.pose.covariance) == 36
    read = cdr.decode(r.POSE_ARRAY, r.encode(r.POSE_ARRAY, hypotheses_message(belief(), "map")))
    assert [pose.position.x for pose in read.poses] == [3.0, 8.0]
    tf = transform_message(np.array([1.0, 2.0, np.pi / 2]), 7, "map", "odom")
    (read,) = cdr.decode(r.TF_MESSAGE, r.encode(r.TF_MESSAGE, tf)).transforms
    assert (read.header.frame_id, read.child_frame_id, read.transform.translation.y) == ("map", "odom", 2.0)
    assert read.transform.rotation.z == pytest.approx(np.sqrt(0.5))


@given(
    st.lists(st.floats(width=32, allow_nan=False), min_size=0, max_size=40),
    st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9),
    st.integers(0, 2**31 - 1),
)
def test_bytes_written_elsewhere(ranges, frame, sec):
    """Of every length of the frame's name, which moves what follows."""
    payload = cdr.laser_scan(sec * 10**9 + 5, ranges, frame, intensities=ranges[:3])
    message = r.decode(r.LASER_SCAN, payload)
    assert stamp_of(message.header) == sec * 10**9 + 5
    assert message.header.frame_id == frame
    np.testing.assert_array_equal(message.ranges, np.array(ranges, np.float32))
    assert r.encode(r.LASER_SCAN, message) == payload


@pytest.mark.parametrize("name", [r.LASER_SCAN, r.ODOMETRY, r.TF_MESSAGE, r.POSE_STAMPED])
def test_invalid_bytes(name):
    for payload in (b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 64, b"\x06\1\0\0" + b"\0" * 500, b"not CDR at all"):
        with pytest.raises(r.CdrError, match=name):
            r.decode(name, payload)
