"""The tree of frames of a ROS log: where the laser sits on the base, and where the base went."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from common import se2
from common.errors import UserError
from common.se2 import Array
from presage.logs.poses import Track

LEVEL = float(np.cos(np.deg2rad(10)))  # a scanner that leans further does not scan a plane of the map
MOVED = 0.01  # m and rad, by which what is bolted on does not move


def matrix(translation: Array, quaternion: Array) -> Array:
    """(4, 4) of a translation (3,) m and a quaternion (4,) x, y, z, w; NaN where it turns by nothing sensible."""
    norm = float(np.linalg.norm(quaternion))
    x, y, z, w = quaternion / norm if norm > 1e-6 else np.full(4, np.nan)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = translation
    return found


def planar(transform: Array) -> Array:
    """(3,) x, y, yaw of a (4, 4): where it is on the floor, and where its x axis points."""
    return np.array([transform[0, 3], transform[1, 3], np.arctan2(transform[1, 0], transform[0, 0])])


@dataclass
class Edge:
    """A frame in its parent."""

    parent: str
    first: Array  # (4, 4)
    track: Track = field(default_factory=Track)
    moves: bool = False

    def add(self, stamp_ns: int, transform: Array) -> None:
        """One more (4, 4), at a time."""
        self.moves = self.moves or bool(np.abs(transform - self.first).max() > MOVED)
        self.track.add(stamp_ns, planar(transform))


class Frames:
    """Edges by child, as tf and tf_static have them."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def add(self, parent: str, child: str, stamp_ns: int, transform: Array) -> None:
        """A (4, 4); one that is not finite is none."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if child == parent or not np.isfinite(transform).all():
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
            step = edge.track.at(stamp_ns) if edge.moves else planar(edge.first)
            if step is None:
                return None
            pose = se2.compose(pose, step)
        return np.asarray(pose)

    def mount(self, base: str, laser: str) -> tuple[Array, bool] | None:
        """(3,) the laser in the base, and whether it hangs upside down; None where tf does not say.

        Raises UserError where it moves, or does not lie level.
        """
        chain = self.chain(base, laser)
        if chain is None:
            return None
        if any(edge.moves for edge in chain):
            raise UserError(f"{laser} moves against {base}: a scanner must be fixed to it; name another --base-frame")
        transform = np.eye(4)
        for edge in chain:
            transform = transform @ edge.first
        if abs(transform[2, 2]) < LEVEL:
            raise UserError(
                f"{laser} is not level in {base}: its scans show no plane of a map (--mount says otherwise)"
            )
        return planar(transform), bool(transform[2, 2] < 0)
