"""Measures how much of the area that a robot can reach is free in a map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from common.geometry import se2
from common.geometry.occupancy_grid import FREE

if TYPE_CHECKING:
    from common.geometry.occupancy_grid import OccupancyGrid
    from common.geometry.se2 import Array
    from common.geometry.world import World

MIN_PASSAGE_M = 0.7  # a narrower door may be refused (docs/navigation.md, limits)
SPACING_M = 0.05  # between the points that stand for an area


def reachable_area(world: World, radius: float, start: Array) -> shapely.Geometry:
    """The area that a disc of ``radius`` m can cover, coming from ``start`` (3,)."""
    room = world.space_with_clearance(radius)
    parts = [part for part in shapely.get_parts(room) if shapely.distance(part, shapely.Point(start[:2])) < 0.01]
    return shapely.buffer(shapely.union_all(parts), radius)


def points_in(area: shapely.Geometry) -> Array:
    """Points (N, 2) m, `SPACING_M` apart, in an area."""
    x0, y0, x1, y1 = shapely.bounds(area)
    x, y = np.meshgrid(*(np.arange(low + SPACING_M / 2, high, SPACING_M) for low, high in ((x0, x1), (y0, y1))))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    return np.asarray(points[shapely.contains_xy(area, *points.T)])


def mapped_share(grid: OccupancyGrid, points: Array, origin: Array) -> float:
    """Share of points (N, 2) m that are free in a map whose origin is at ``origin`` (3,) in the points' frame."""
    return float(np.mean(grid.values_at(se2.transform(se2.inverse(origin), points)) == FREE))
