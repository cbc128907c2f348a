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
from presage.logs.poses import Track

Lookup = Callable[[int], Array | None]  # of a stamp in ns; (3,) or None

BASES = ("base_link", "base_footprint")  # REP-105
MAP, ODOM = "map", "odom"


def nothing(_: int) -> Array | None:
    """Where there are no poses."""
    return None


class Poses:
    """Everything but the scans: 32 bytes a pose in memory."""

    def __init__(self, *, by_logger: bool) -> None:
        """``by_logger``: times are those of logging, not those in the headers."""
        self.frames = FrameHistory()
        self._by_logger = by_logger
        self._tracks: dict[str, Track] = {}  # by topic
        self._bases: dict[str, str] = {}  # child_frame_id of Odometry, by topic

    def take(self, topic: str, logged_ns: int, message: Any) -> None:
        """A TFMessage, or any message with a header and a pose; what is no pose is left out."""
        if hasattr(message, "transforms"):
            for each in message.transforms:
                with contextlib.suppress(ValueError):
                    transform = read_pose(each.transform.translation, each.transform.rotation)
                    at = self._ns(each, logged_ns)
                    self.frames.add(str(each.header.frame_id), str(each.child_frame_id), at, transform)
            return
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        if hasattr(message, "child_frame_id"):
            self._bases[topic] = str(message.child_frame_id).lstrip("/")
        track = self._tracks.setdefault(topic, Track())
        with contextlib.suppress(ValueError):
            track.add(self._ns(message, logged_ns), read_pose(pose.position, pose.orientation).planar())

    def _ns(self, message: Any, logged_ns: int) -> int:
        return logged_ns if self._by_logger else stamp_of(message.header)

    def base(self, laser: str, odom: list[Connection], wanted: str) -> str:
        """The frame of the robot: as asked for, odometry's child frame, or one of REP-105's on which the laser sits."""
        of_odom = [self._bases[c.topic] for c in odom if self._bases.get(c.topic)]
        candidates = [*of_odom, *BASES]
        return wanted or next((c for c in candidates if self.frames.chain(c, laser) is not None), candidates[0])

    def odometry(self, connections: list[Connection], base: str, notes: list[str]) -> tuple[str, Lookup]:
        """What it is, empty where there is none, and the base in odom at a time."""
        for topic in {c.topic for c in connections} & self._tracks.keys():
            # Odometry of another frame of the robot is that of the base, seen from there.
            offset = self._offset(topic, base, notes)
            return f"{topic}, interpolated", self._of(self._tracks[topic], offset)
        chain = self.frames.chain(ODOM, base)
        if not chain:
            return "", nothing
        return f"tf {ODOM} -> {base}, interpolated", lambda stamp: self.frames.at(chain, stamp)

    def reference(
        self, connections: list[Connection], base: str, reading: Reading, notes: list[str]
    ) -> tuple[str, Lookup]:
        """What it is, empty where there is none, and the base in map at a time."""
        if reading.reference is False:
            return "", nothing
        for topic in {c.topic for c in connections} & self._tracks.keys():
            offset = self._offset(topic, base, notes)
            return f"the log's {topic}", self._of(self._tracks[topic], offset)
        chain = self.frames.chain(MAP, base)
        # A map -> odom that never moves is nobody's localisation.
        if not chain or not (chain[0].moves or reading.reference):
            return "", nothing
        return f"the log's own localisation (tf {MAP} -> {base})", lambda stamp: self.frames.at(chain, stamp)

    def _of(self, track: Track, offset: Array) -> Lookup:
        def look(stamp: int) -> Array | None:
            pose = track.at(stamp)
            return None if pose is None else np.asarray(se2.compose(pose, offset))

        return look

    def _offset(self, topic: str, base: str, notes: list[str]) -> Array:
        """(3,) the base in the frame whose poses a topic has; where tf does not say, they are taken for the base's."""
        child = self._bases.get(topic, "")
        offset = self._fixed(child, base) if child not in ("", base) else np.zeros(3)
        if offset is None:
            notes.append(
                f"{topic} has poses of {child}, and tf does not say where that sits on {base}: they are taken for "
                f"{base}'s (--base-frame)"
            )
        return np.zeros(3) if offset is None else offset

    def _fixed(self, frame: str, base: str) -> Array | None:
        """(3,) the base in another frame bolted to it; None where tf does not say."""
        for parent, child, turn in ((frame, base, False), (base, frame, True)):
            chain = self.frames.chain(parent, child)
            if chain and not any(edge.moves for edge in chain):
                pose = self.frames.at(chain, 0)
                return None if pose is None else se2.inverse(pose) if turn else pose
        return None
