"""The mount and the odometry, from a topic or from tf."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.geometry import se2
from common.messages.ros_messages import Mount, Transform, mount_of
from services.bridge_ros2.frames import DeadReckoning, LatestTransforms, OdometryBuffer


class NoMountError(ValueError):
    """tf does not, or not yet, contain the scanner's mount."""


class MountAndOdometry:
    """The scanner's mount and the odometry of one robot, from topics and from tf."""

    def __init__(self, base: str, odom: str, mount: Mount | None = None) -> None:
        """``base`` and ``odom`` are names of frames. ``mount`` is the scanner's; defaults to the one in tf."""
        self.base, self.odom = base.strip("/"), odom.strip("/")
        self.frames = LatestTransforms()
        self._configured_mount = mount
        self._mount = mount  # the last one used
        self._by_topic, self._by_tf = OdometryBuffer(), OdometryBuffer()
        self._last: DeadReckoning | None = None  # from tf
        # Child frame of the odometry if tf does not connect it with the base. It is then taken for the base.
        self.unconnected_frame = ""

    def mount(self) -> Mount | None:
        """The scanner's mount, or None as long as it is unknown."""
        return self._mount

    def mount_for(self, frame: str) -> Mount:
        """The scanner's mount, for scans in ``frame``.

        Raises NoMountError if tf does not contain it, or ValueError if the scanner is inclined.
        """
        if self._configured_mount is not None:
            return self._configured_mount
        frame = frame.strip("/")
        transform = self.frames.find(frame, self.base)
        if transform is None:
            known = ", ".join(self.frames.names()[:12]) or "none"
            raise NoMountError(
                f"tf does not connect {frame or 'their empty frame'} with {self.base} (--base-frame); frames: {known}; "
                "--mount x,y[,yaw_deg] says it without tf"
            )
        self._mount = mount_of(transform)
        return self._mount

    def child_in_base(self, child: str) -> Transform | None:
        """Pose of the odometry's child frame in the base.

        Returns None if the child frame is the base, or if tf does not connect them, which sets `unconnected_frame`.
        """
        child = child.strip("/")
        found = None if child in ("", self.base) else self.frames.find(child, self.base)
        self.unconnected_frame = "" if found is not None or child == self.base else child
        return found

    def add_odometry(self, odometry: DeadReckoning) -> None:
        """Adds odometry from the topic."""
        self._by_topic.add(odometry)

    def add_tf(self, message: Any) -> None:
        """Adds a tf message: fixed joints, and odometry if it contains the odom frame."""
        for parent, child, stamp_ns, transform in self.frames.add(message):
            if parent != self.odom:
                continue
            # None for a child that is not part of the robot, such as a tracked person.
            base = self.frames.find_below(child, self.base)
            if base is not None:
                self._add_tf_odometry(stamp_ns, transform.then(base))

    def _add_tf_odometry(self, stamp_ns: int, base_in_odom: Transform) -> None:
        """Adds odometry from tf, with the mean velocity since the last one, because tf has no velocities."""
        pose, twist, last = base_in_odom.planar(), np.zeros(3), self._last
        if last is not None and 0 < (elapsed := (stamp_ns - last.stamp_ns) * 1e-9) < 1:
            twist = se2.between(last.pose, pose) / elapsed
        self._last = DeadReckoning(stamp_ns, pose, twist, np.zeros((3, 3)))
        self._by_tf.add(self._last)

    def at(self, stamp_ns: int) -> DeadReckoning | None:
        """Odometry for the estimator: from tf only while none comes on the topic, because the two may drift apart."""
        return (self._by_topic if self._by_topic.is_alive(stamp_ns) else self._by_tf).at(stamp_ns)

    def at_by_tf(self, stamp_ns: int) -> DeadReckoning | None:
        """Odometry that the transform from map to odom must match: from the topic only while none comes in tf."""
        return (self._by_tf if self._by_tf.is_alive(stamp_ns) else self._by_topic).at(stamp_ns)
