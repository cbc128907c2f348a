"""Obstacles in the scan that are not in the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from common.geometry import se2
from common.robot.ranges import surfaces
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from services.controller.policies.free_space import FreeSpace

UNEXPLAINED = 0.2  # m from every wall of the map: ten times the scanner's noise
FARTHEST = 8.0  # m; beyond it an error of heading moves an end point too far
CELL = 0.05  # m
STANDS = 1_000_000_000  # ns; what has stood that long is furniture, until it goes
BESIDE = 0.3  # m
FORGET = 20_000_000_000  # ns after which furniture that is out of sight is forgotten
FORGET_YOUNG = 2_000_000_000  # ns for what was not seen to stand
BEYOND = 0.15  # m behind a cell that a beam must reach to show it free


class TemporaryObstacles:
    """Cells in map that were hit though the map has nothing there."""

    def __init__(self, free: FreeSpace) -> None:
        """None."""
        self._free = free
        x0, y0 = free.grid.origin
        self._origin = np.array([x0, y0])
        self._columns = int(np.ceil(free.grid.shape[1] * free.grid.resolution / CELL)) + 1
        self._cells = np.zeros(0, np.int64)  # flat numbers, sorted
        self._first = np.zeros(0, np.int64)  # ns
        self._last = np.zeros(0, np.int64)  # ns

    def see(self, scan: Scan, pose: Array) -> None:
        """A scan taken at a pose (3,) that can be trusted, base_link in map."""
        laser = se2.compose(pose, scan.mount.array())
        ranges = scan.ranges.astype(np.float64)
        angles = scan.angles()
        hit = surfaces(ranges) & (ranges < FARTHEST)
        heading = laser[2] + angles[hit]
        ends = laser[:2] + ranges[hit, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        odd = ends[self._free.grid.inside(ends) & (self._free.clear(ends) > UNEXPLAINED)]
        self._drop(scan, laser, scan.stamp_ns)
        self._add(np.unique(self._number(odd)), scan.stamp_ns)

    def points(self) -> Array:
        """(K, 2) m in map, one a cell."""
        rows, columns = np.divmod(self._cells, self._columns)
        return np.asarray(np.stack([columns + 0.5, rows + 0.5], axis=-1) * CELL + self._origin)

    def moving(self, stamp_ns: int) -> npt.NDArray[np.bool_]:
        """(K,) bool: came there so lately that it may walk on.

        What shows itself beside something that stands is another side of it. Who walks has no cell that stands: each of
        theirs is left again within a second.
        """
        young = stamp_ns - self._first < STANDS
        old = ~young & (self._last == stamp_ns)
        if young.any() and old.any():
            points = self.points()
            apart, _ = cKDTree(points[old]).query(points[young], distance_upper_bound=BESIDE)
            young[young] = ~np.isfinite(apart)
        return np.asarray(young)

    def _number(self, points: Array) -> npt.NDArray[np.int64]:
        where = np.floor((points - self._origin) / CELL).astype(np.int64)
        return np.asarray(where[:, 1] * self._columns + where[:, 0])

    def _add(self, cells: npt.NDArray[np.int64], stamp_ns: int) -> None:
        where = np.searchsorted(self._cells, cells)
        known = where < len(self._cells)
        known[known] = self._cells[where[known]] == cells[known]
        self._last[where[known]] = stamp_ns
        new = cells[~known]
        order = np.argsort(merged := np.concatenate([self._cells, new]), kind="stable")
        stamps = np.full(len(new), stamp_ns, np.int64)
        self._cells = merged[order]
        self._first = np.concatenate([self._first, stamps])[order]
        self._last = np.concatenate([self._last, stamps])[order]

    def _drop(self, scan: Scan, laser: Array, stamp_ns: int) -> None:
        """Cells that a beam has passed through, and those unseen for long."""
        if not len(self._cells):
            return
        away = self.points() - laser[:2]
        distance = np.hypot(*away.T)
        bearing = se2.wrap(np.arctan2(away[:, 1], away[:, 0]) - laser[2])
        beam = Sweep.of(scan).beams_at(bearing)
        measured = scan.ranges.astype(np.float64)[beam]
        # No return is no proof of free space: a dark or a slanting surface gives none either.
        through = (beam >= 0) & np.isfinite(measured) & (measured > distance + BEYOND)
        long = np.where(self._last - self._first < 3 * STANDS, FORGET_YOUNG, FORGET)
        keep = ~through & (stamp_ns - self._last < long) & (stamp_ns >= self._last)
        self._cells, self._first, self._last = self._cells[keep], self._first[keep], self._last[keep]
