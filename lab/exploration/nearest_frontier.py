"""The baseline: a nearest-frontier explorer (Yamauchi, A frontier-based approach for autonomous exploration, 1997).

A frontier is a connected part of the edge between known free and unknown space, of about a robot's width at least. The
robot drives to the nearest one that it can reach. What counts as the edge is the same as for presage's explorer, with
the same rule for cells that scans do not reach, so that both end with the same map.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from common.geometry import se2
from services.controller.policies.exploration import (
    UNREACHABLE_RANGE_M,
    Survey,
    View,
    frontier_of,
    known_space,
)

MIN_FRONTIER_CELLS = 5  # cells of 0.1 m; a robot of 0.54 m may just pass
EYE_RANGE_M = 1.0  # a place this close to a frontier stands for it, where the robot cannot stand at the frontier itself


def nearest_frontier(survey: Survey) -> View | None:
    """The place at the nearest frontier; None if none can be reached."""
    edge, known = frontier_of(survey), known_space(survey.graph)
    grid = known.grid
    field = known.cost_field(survey.pose[:2], known.min_clearance)
    if field is None or not len(edge.cells):
        return None
    mask = np.zeros(grid.shape, bool)
    mask.ravel()[edge.cells] = True
    label, count = ndimage.label(mask, np.ones((3, 3)))
    best: tuple[float, View] | None = None
    reachable = np.flatnonzero(np.isfinite(field.cost))
    places = grid.centres(reachable)
    done = np.concatenate([survey.unreachable, survey.arrivals[:, :2]])
    if len(done):
        away = np.hypot(*np.moveaxis(places[:, None] - done, -1, 0)).min(axis=1)
        reachable, places = reachable[away > UNREACHABLE_RANGE_M], places[away > UNREACHABLE_RANGE_M]
    for number in range(1, count + 1):
        cells = np.flatnonzero(label == number)
        if len(cells) < MIN_FRONTIER_CELLS or not len(places):
            continue
        points = grid.centres(cells)
        distance = np.hypot(*np.moveaxis(places[:, None] - points, -1, 0)).min(axis=1)
        near = np.flatnonzero(distance <= EYE_RANGE_M)
        if not len(near):
            continue
        # Of the places nearest to the frontier, the one with the shortest way.
        near = near[distance[near] <= distance[near].min() + grid.resolution]
        cost = field.cost.ravel()[reachable[near]]
        at = int(near[np.argmin(cost)])
        if best is not None and cost.min() >= best[0]:
            continue
        middle = points.mean(axis=0) - places[at]
        heading = float(se2.wrap(np.arctan2(middle[1], middle[0]) - survey.view.sector.centre))
        best = float(cost.min()), View(np.array([*places[at], heading]), float(len(cells)), places[at][None])
    return None if best is None else best[1]
