"""The tf tree: the scanner's mount, and odometry at a given time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.ros_messages import IDENTITY, Transform, read_pose, stamp_of

HISTORY_S = 10.0  # s of odometry
CLOCK_RESET_S = (
    1.0  # s; no network delays by more, so the clock was set back; by less, and it is soon past the old time
)
MAX_EXTRAPOLATION_S = 0.2  # s by which the newest odometry is carried on
MAX_CHAIN_FRAMES = 32  # frames from the scanner to the base


class LatestTransforms:
    """The newest transform of every child frame. Fixed joints are all that is asked for, so time does not matter."""

    def __init__(self) -> None:
        """Nothing is known."""
        self._parents: dict[str, tuple[str, Transform]] = {}

    def add(self, message: Any) -> list[tuple[str, str, int, Transform]]:
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
            heard.append((parent, child, stamp_of(each.header), transform))
        return heard

    def find(self, child: str, base: str) -> Transform | None:
        """The pose of ``child`` in ``base``, over frames they have in common; None where they are not connected."""
        up, down = self._chain(child), self._chain(base)
        for frame, transform in up.items():
            if frame in down:
                return down[frame].inverse().then(transform)
        return None

    def names(self) -> list[str]:
        """All frames there are."""
        return sorted(self._parents.keys() | {parent for parent, _ in self._parents.values()})

    def _chain(self, frame: str) -> dict[str, Transform]:
        """The frame's pose in itself, its parent, and so on."""
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
    """Dead reckoning at a moment."""

    stamp_ns: int
    pose: Array  # (3,) base_link in odom
    twist: Array  # (3,) m/s, m/s, rad/s in base_link
    covariance: Array  # (3, 3) of x, y, yaw


class OdometryBuffer:
    """Odometry of the last seconds, at any moment between."""

    def __init__(self) -> None:
        """None has come."""
        self._kept: deque[DeadReckoning] = deque()

    def add(self, dead: DeadReckoning) -> None:
        """What comes out of order is left out; where the clock was set back (a simulation anew), all before."""
        if self._kept and dead.stamp_ns <= (newest := self._kept[-1].stamp_ns):
            if newest - dead.stamp_ns < CLOCK_RESET_S * 1e9:
                return
            self._kept.clear()
        self._kept.append(dead)
        while dead.stamp_ns - self._kept[0].stamp_ns > HISTORY_S * 1e9:
            self._kept.popleft()

    def at(self, stamp_ns: int) -> DeadReckoning | None:
        """Between two, on the way; after the newest, carried on with its velocity for `MAX_EXTRAPOLATION_S` s; None elsewhere."""
        after = None
        for dead in reversed(self._kept):
            if dead.stamp_ns <= stamp_ns:
                return self._between(dead, after, stamp_ns)
            after = dead
        return None

    @staticmethod
    def _between(before: DeadReckoning, after: DeadReckoning | None, stamp_ns: int) -> DeadReckoning | None:
        passed = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            moved, known = before.twist * passed, passed <= MAX_EXTRAPOLATION_S
        else:
            span = (after.stamp_ns - before.stamp_ns) * 1e-9
            moved, known = se2.between(before.pose, after.pose) * (passed / span), span <= 1.0
        if not known:
            return None
        return DeadReckoning(stamp_ns, se2.compose(before.pose, moved), before.twist, before.covariance)
