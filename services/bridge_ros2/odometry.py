"""The mount and the odometry, from a topic or from tf."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.geometry import se2
from common.messages.ros_messages import Mount, Transform, mount_of
from services.bridge_ros2.frames import DeadReckoning, LatestTransforms, OdometryBuffer


class NoMountError(ValueError):
    """Where the scanner sits is not in tf, or not yet."""


class MountAndOdometry:
    """Of one robot."""

    def __init__(self, base: str, odom: str, mount: Mount | None = None) -> None:
        """``base`` and ``odom``: names of the frames; ``mount``: of the scanner, else tf says it."""
        self.base, self.odom = base.strip("/"), odom.strip("/")
        self.frames = LatestTransforms()
        self._told = mount
        self._found = mount  # the last one used
        self._by_topic, self._by_tf = OdometryBuffer(), OdometryBuffer()
        self._last: DeadReckoning | None = None  # by tf
        self.unconnected_frame = (
            ""  # odometry's child frame where tf does not connect it with the base, whose it is taken for
        )

    def mount(self) -> Mount | None:
        """The scanner's, once it is known."""
        return self._found

    def mount_for(self, frame: str) -> Mount:
        """Of a scanner whose scans name ``frame``; raises NoMountError, or ValueError where it is inclined."""
        if self._told is not None:
            return self._told
        frame = frame.strip("/")
        transform = self.frames.find(frame, self.base)
        if transform is None:
            there = ", ".join(self.frames.names()[:12]) or "none"
            raise NoMountError(
                f"tf does not connect {frame or 'their empty frame'} with {self.base} (--base-frame); frames: {there}; "
                "--mount x,y[,yaw_deg] says it without tf"
            )
        self._found = mount_of(transform)
        return self._found

    def child_in_base(self, child: str) -> Transform | None:
        """Of an odometry's child frame; None where it is the base, or tf does not know better: then `unconnected_frame`."""
        child = child.strip("/")
        found = None if child in ("", self.base) else self.frames.find(child, self.base)
        self.unconnected_frame = "" if found is not None or child == self.base else child
        return found

    def add_odometry(self, dead: DeadReckoning) -> None:
        """By topic."""
        self._by_topic.add(dead)

    def add_tf(self, message: Any) -> None:
        """Fixed joints, and the base's odometry if it is there."""
        for parent, child, stamp_ns, transform in self.frames.add(message):
            if parent != self.odom:
                continue
            base = self.frames.find(self.base, child)
            if base is not None:
                self._reckon(stamp_ns, transform.then(base))

    def _reckon(self, stamp_ns: int, base_in_odom: Transform) -> None:
        """The velocity, which tf does not say, is that since the last."""
        pose, twist, last = base_in_odom.planar(), np.zeros(3), self._last
        if last is not None and 0 < (passed := (stamp_ns - last.stamp_ns) * 1e-9) < 1:
            twist = se2.between(last.pose, pose) / passed
        self._last = DeadReckoning(stamp_ns, pose, twist, np.zeros((3, 3)))
        self._by_tf.add(self._last)

    def at(self, stamp_ns: int) -> DeadReckoning | None:
        """Dead reckoning for the estimator: by topic, else by tf."""
        return self._by_topic.at(stamp_ns) or self._by_tf.at(stamp_ns)

    def at_by_tf(self, stamp_ns: int) -> DeadReckoning | None:
        """What the transform from map to odom has to fit: tf's own odometry, else the topic's."""
        return self._by_tf.at(stamp_ns) or self._by_topic.at(stamp_ns)
