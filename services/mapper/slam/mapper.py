"""Maps while driving: each scan gets a pose at once, and loop closures correct the map later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.se2 import Array
from services.mapper.slam.back_end import BackEnd
from services.mapper.slam.drive import Laser
from services.mapper.slam.front_end import FrontEnd, KeyScanGraph, ScanPose
from services.mapper.slam.grid import grid_of_scans
from services.mapper.slam.submaps import KEY_SCANS_PER_SUBMAP
from services.mapper.slam.trajectory import poses_of_all_scans

# The `window` of each round of loop closing after a submap, smallest first as in `trajectory`. Each is used only once,
# because all are used again after the next submap.
WINDOWS_M = (1.0, 3.0, 10.0, 30.0)


@dataclass(frozen=True)
class MapSnapshot:
    """The map after some key scans."""

    grid: OccupancyGrid
    poses: Array  # (K, 3) of all key scans in map; NaN where the piece is not connected to the map
    closures: npt.NDArray[np.int_]  # (C, 2) numbers of the key scans that loop closures link


class Mapper:
    """Builds a map from one scan after another; its origin is the pose of the first one.

    `update` takes seconds in a large building. It may run in another thread than the other methods, but not twice at
    the same time.
    """

    def __init__(self, laser: Laser, cell: float) -> None:
        """``cell`` is the edge length of the map's cells in m."""
        self.laser, self.cell = laser, cell
        self.map: MapSnapshot | None = None  # after the last `use`
        self._front_end = FrontEnd(laser)
        self._back_end = BackEnd(laser)
        self._origin = np.zeros(3)  # of the front end's frame, in map
        self._pieces = {0}  # pieces that are connected to the map, by the last update or by a later link

    def add(self, stamp: float, ranges: Array, odom: Array | None = None) -> ScanPose:
        """Returns the pose in map of a scan ``ranges`` (B,) m at ``stamp`` s, with or without odometry (3,)."""
        scan_pose = self._front_end.add(stamp, ranges, odom)
        if scan_pose.linked and scan_pose.piece - 1 in self._pieces:
            self._pieces.add(scan_pose.piece)
        turn = se2.rotation(float(self._origin[2]))
        pose = se2.compose(self._origin, scan_pose.pose)
        matched = scan_pose.matched and scan_pose.piece in self._pieces
        return replace(scan_pose, pose=pose, covariance=turn @ scan_pose.covariance @ turn.T, matched=matched)

    @property
    def outdated(self) -> bool:
        """Whether there are key scans that are not in the map yet.

        A first key scan that shows too little does not count: another one will replace it.
        """
        if self._front_end.shows_too_little:
            return False
        return self.map is None or len(self.map.poses) < self.key_scan_count

    @property
    def key_scan_count(self) -> int:
        """Number of key scans so far."""
        return len(self._front_end.keys)

    def key_scans(self) -> KeyScanGraph:
        """The key scans so far, for `update`."""
        return self._front_end.key_scans()

    def update(self, scans: KeyScanGraph) -> MapSnapshot:
        """The map of the key scans. Loops are closed after every `KEY_SCANS_PER_SUBMAP` key scans."""
        back_end = self._back_end
        submaps_before = len(back_end.poses) // KEY_SCANS_PER_SUBMAP
        back_end.extend(scans)
        if len(back_end.poses) // KEY_SCANS_PER_SUBMAP > submaps_before:
            for window in WINDOWS_M:
                back_end.close_loops(scans, window, growing=True)
            back_end.join_pieces(scans, growing=True)
        in_map = back_end.in_map(scans)
        grid = grid_of_scans(back_end.poses[in_map], np.array(scans.ranges)[in_map], self.laser, self.cell)
        pairs = np.array([(each.link.first, each.link.second) for each in back_end.closures], int).reshape(-1, 2)
        poses = np.where(in_map[:, None], back_end.poses, np.nan)
        return MapSnapshot(grid, poses, pairs[in_map[pairs].all(axis=1)])

    def use(self, snapshot: MapSnapshot) -> None:
        """Replaces the map by one that `update` returned; the following scans are placed in it."""
        self.map = snapshot
        placed = np.flatnonzero(np.isfinite(snapshot.poses[:, 0]))
        last = self._front_end.poses[self._front_end.keys[placed[-1]]]
        self._origin = se2.compose(snapshot.poses[placed[-1]], se2.inverse(last))
        scans = self._front_end.key_scans()
        self._pieces = set(scans.pieces[placed].tolist())
        for link in scans.links:
            if link.second >= len(snapshot.poses) and scans.pieces[link.first] in self._pieces:
                self._pieces.add(int(scans.pieces[link.second]))

    def drawing(self) -> Callable[[], OccupancyGrid]:
        """Returns a function that draws the map of the scans until now, and that another thread may call.

        It uses more scans than `update`, and takes seconds after a long drive.
        """
        numbers, ranges = self._front_end.grid_scans()
        poses = self._poses()[numbers]
        placed = np.isfinite(poses[:, 0])
        return partial(grid_of_scans, poses[placed], ranges[placed], self.laser, self.cell)

    def trajectory(self) -> tuple[Array, Array]:
        """Stamps (N,) in s and poses (N, 3) in map of all scans that are connected to the map."""
        poses = self._poses()
        placed = np.isfinite(poses[:, 0])
        return np.array(self._front_end.stamps)[placed], poses[placed]

    def _poses(self) -> Array:
        """Poses (N, 3) in map of all scans; NaN where a scan is not connected to the map."""
        drive = self._front_end.tracked_drive()
        known = np.isin(drive.key_scans.pieces, list(self._pieces))
        poses = np.where(known[:, None], se2.compose(self._origin, drive.key_scans.poses), np.nan)
        if self.map is not None:
            poses[: len(self.map.poses)] = self.map.poses
        return poses_of_all_scans(drive, poses)
