"""The back end: loop closures, and the poses of the key scans that agree best with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.geometry import se2
from services.mapper.slam.drive import Laser
from services.mapper.slam.front_end import KeyScans
from services.mapper.slam.loop_closure import MAX_SQUARED_DEVIATION, Closure, find_closures
from services.mapper.slam.pose_graph import Link, LinkTable, Uncertainty, optimise
from services.mapper.slam.segments import KEYS, segments_of


class BackEnd:
    """Corrects the drift of key scans."""

    def __init__(self, laser: Laser) -> None:
        self.laser = laser
        self.poses = np.zeros((0, 3))  # of the key scans, corrected
        self.closures: list[Closure] = []
        self._uncertainty: Uncertainty | None = None  # of the segments; None after a change
        self._known: set[tuple[int, int]] = set()  # pairs of segments that were tried

    def extend(self, scans: KeyScans) -> None:
        """Adds key scans that follow those that are known, at the places where the front end sees them."""
        count = len(self.poses)
        new = scans.poses[count:]
        if count:
            new = se2.compose(self.poses[-1], se2.between(scans.poses[count - 1], new))
        self.poses, self._uncertainty = np.concatenate([self.poses, new]), None

    def close_loops(
        self,
        scans: KeyScans,
        window: float,
        report: Callable[[float], None] = lambda _done: None,
        *,
        growing: bool = False,
    ) -> None:
        """Matches pairs of segments whose relative position is known to within ``window`` m, each pair once.

        If the drive is still ``growing``, its last segment is left out until it is complete.
        """
        ranges = np.array(scans.ranges)
        segments = segments_of(self.poses, scans.elements, ranges, self.laser.angles, self.laser.mount)
        if growing:
            segments = segments[: len(self.poses) // KEYS]
        if self._uncertainty is None:
            references = np.array([segment.reference for segment in segments])
            self._uncertainty = Uncertainty(self.poses, self._links(scans), references)
        found = find_closures(segments, self.poses, self._uncertainty, self._known, window, report)
        if found:
            self._uncertainty = None
        self.closures += found
        self.poses = optimise(self.poses, self._links(scans))
        self._drop_implausible()
        self.poses = optimise(self.poses, self._links(scans))

    def _links(self, scans: KeyScans) -> list[Link]:
        return [*scans.links, *(each.link for each in self.closures)]

    def _drop_implausible(self) -> None:
        """Drops the closures that contradict the graph."""
        deviation = LinkTable([each.link for each in self.closures]).squared_deviations(self.poses)
        pairs = zip(self.closures, deviation, strict=True)
        self.closures = [each for each, off in pairs if off < MAX_SQUARED_DEVIATION]
