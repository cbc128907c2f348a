"""Obstacles in the scan that are not in the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from common.geometry import se2
from common.robot.ranges import is_surface
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from services.controller.policies.free_space import FreeSpace

MIN_WALL_DISTANCE_M = 0.2  # a return farther than this from every wall is an obstacle; ten times the scanner's noise
MAX_RANGE_M = 8.0  # beyond this, an error of the heading displaces returns too far
CELL_M = 0.05
STATIC_AFTER_NS = 1_000_000_000  # a cell hit for at least this long counts as furniture, a younger one as moving
SAME_OBSTACLE_M = 0.3  # a new cell this close to furniture is another side of it
FORGET_STATIC_NS = 20_000_000_000  # a cell that was hit for 3 * STATIC_AFTER_NS is kept this long out of sight
FORGET_RECENT_NS = 2_000_000_000  # and any other cell this long
FREE_MARGIN_M = 0.15  # a beam must end this far behind a cell to show that the cell is free
# Evidence that a cell is occupied, as in an occupancy grid: a hit adds, a beam that passes subtracts. A cell without
# evidence is removed. So noise does not remove the edge of an obstacle, or a leg that only every other scan hits.
HIT_EVIDENCE, PASS_EVIDENCE, MAX_EVIDENCE = 2, 1, 4


class TemporaryObstacles:
    """Grid cells in which beams ended although the map has no wall there."""

    def __init__(self, free: FreeSpace) -> None:
        self._use(free)
        # One entry per occupied cell.
        self._cells = np.zeros(0, np.int64)  # flat indices, sorted
        self._first_seen = np.zeros(0, np.int64)  # ns
        self._last_seen = np.zeros(0, np.int64)  # ns
        self._evidence = np.zeros(0, np.int64)

    def _use(self, free: FreeSpace) -> None:
        self._free, self._origin = free, np.array(free.grid.origin)
        self._columns = int(np.ceil(free.grid.shape[1] * free.grid.resolution / CELL_M)) + 1

    def change_map(self, free: FreeSpace) -> None:
        """Uses another map of the same place. Obstacles that are walls in it are no longer obstacles."""
        points, first, last, evidence = self.points(), self._first_seen, self._last_seen, self._evidence
        self._use(free)
        keep = self._unmapped(points)
        # Where cells of the old grid share one of the new, the first one's times and evidence are kept.
        self._cells, kept = np.unique(self._cell_of(points[keep]), return_index=True)
        self._first_seen, self._last_seen = first[keep][kept], last[keep][kept]
        self._evidence = evidence[keep][kept]

    def _unmapped(self, points: Array) -> npt.NDArray[np.bool_]:
        """Whether points (K, 2) m lie on the map and far from its walls; (K,) bool."""
        return self._free.grid.inside(points) & (self._free.clearance_at(points) > MIN_WALL_DISTANCE_M)

    def update(self, scan: Scan, pose: Array) -> None:
        """Adds and removes cells according to a scan taken at a reliable pose (3,) of base_link in map."""
        laser = se2.compose(pose, scan.mount.array())
        ranges = scan.ranges.astype(np.float64)
        angles = scan.angles()
        hit = is_surface(ranges) & (ranges < MAX_RANGE_M)
        heading = laser[2] + angles[hit]
        ends = laser[:2] + ranges[hit, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        unmapped = ends[self._unmapped(ends)]
        self._remove_cleared(scan, laser, scan.stamp_ns)
        self._add(np.unique(self._cell_of(unmapped)), scan.stamp_ns)

    def points(self) -> Array:
        """Centres (K, 2) m in map of the occupied cells."""
        rows, columns = np.divmod(self._cells, self._columns)
        return np.asarray(np.stack([columns + 0.5, rows + 0.5], axis=-1) * CELL_M + self._origin)

    def moving(self, stamp_ns: int) -> npt.NDArray[np.bool_]:
        """Whether each of `points` may be a moving obstacle, (K,) bool: first hit less than a second ago.

        A new cell beside one that is older and still hit counts as another side of the same furniture. A walking
        person leaves every cell within a second, so no cell of theirs becomes old.
        """
        young = stamp_ns - self._first_seen < STATIC_AFTER_NS
        old = ~young & (self._last_seen == stamp_ns)
        if young.any() and old.any():
            points = self.points()
            distance, _ = cKDTree(points[old]).query(points[young], distance_upper_bound=SAME_OBSTACLE_M)
            young[young] = ~np.isfinite(distance)  # keeps the young cells without an old one nearby
        return np.asarray(young)

    def _cell_of(self, points: Array) -> npt.NDArray[np.int64]:
        position = np.floor((points - self._origin) / CELL_M).astype(np.int64)
        return np.asarray(position[:, 1] * self._columns + position[:, 0])

    def _add(self, cells: npt.NDArray[np.int64], stamp_ns: int) -> None:
        position = np.searchsorted(self._cells, cells)
        known = position < len(self._cells)
        known[known] = self._cells[position[known]] == cells[known]
        self._last_seen[position[known]] = stamp_ns
        self._evidence[position[known]] = np.minimum(self._evidence[position[known]] + HIT_EVIDENCE, MAX_EVIDENCE)
        new = cells[~known]
        order = np.argsort(merged := np.concatenate([self._cells, new]), kind="stable")
        stamps = np.full(len(new), stamp_ns, np.int64)
        self._cells = merged[order]
        self._first_seen = np.concatenate([self._first_seen, stamps])[order]
        self._last_seen = np.concatenate([self._last_seen, stamps])[order]
        self._evidence = np.concatenate([self._evidence, np.full(len(new), HIT_EVIDENCE)])[order]

    def _remove_cleared(self, scan: Scan, laser: Array, stamp_ns: int) -> None:
        """Removes cells through which enough beams passed, cells not seen for long, and cells from before a reset."""
        if not len(self._cells):
            return
        offset = self.points() - laser[:2]
        distance = np.hypot(*offset.T)
        bearing = se2.wrap(np.arctan2(offset[:, 1], offset[:, 0]) - laser[2])
        beam = Sweep.of(scan).beams_at(bearing)
        measured = scan.ranges.astype(np.float64)[beam]
        # A beam without return does not prove free space: dark or slanting surfaces give no return either.
        passed = (beam >= 0) & np.isfinite(measured) & (measured > distance + FREE_MARGIN_M)
        self._evidence = self._evidence - PASS_EVIDENCE * passed
        recent = self._last_seen - self._first_seen < 3 * STATIC_AFTER_NS
        memory = np.where(recent, FORGET_RECENT_NS, FORGET_STATIC_NS)
        keep = (self._evidence > 0) & (stamp_ns - self._last_seen < memory) & (stamp_ns >= self._last_seen)
        self._cells = self._cells[keep]
        self._first_seen, self._last_seen = self._first_seen[keep], self._last_seen[keep]
        self._evidence = self._evidence[keep]
