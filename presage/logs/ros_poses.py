"""Odometry and reference poses in a ROS bag."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.ros_messages import read_pose, stamp_of
from presage.logs.frame_history import FrameHistory
from presage.logs.log import Reading
from presage.logs.pose_track import PoseTrack

Lookup = Callable[[int], Array | None]  # pose (3,) at a stamp in ns, or None

BASES = ("base_link", "base_footprint")  # REP-105
MAP, ODOM = "map", "odom"  # REP-105


def no_poses(_: int) -> Array | None:
    """A lookup without poses."""
    return None


class BagPoses:
    """All poses and transforms of a bag, in memory; 32 bytes for each pose."""

    def __init__(self, *, by_logger: bool) -> None:
        """With ``by_logger``, uses the times of logging instead of the stamps in the headers."""
        self.frames = FrameHistory()
        self._by_logger = by_logger
        self._tracks: dict[str, PoseTrack] = {}  # by topic
        self._bases: dict[str, str] = {}  # child_frame_id of Odometry, by topic

    def add(self, topic: str, logged_ns: int, message: Any) -> None:
        """Adds a TFMessage, or any message with a header and a pose; ignores invalid poses."""
        if hasattr(message, "transforms"):
            for each in message.transforms:
                with contextlib.suppress(ValueError):
                    transform = read_pose(each.transform.translation, each.transform.rotation)
                    stamp_ns = self._ns(each, logged_ns)
                    self.frames.add(str(each.header.frame_id), str(each.child_frame_id), stamp_ns, transform)
            return
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        if hasattr(message, "child_frame_id"):
            self._bases[topic] = str(message.child_frame_id).lstrip("/")
        track = self._tracks.setdefault(topic, PoseTrack())
        with contextlib.suppress(ValueError):
            track.add(self._ns(message, logged_ns), read_pose(pose.position, pose.orientation).planar())

    def _ns(self, message: Any, logged_ns: int) -> int:
        return logged_ns if self._by_logger else stamp_of(message.header)

    def base(self, laser: str, odom: list[Connection], wanted: str) -> str:
        """The frame of the robot.

        ``wanted`` if given; else the first of the odometry's child frame and those of REP-105 that tf connects to the
        laser.
        """
        of_odom = [self._bases[c.topic] for c in odom if self._bases.get(c.topic)]
        candidates = [*of_odom, *BASES]
        return wanted or next((c for c in candidates if self.frames.chain(c, laser) is not None), candidates[0])

    def odometry(self, connections: list[Connection], base: str, notes: list[str]) -> tuple[str, Lookup]:
        """Returns the source of the odometry ("" if there is none) and a lookup of base in odom."""
        for topic in {c.topic for c in connections} & self._tracks.keys():
            offset = self._offset(topic, base, notes)
            return f"{topic}, interpolated", self._lookup(self._tracks[topic], offset)
        chain = self.frames.chain(ODOM, base)
        if not chain:
            return "", no_poses
        return f"tf {ODOM} -> {base}, interpolated", lambda stamp: self.frames.at(chain, stamp)

    def reference(
        self, connections: list[Connection], base: str, reading: Reading, notes: list[str]
    ) -> tuple[str, Lookup]:
        """Returns the source of the reference poses ("" if there are none) and a lookup of base in map."""
        if reading.reference is False:
            return "", no_poses
        for topic in {c.topic for c in connections} & self._tracks.keys():
            offset = self._offset(topic, base, notes)
            return f"the log's {topic}", self._lookup(self._tracks[topic], offset)
        chain = self.frames.chain(MAP, base)
        # A transform map -> odom that never changes was not published by a localisation.
        if not chain or not (chain[0].moves or reading.reference):
            return "", no_poses
        return f"the log's own localisation (tf {MAP} -> {base})", lambda stamp: self.frames.at(chain, stamp)

    def _lookup(self, track: PoseTrack, offset: Array) -> Lookup:
        def look(stamp: int) -> Array | None:
            pose = track.at(stamp)
            return None if pose is None else np.asarray(se2.compose(pose, offset))

        return look

    def _offset(self, topic: str, base: str, notes: list[str]) -> Array:
        """The base (3,) in the frame whose poses the topic has; zero with a note if tf does not connect the two."""
        child = self._bases.get(topic, "")
        offset = self._fixed_transform(child, base) if child not in ("", base) else np.zeros(3)
        if offset is None:
            notes.append(
                f"{topic} has poses of {child}, and tf does not connect {child} and {base}: assumed to be poses of "
                f"{base} (change with base_frame in section log of --config)"
            )
        return np.zeros(3) if offset is None else offset

    def _fixed_transform(self, frame: str, base: str) -> Array | None:
        """The base (3,) in another frame that is fixed to it; None if tf does not connect them or it changes."""
        for parent, child, invert in ((frame, base, False), (base, frame, True)):
            chain = self.frames.chain(parent, child)
            if chain and not any(edge.moves for edge in chain):
                pose = self.frames.at(chain, 0)
                return None if pose is None else se2.inverse(pose) if invert else pose
        return None
