"""Maps while driving: each scan gets its place at once, and loop closures correct the map behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.se2 import Array
from services.mapper.slam.back_end import BackEnd
from services.mapper.slam.drive import Laser
from services.mapper.slam.front_end import FrontEnd, KeyScans, Place
from services.mapper.slam.grid import grid_of_scans
from services.mapper.slam.segments import KEYS
from services.mapper.slam.trajectory import spread

WINDOWS_M = (1.0, 3.0, 10.0, 30.0)  # of loop closing after each segment


@dataclass(frozen=True)
class GrownMap:
    """The map after some key scans."""

    grid: OccupancyGrid
    poses: Array  # (K, 3) of the key scans
    closures: npt.NDArray[np.int_]  # (C, 2) numbers of the key scans that loop closures link


class Mapper:
    """Builds a map scan after scan; its origin is the place of the first one.

    `update` takes long. It may run in another thread than the other methods, but not twice at the same time.
    """

    def __init__(self, laser: Laser, cell: float) -> None:
        """``cell`` is the edge length of the map's cells in m."""
        self.laser, self.cell = laser, cell
        self.map: GrownMap | None = None  # after the last `use`
        self._front_end = FrontEnd(laser)
        self._back_end = BackEnd(laser)
        self._origin = np.zeros(3)  # of the front end's frame, in map

    def add(self, stamp: float, ranges: Array, odom: Array | None = None) -> Place:
        """The place in map of a scan ``ranges`` (B,) m at ``stamp`` s, with or without odometry (3,)."""
        place = self._front_end.add(stamp, ranges, odom)
        turn = np.eye(3)
        turn[:2, :2] = se2.rotate(float(self._origin[2]), np.eye(2)).T
        pose = se2.compose(self._origin, place.pose)
        return replace(place, pose=pose, covariance=turn @ place.covariance @ turn.T)

    @property
    def outdated(self) -> bool:
        """Whether there are key scans that are not in the map yet."""
        return self.map is None or len(self.map.poses) < len(self._front_end.keys)

    def key_scans(self) -> KeyScans:
        """The key scans so far, for `update`."""
        return self._front_end.key_scans()

    def update(self, scans: KeyScans) -> GrownMap:
        """The map of the key scans, after loop closing if they complete a segment."""
        back_end = self._back_end
        complete = len(back_end.poses) // KEYS
        back_end.extend(scans)
        if len(back_end.poses) // KEYS > complete:
            for window in WINDOWS_M:
                back_end.close_loops(scans, window, growing=True)
        grid = grid_of_scans(back_end.poses, np.array(scans.ranges), self.laser, self.cell)
        pairs = [(each.link.first, each.link.second) for each in back_end.closures]
        return GrownMap(grid, back_end.poses, np.array(pairs, int).reshape(-1, 2))

    def use(self, grown: GrownMap) -> None:
        """Places the following scans in a map that `update` returned."""
        self.map = grown
        last = self._front_end.poses[self._front_end.keys[len(grown.poses) - 1]]
        self._origin = se2.compose(grown.poses[-1], se2.inverse(last))

    def trajectory(self) -> tuple[Array, Array]:
        """Stamps (N,) in s and poses (N, 3) in map of all scans."""
        track = self._front_end.track()
        poses = se2.compose(self._origin, track.key_scans.poses)
        if self.map is not None:
            poses[: len(self.map.poses)] = self.map.poses
        return np.array(self._front_end.stamps), spread(track, poses)
