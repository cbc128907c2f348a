"""tf and odometry: where the scanner sits on the robot, and where the odometry had the robot at a moment. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from common import se2
from common.se2 import Array

TILT = np.deg2rad(5)  # a scanner inclined by more does not see a plane of the map
KEPT = 10.0  # s of odometry
ANEW = 1.0  # s; no network delays by more, so the clock was set back; by less, and it is soon past the old time
BEYOND = 0.2  # s by which the newest odometry is carried on
LONGEST = 32  # frames from the scanner to the base


@dataclass(frozen=True)
class Transform:
    """Pose of a child frame in its parent."""

    translation: Array  # (3,) m
    rotation: Array  # (3, 3)

    def then(self, child: Transform) -> Transform:
        """The child's child in this one's parent."""
        return Transform(self.translation + self.rotation @ child.translation, self.rotation @ child.rotation)

    def planar(self) -> Array:
        """(3,) x m, y m, yaw rad of the x axis."""
        return np.array([*self.translation[:2], np.arctan2(self.rotation[1, 0], self.rotation[0, 0])])


IDENTITY = Transform(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class Mount:
    """How the scanner sits on the base."""

    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x m, y m, yaw rad in base_link, of the laser's x axis
    upside_down: bool = False  # its z axis points to the floor: angles grow clockwise seen from above


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
        raise ValueError(f"position {translation.tolist()} is not finite")
    return Transform(translation, read_rotation(orientation))


class Frames:
    """The newest transform of every child frame. Fixed joints are all that is asked for, so time does not matter."""

    def __init__(self) -> None:
        """Nothing is known."""
        self._parents: dict[str, tuple[str, Transform]] = {}

    def hear(self, message: Any) -> list[tuple[str, str, int, Transform]]:
        """Parent, child, stamp and transform of each in a tf2_msgs/TFMessage, kept; what is none is left out."""
        heard = []
        for each in message.transforms[:10_000]:
            parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            try:
                transform = read_pose(each.transform.translation, each.transform.rotation)
            except ValueError:
                continue
            if child in self._parents or len(self._parents) < 10_000:
                self._parents[child] = (parent, transform)
            stamp = int(each.header.stamp.sec) * 10**9 + int(each.header.stamp.nanosec)
            heard.append((parent, child, stamp, transform))
        return heard

    def find(self, child: str, base: str) -> Transform | None:
        """The pose of ``child`` in ``base``, over frames they have in common; None where they are not connected."""
        up, down = self._chain(child), self._chain(base)
        for frame, transform in up.items():
            if frame in down:
                return _inverse(down[frame]).then(transform)
        return None

    def names(self) -> list[str]:
        """All frames there are."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def _chain(self, frame: str) -> dict[str, Transform]:
        """The frame's pose in itself, its parent, and so on."""
        chain, pose = {frame: IDENTITY}, IDENTITY
        while frame in self._parents and len(chain) < LONGEST:
            frame, transform = self._parents[frame]
            pose = transform.then(pose)
            if frame in chain:
                break
            chain[frame] = pose
        return chain


def _inverse(a: Transform) -> Transform:
    return Transform(-a.rotation.T @ a.translation, a.rotation.T)


def mount_of(transform: Transform) -> Mount:
    """Raises ValueError where the scanner is inclined: neither upright nor upside down."""
    up = float(transform.rotation[2, 2])
    if abs(up) < np.cos(TILT):
        inclined = np.rad2deg(np.arccos(np.clip(abs(up), 0, 1)))
        raise ValueError(f"the scanner is inclined by {inclined:.0f} degrees; it has to lie level, or upside down")
    x, y, yaw = (float(v) for v in transform.planar())
    return Mount((x, y, yaw), upside_down=up < 0)


@dataclass(frozen=True)
class Dead:
    """Dead reckoning at a moment."""

    stamp_ns: int
    pose: Array  # (3,) base_link in odom
    twist: Array  # (3,) m/s, m/s, rad/s in base_link
    covariance: Array  # (3, 3) of x, y, yaw


class Odometer:
    """Odometry of the last seconds, at any moment between."""

    def __init__(self) -> None:
        """None has come."""
        self._kept: deque[Dead] = deque()

    def hear(self, dead: Dead) -> None:
        """What comes out of order is left out; where the clock was set back (a simulation anew), all before."""
        if self._kept and dead.stamp_ns <= (newest := self._kept[-1].stamp_ns):
            if newest - dead.stamp_ns < ANEW * 1e9:
                return
            self._kept.clear()
        self._kept.append(dead)
        while dead.stamp_ns - self._kept[0].stamp_ns > KEPT * 1e9:
            self._kept.popleft()

    def at(self, stamp_ns: int) -> Dead | None:
        """Between two, on the way; after the newest, carried on with its velocity for `BEYOND` s; None elsewhere."""
        after = None
        for dead in reversed(self._kept):
            if dead.stamp_ns <= stamp_ns:
                return self._between(dead, after, stamp_ns)
            after = dead
        return None

    @staticmethod
    def _between(before: Dead, after: Dead | None, stamp_ns: int) -> Dead | None:
        passed = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            moved, known = before.twist * passed, passed <= BEYOND
        else:
            span = (after.stamp_ns - before.stamp_ns) * 1e-9
            moved, known = se2.between(before.pose, after.pose) * (passed / span), span <= 1.0
        if not known:
            return None
        return Dead(stamp_ns, se2.compose(before.pose, moved), before.twist, before.covariance)
