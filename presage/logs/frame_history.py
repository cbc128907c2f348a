"""The tf tree of a ROS bag over time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.ros_messages import IDENTITY, Mount, Transform, mount_of
from presage.logs.pose_track import PoseTrack

FIXED_TOLERANCE = 0.01  # m and rad; a frame that changes more moves against its parent


@dataclass(eq=False)
class TransformHistory:
    """A frame in its parent over time."""

    first: Transform
    track: PoseTrack = field(default_factory=PoseTrack)
    moves: bool = False

    def add(self, stamp_ns: int, transform: Transform) -> None:
        """Adds a transform at a time."""
        self.moves = self.moves or transform.difference(self.first) > FIXED_TOLERANCE
        self.track.add(stamp_ns, transform.planar())


class FrameHistory:
    """The transforms of tf and tf_static over the whole log."""

    def __init__(self) -> None:
        # By child and parent. Some logs state a frame in two parents, such as two kinds of odometry.
        self._edges: dict[str, dict[str, TransformHistory]] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(frame in parents for parents in self._edges.values())

    def add(self, parent: str, child: str, stamp_ns: int, transform: Transform) -> None:
        """Adds the transform of ``child`` in ``parent`` at a time."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if child == parent:
            return
        self._edges.setdefault(child, {}).setdefault(parent, TransformHistory(transform)).add(stamp_ns, transform)

    def chain(self, parent: str, child: str) -> list[TransformHistory] | None:
        """The shortest way from ``parent`` down to ``child``; None if ``child`` is not a descendant of ``parent``."""
        chains: dict[str, list[TransformHistory]] = {child: []}  # from each ancestor down to the child
        waiting = deque([child])
        while waiting and parent not in chains:
            frame = waiting.popleft()
            for above, edge in self._edges.get(frame, {}).items():
                if above not in chains:
                    chains[above] = [edge, *chains[frame]]
                    waiting.append(above)
        return chains.get(parent)

    def at(self, chain: list[TransformHistory], stamp_ns: int) -> Array | None:
        """Planar pose (3,) of the last frame of a chain in its first; None if a transform is unknown at that time."""
        pose = np.zeros(3)
        for edge in chain:
            step = edge.track.at(stamp_ns) if edge.moves else edge.first.planar()
            if step is None:
                return None
            pose = se2.compose(pose, step)
        return np.asarray(pose)

    def mount(self, base: str, laser: str) -> Mount | None:
        """The laser in the base frame; None if tf does not connect them.

        Raises UserError if the laser moves against the base or is not level.
        """
        chain = self.chain(base, laser)
        if chain is None:
            return None
        if any(edge.moves for edge in chain):
            raise UserError(
                f"{laser} moves against {base}, but must be fixed to it: choose another frame "
                "with base_frame in section log of --config"
            )
        transform = IDENTITY
        for edge in chain:
            transform = transform.then(edge.first)
        try:
            return mount_of(transform)
        except ValueError as error:
            raise UserError(f"{laser} on {base}: {error}; give the mount with --mount if this is wrong") from None
