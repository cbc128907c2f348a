"""The tree of frames, and interpolated poses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from common.errors import UserError
from common.messages.ros_messages import Transform, read_rotation
from presage.logs.frame_history import FrameHistory
from presage.logs.pose_track import PoseTrack

SECOND = 1_000_000_000


def transform(x=0.0, y=0.0, yaw=0.0, roll=0.0):
    a, b = yaw / 2, roll / 2
    turn = [np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)]
    rotation = read_rotation(SimpleNamespace(**dict(zip("xyzw", turn, strict=True))))
    return Transform(np.array([x, y, 0.3]), rotation)


def test_mount_over_several_frames():
    frames = FrameHistory()
    frames.add("base_link", "plate", 0, transform(0.2, 0.1, np.pi / 2))
    frames.add("/plate", "/laser", 0, transform(0.1, 0.0, 0.0, np.pi))  # ROS 1 began names with a slash
    mount = frames.mount("base_link", "laser")
    np.testing.assert_allclose(mount.pose, [0.2, 0.2, np.pi / 2], atol=1e-12)
    assert mount.upside_down
    assert frames.mount("base_link", "camera") is None
    assert frames.mount("laser", "base_link") is None


def test_mount_refusals():
    frames = FrameHistory()
    frames.add("base_link", "tilted", 0, transform(roll=np.deg2rad(15)))
    with pytest.raises(UserError, match=r"tilted on base_link: the scanner is inclined by 15 degrees.*--mount"):
        frames.mount("base_link", "tilted")
    for k in range(3):
        frames.add("base_link", "nodding", k, transform(yaw=0.1 * k))
    with pytest.raises(UserError, match="moves against base_link"):
        frames.mount("base_link", "nodding")


def test_frame_in_two_parents():
    """Two kinds of odometry, published in turn."""
    frames = FrameHistory()
    for k in range(10):
        for parent, speed in (("odom", 1.0), ("odom_combined", 2.0)):
            frames.add(parent, "base_link", k * SECOND, transform(speed * k))
    frames.add("base_link", "laser", 0, transform(0.5))
    for parent, speed in (("odom", 1.0), ("odom_combined", 2.0)):
        pose = frames.at(frames.chain(parent, "laser"), 4 * SECOND)
        np.testing.assert_allclose(pose, [4 * speed + 0.5, 0, 0], atol=1e-12)


def test_cycles_of_frames():
    frames = FrameHistory()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a"), ("d", "d")):
        frames.add(parent, child, 0, transform())
    assert frames.chain("map", "c") is None
    assert frames.chain("d", "d") == []


def test_interpolation():
    track = PoseTrack()
    for seconds, yaw in ((2, -3.0), (1, 3.0), (4, 0.0)):  # in any order
        track.add(seconds * SECOND, np.array([seconds, 0.0, yaw]))
    track.add(3 * SECOND, np.array([np.nan, 0, 0]))
    middle = track.at(SECOND + SECOND // 2)
    assert middle[0] == 1.5
    assert abs(middle[2]) == pytest.approx(np.pi)  # by the shorter turn
    assert track.at(2 * SECOND).tolist() == [2, 0, -3]
    assert [track.at(stamp * SECOND) for stamp in (0, 3, 5)] == [None, None, None]
    assert PoseTrack().at(0) is None


def test_standing_still_takes_no_memory():
    track, still = PoseTrack(), np.array([1.0, 2.0, 3.0])
    for k in range(1000):
        track.add(k * SECOND // 100, still)
    assert len(track) < 25
    assert all(track.at(k * SECOND // 100 + 7).tolist() == [1, 2, 3] for k in range(999))
