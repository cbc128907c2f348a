"""The tf tree: the scanner's mount, and odometry at a given time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.ros_messages import IDENTITY, Transform, read_pose, stamp_of

HISTORY_S = 10.0  # length of the stored odometry
# A step of the stamps back by at least this much is no network delay: the clock was set back. After a smaller step the
# clock soon passes the old time again.
CLOCK_RESET_S = 1.0
MAX_EXTRAPOLATION_S = 0.2  # beyond the newest odometry
MAX_CHAIN_FRAMES = 32  # from a frame to the root of the tree


class LatestTransforms:
    """The newest transform of every child frame.

    It is only used for fixed joints, so stamps do not matter.
    """

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform]] = {}

    def add(self, message: Any) -> list[tuple[str, str, int, Transform]]:
        """Stores the transforms of a tf2_msgs/TFMessage. Skips invalid ones.

        Returns parent, child, stamp in ns and transform of each.
        """
        added = []
        for each in message.transforms[:10_000]:
            parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            try:
                transform = read_pose(each.transform.translation, each.transform.rotation)
            except ValueError:
                continue
            if child in self._parents or len(self._parents) < 10_000:
                self._parents[child] = (parent, transform)
            added.append((parent, child, stamp_of(each.header), transform))
        return added

    def find(self, child: str, base: str) -> Transform | None:
        """The pose of ``child`` in ``base``. Returns None if tf does not connect them."""
        of_child, of_base = self._chain(child), self._chain(base)
        for frame, transform in of_child.items():
            if frame in of_base:
                return of_base[frame].inverse().then(transform)
        return None

    def find_below(self, ancestor: str, frame: str) -> Transform | None:
        """The pose of a frame in its ``ancestor``. Returns None if tf does not attach it to that."""
        return self._chain(frame).get(ancestor)

    def names(self) -> list[str]:
        """Names of all known frames."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def _chain(self, frame: str) -> dict[str, Transform]:
        """The frame's pose in itself, in its parent and in each further ancestor, by the ancestor's name."""
        chain, pose = {frame: IDENTITY}, IDENTITY
        while frame in self._parents and len(chain) < MAX_CHAIN_FRAMES:
            frame, transform = self._parents[frame]
            pose = transform.then(pose)
            if frame in chain:
                break
            chain[frame] = pose
        return chain


@dataclass(frozen=True)
class DeadReckoning:
    """Dead reckoning at a stamp."""

    stamp_ns: int
    pose: Array  # (3,) base_link in odom
    twist: Array  # (3,) m/s, m/s, rad/s in base_link
    covariance: Array  # (3, 3) of x, y, yaw


class OdometryBuffer:
    """Odometry of the last seconds, which can be interpolated at any stamp."""

    def __init__(self) -> None:
        self._entries: deque[DeadReckoning] = deque()

    def add(self, entry: DeadReckoning) -> None:
        """Adds the newest odometry. Skips late entries; removes all before if the clock was set back."""
        if self._entries and entry.stamp_ns <= (newest := self._entries[-1].stamp_ns):
            if newest - entry.stamp_ns < CLOCK_RESET_S * 1e9:
                return
            self._entries.clear()
        self._entries.append(entry)
        while entry.stamp_ns - self._entries[0].stamp_ns > HISTORY_S * 1e9:
            self._entries.popleft()

    def is_alive(self, stamp_ns: int) -> bool:
        """Whether there was odometry in the last seconds before a stamp."""
        return bool(self._entries) and stamp_ns - self._entries[-1].stamp_ns <= HISTORY_S * 1e9

    def at(self, stamp_ns: int) -> DeadReckoning | None:
        """Odometry at a stamp, interpolated, or extrapolated by at most `MAX_EXTRAPOLATION_S`. Otherwise None."""
        after = None
        for entry in reversed(self._entries):
            if entry.stamp_ns <= stamp_ns:
                return self._between(entry, after, stamp_ns)
            after = entry
        return None

    @staticmethod
    def _between(before: DeadReckoning, after: DeadReckoning | None, stamp_ns: int) -> DeadReckoning | None:
        elapsed = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            moved, valid = before.twist * elapsed, elapsed <= MAX_EXTRAPOLATION_S
        else:
            span = (after.stamp_ns - before.stamp_ns) * 1e-9
            moved, valid = se2.between(before.pose, after.pose) * (elapsed / span), span <= 1.0
        if not valid:
            return None
        return DeadReckoning(stamp_ns, se2.compose(before.pose, moved), before.twist, before.covariance)
