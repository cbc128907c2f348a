"""The baseline: a nearest-frontier explorer (Yamauchi, A frontier-based approach for autonomous exploration, 1997).

The robot drives to the nearest connected part of the frontier that it can reach, if that is about as wide as the robot
or wider. The frontier is that of presage's explorer, which gives up cells that scans do not reach by the same rule, so
both explorers end with the same map.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from common.geometry import se2
from common.geometry.se2 import Array
from services.controller.policies.exploration import (
    UNREACHABLE_RANGE_M,
    ExplorationState,
    Viewpoint,
    find_frontier,
    known_space,
)
from services.controller.policies.free_space import Grid
from services.controller.policies.geodesic_field import CostField

MIN_FRONTIER_CELLS = 5  # cells of 0.1 m; a robot of 0.54 m may just pass
MAX_DISTANCE_M = 1.0  # from the frontier of the place that is driven to, if the robot cannot stand at the frontier


def nearest_frontier(state: ExplorationState) -> Viewpoint | None:
    """The place at the nearest part of the frontier; None if none can be reached."""
    known = known_space(state.graph)
    field = known.cost_field(state.pose[:2], known.min_clearance)
    if field is None:
        return None
    places, cost = _reachable_places(state, field)
    nearest: tuple[float, Viewpoint] | None = None
    for cells in _parts_of_frontier(state, known.grid):
        at = _place_at(cells, places, cost, known.grid.resolution)
        if at is not None and (nearest is None or cost[at] < nearest[0]):
            offset = cells.mean(axis=0) - places[at]
            heading = float(se2.wrap(np.arctan2(offset[1], offset[0]) - state.field_of_view.sector.centre))
            nearest = float(cost[at]), Viewpoint(np.array([*places[at], heading]), float(len(cells)), places[at][None])
    return None if nearest is None else nearest[1]


def _reachable_places(state: ExplorationState, field: CostField) -> tuple[Array, Array]:
    """Places (P, 2) m where the robot has not been yet, and the costs (P,) of the paths to them."""
    reachable = np.flatnonzero(np.isfinite(field.cost))
    places, cost = field.graph.grid.centres(reachable), field.cost.ravel()[reachable]
    done = np.concatenate([state.unreachable, state.arrivals[:, :2]])
    if not len(done):
        return places, cost
    away = np.hypot(*np.moveaxis(places[:, None] - done, -1, 0)).min(axis=1) > UNREACHABLE_RANGE_M
    return places[away], cost[away]


def _parts_of_frontier(state: ExplorationState, grid: Grid) -> list[Array]:
    """The cells (F, 2) m of each connected part of the frontier that is large enough."""
    mask = np.zeros(grid.shape, bool)
    mask.ravel()[find_frontier(state).cells] = True
    label, count = ndimage.label(mask, np.ones((3, 3)))
    parts = [np.flatnonzero(label == number) for number in range(1, count + 1)]
    return [grid.centres(cells) for cells in parts if len(cells) >= MIN_FRONTIER_CELLS]


def _place_at(cells: Array, places: Array, cost: Array, resolution: float) -> int | None:
    """Index of the place with the least cost among those nearest to some cells (F, 2) m; None if all are too far."""
    distance = np.hypot(*np.moveaxis(places[:, None] - cells, -1, 0)).min(axis=1)
    if distance.min(initial=np.inf) > MAX_DISTANCE_M:
        return None
    nearest = np.flatnonzero(distance <= min(MAX_DISTANCE_M, distance.min() + resolution))
    return int(nearest[np.argmin(cost[nearest])])
