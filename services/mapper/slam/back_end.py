"""The back end: finds loop closures, and optimises the poses of the key scans accordingly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.mapper.slam.drive import Laser
from services.mapper.slam.front_end import KeyScanGraph
from services.mapper.slam.joining import PieceJoiner, is_contradicted, largest_component
from services.mapper.slam.loop_closure import MAX_SQUARED_DEVIATION, LoopClosure, find_closures
from services.mapper.slam.pose_graph import LinkTable, PoseLink, Uncertainty, components, optimise
from services.mapper.slam.submaps import Submap, divide_into_submaps


class BackEnd:
    """Corrects the drift of key scans, and joins the pieces of a drive."""

    def __init__(self, laser: Laser) -> None:
        self.laser = laser
        # Corrected poses of the key scans. The relative pose of two key scans is known only if links connect them.
        self.poses = np.zeros((0, 3))
        self.closures: list[LoopClosure] = []
        self._unconfirmed: list[LoopClosure] = []  # found by a wide search, and not yet supported by another one
        self._uncertainty: Uncertainty | None = None  # of the submaps; computed again after a change
        self._tried: set[tuple[int, int]] = set()  # pairs of submaps that were matched, with or without success
        self._joiner = PieceJoiner()
        self._cuts: set[int] = set()  # key scans whose link to the one before turned out to be wrong

    def extend(self, scans: KeyScanGraph) -> None:
        """Adds the new key scans, at their poses by the front end relative to the last known one."""
        count = len(self.poses)
        new = scans.poses[count:]
        if count:
            new = se2.compose(self.poses[-1], se2.between(scans.poses[count - 1], new))
        self.poses, self._uncertainty = np.concatenate([self.poses, new]), None

    def close_loops(
        self,
        scans: KeyScanGraph,
        window: float,
        report: Callable[[float], None] = lambda _done: None,
        *,
        growing: bool = False,
    ) -> None:
        """Matches pairs of submaps whose relative position is known to within ``window`` m, each pair once.

        If the drive is still ``growing``, its last submap is left out until it is complete.
        """
        submaps = self._submaps(scans, growing=growing)
        if self._uncertainty is None:
            references = np.array([submap.reference for submap in submaps], int)
            self._uncertainty = Uncertainty(self.poses, self._links(scans), references)
        found, self._unconfirmed = find_closures(
            submaps, self.poses, self._uncertainty, self._tried, self._unconfirmed, window, report
        )
        self._add(found, scans)

    def join_pieces(self, scans: KeyScanGraph, *, growing: bool = False) -> bool:
        """Cuts off pieces that contradict the map, then tries to join one; returns whether one was joined."""
        if not scans.pieces.any():
            return False
        submaps = self._submaps(scans, growing=growing)
        self._separate_contradicted(scans, submaps)
        component = self._components(scans)
        if not component.any():
            return False
        found = self._joiner.find(submaps, self.poses, component)
        if not found:
            return False
        self._move_later_component(found[0].link, component)
        self._add(found, scans)
        return True

    def _move_later_component(self, link: PoseLink, component: npt.NDArray[np.int_]) -> None:
        """Moves the later one of two components so that a link between them fits."""
        first, second = (component == component[k] for k in (link.first, link.second))
        if np.argmax(first) < np.argmax(second):
            place = se2.compose(self.poses[link.first], link.pose)
            later, origin = second, se2.compose(place, se2.inverse(self.poses[link.second]))
        else:
            place = se2.compose(self.poses[link.second], se2.inverse(link.pose))
            later, origin = first, se2.compose(place, se2.inverse(self.poses[link.first]))
        self.poses[later] = se2.compose(origin, self.poses[later])

    def in_map(self, scans: KeyScanGraph) -> npt.NDArray[np.bool_]:
        """Mask (K,) of the key scans that belong to the map: the largest component that links connect."""
        component = self._components(scans)
        return np.asarray(component == largest_component(component))

    def _add(self, found: list[LoopClosure], scans: KeyScanGraph) -> None:
        if not found:
            return  # the poses agree with the links already
        self._uncertainty = None
        self.closures += found
        self.poses = optimise(self.poses, self._links(scans))
        self._drop_implausible()
        self.poses = optimise(self.poses, self._links(scans))

    def _separate_contradicted(self, scans: KeyScanGraph, submaps: list[Submap]) -> None:
        """Cuts the drive where a piece begins that contradicts the ones before: all links across are removed."""
        for piece in range(1, submaps[-1].piece + 1):
            component = self._components(scans)[[each.reference for each in submaps]]
            before = [k for k, each in enumerate(submaps) if each.piece < piece]
            for k in (k for k, each in enumerate(submaps) if each.piece == piece):
                linked = [other for other in before if component[other] == component[k]]
                if is_contradicted(k, self.poses[submaps[k].reference], linked, submaps, self.poses):
                    self._cut(len(before), int(np.searchsorted(scans.pieces, piece)), scans)
                    break

    def _cut(self, submap: int, key: int, scans: KeyScanGraph) -> None:
        """Removes all links across the beginning of a ``submap``, whose first key scan is number ``key``."""
        self._cuts.add(key)
        self.closures, self._unconfirmed = (
            [each for each in closures if (each.first < submap) == (each.second < submap)]
            for closures in (self.closures, self._unconfirmed)
        )
        self._tried = {pair for pair in self._tried if (pair[0] < submap) == (pair[1] < submap)}
        self._uncertainty = None
        self.poses = optimise(self.poses, self._links(scans))

    def _submaps(self, scans: KeyScanGraph, *, growing: bool) -> list[Submap]:
        laser, ranges = self.laser, np.array(scans.ranges)
        return divide_into_submaps(
            self.poses, scans.pieces, scans.elements, ranges, laser.angles, laser.mount, growing=growing
        )

    def _links(self, scans: KeyScanGraph) -> list[PoseLink]:
        return [
            *(each for each in scans.links if each.second not in self._cuts),
            *(each.link for each in self.closures),
        ]

    def _components(self, scans: KeyScanGraph) -> npt.NDArray[np.int_]:
        return components(len(self.poses), self._links(scans))

    def _drop_implausible(self) -> None:
        """Drops the closures that contradict the graph."""
        deviation = LinkTable([each.link for each in self.closures]).squared_deviations(self.poses)
        pairs = zip(self.closures, deviation, strict=True)
        self.closures = [each for each, off in pairs if off < MAX_SQUARED_DEVIATION]
