"""A version of the map that the mapper builds, prepared for planning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry.occupancy_grid import FREE
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph

if TYPE_CHECKING:
    from common.messages.definitions import Map

# A key scan that moved farther than this between two versions was moved by a loop closure. Obstacles that were seen
# before are then at other places of the map.
JUMP_M = 0.05


@dataclass(frozen=True)
class PlannedMap:
    """A map, and the graph of the paths through it."""

    message: Map
    graph: FreeSpaceGraph
    free_area_m2: float

    @classmethod
    def of(cls, message: Map, radius: float) -> PlannedMap:
        """Prepares a map for planning with a robot of ``radius`` m."""
        free_area_m2 = float(np.count_nonzero(message.grid.values == FREE)) * message.grid.resolution**2
        return cls(message, FreeSpaceGraph(FreeSpace.of_map(message.grid), radius), free_area_m2)

    def jumped_from(self, before: PlannedMap) -> bool:
        """Whether a key scan of the version ``before`` has moved by more than `JUMP_M` in this one."""
        old, new = before.message.poses, self.message.poses
        if len(new) < len(old):
            return True  # mapping started again
        return bool(np.hypot(*(new[: len(old)] - old)[:, :2].T).max(initial=0.0) > JUMP_M)
