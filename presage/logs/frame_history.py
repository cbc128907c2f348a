"""The tf tree of a ROS bag over time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.ros_messages import IDENTITY, Mount, Transform, mount_of
from presage.logs.poses import Track

MOVED = 0.01  # m and rad, by which what is bolted on does not move


@dataclass(eq=False)
class Edge:
    """A frame in its parent."""

    parent: str
    first: Transform
    track: Track = field(default_factory=Track)
    moves: bool = False

    def add(self, stamp_ns: int, transform: Transform) -> None:
        """One more, at a time."""
        self.moves = self.moves or transform.apart(self.first) > MOVED
        self.track.add(stamp_ns, transform.planar())


class FrameHistory:
    """Edges by child, as tf and tf_static have them, over the whole log."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def add(self, parent: str, child: str, stamp_ns: int, transform: Transform) -> None:
        """One transform, at a time."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if child == parent:
            return
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = Edge(parent, transform)
        edge.add(stamp_ns, transform)

    def chain(self, parent: str, child: str) -> list[Edge] | None:
        """From ``parent`` down to ``child``; None where the one does not hang on the other."""
        found: list[Edge] = []
        while child != parent:
            edge = self._edges.get(child)
            if edge is None or edge in found:
                return None
            found.insert(0, edge)
            child = edge.parent
        return found

    def at(self, chain: list[Edge], stamp_ns: int) -> Array | None:
        """(3,) the last frame of a chain in its first, on the floor; None where one of them is not known then."""
        pose = np.zeros(3)
        for edge in chain:
            step = edge.track.at(stamp_ns) if edge.moves else edge.first.planar()
            if step is None:
                return None
            pose = se2.compose(pose, step)
        return np.asarray(pose)

    def mount(self, base: str, laser: str) -> Mount | None:
        """The laser's in the base; None where tf does not say.

        Raises UserError where it moves, or does not lie level.
        """
        chain = self.chain(base, laser)
        if chain is None:
            return None
        if any(edge.moves for edge in chain):
            raise UserError(f"{laser} moves against {base}: a scanner must be fixed to it; name another --base-frame")
        transform = IDENTITY
        for edge in chain:
            transform = transform.then(edge.first)
        try:
            return mount_of(transform)
        except ValueError as error:
            raise UserError(f"{laser} on {base}: {error} (--mount says otherwise)") from None
