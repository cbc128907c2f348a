"""A version of the map that the mapper builds, prepared for planning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.geometry.occupancy_grid import FREE
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph

if TYPE_CHECKING:
    from collections.abc import Sequence

    from common.geometry.se2 import Array
    from common.messages.definitions import Map

# A key scan that moved farther than this between two versions was moved by a loop closure. Obstacles that were seen
# before are then at other places of the map.
JUMP_M = 0.05


@dataclass(frozen=True)
class AnchoredPose:
    """A pose that moves with the map when a loop closes."""

    key_scan: int  # its number
    relative: Array  # (3,) in the frame of that key scan


@dataclass(frozen=True)
class PlanningMap:
    """A map, and the graph of the paths through it."""

    message: Map
    graph: FreeSpaceGraph
    free_area_m2: float

    @classmethod
    def of(cls, message: Map, radius: float) -> PlanningMap:
        """Prepares a map for planning with a robot of ``radius`` m."""
        free_area_m2 = float(np.count_nonzero(message.grid.values == FREE)) * message.grid.resolution**2
        return cls(message, FreeSpaceGraph(FreeSpace.of_map(message.grid), radius), free_area_m2)

    def mapping_restarted_since(self, before: PlanningMap) -> bool:
        """Whether mapping started again after the version ``before``, so that poses in it mean nothing in this one."""
        return self.message.key_scans < before.message.key_scans

    def jumped_from(self, before: PlanningMap) -> bool:
        """Whether a key scan of the version ``before`` has moved by more than `JUMP_M` in this one."""
        old, new = before.message, self.message
        _, in_old, in_new = np.intersect1d(old.numbers, new.numbers, assume_unique=True, return_indices=True)
        if len(in_old) < len(old.poses):
            return True  # mapping started again, or another piece of the drive has become the map
        return bool(np.hypot(*(new.poses[in_new] - old.poses[in_old])[:, :2].T).max(initial=0.0) > JUMP_M)

    def anchor(self, pose: Array) -> AnchoredPose:
        """Anchors a pose (3,) in map to the nearest key scan, with which its surroundings move."""
        nearest = int(np.argmin(np.hypot(*(self.message.poses - pose)[:, :2].T)))
        return AnchoredPose(int(self.message.numbers[nearest]), se2.between(self.message.poses[nearest], pose))

    def locate(self, anchored: Sequence[AnchoredPose]) -> Array:
        """The poses (N, 3) in this version of the map, without those whose key scan is not connected to it."""
        index = {number: k for k, number in enumerate(self.message.numbers.tolist())}
        placed = [
            se2.compose(self.message.poses[index[each.key_scan]], each.relative)
            for each in anchored
            if each.key_scan in index
        ]
        return np.reshape(placed, (-1, 3))
