"""`presage bench area`: buildings side by side."""

from __future__ import annotations

import numpy as np

from lab.benchmarks.area import CELL_M, LearnedBuilding, join_buildings
from services.estimator.precise.field import CLASSES, DistanceField

ANGLES = np.linspace(-np.pi, np.pi, 60)
PLACES = np.array([[1.0, 0.5], [0.4, 0.9]])


def room(width, height, origin):
    """An empty room with the laser's ``PLACES``, relative to the origin."""
    y, x = CELL_M * np.mgrid[: round(height / CELL_M), : round(width / CELL_M)]
    phi = np.minimum.reduce([x - 0.1, y - 0.1, width - 0.1 - x, height - 0.1 - y]).astype(np.float32)
    scales = np.full(int(np.prod(CLASSES)), 1e-3)
    return LearnedBuilding(1, phi, np.array(origin), scales, PLACES + origin, width * height)


def test_site():
    buildings = [room(3.0, 2.0, (0.0, 0.0)), room(2.0, 4.0, (-5.0, 7.0)), room(5.0, 2.0, (1.0, 1.0))]
    site = join_buildings(buildings)
    assert site.area == 24
    for k, building in enumerate(buildings):
        lasers = np.column_stack([building.places, [0.3, 1.0]])
        alone = DistanceField(building.phi, (float(building.origin[0]), float(building.origin[1])), CELL_M).trace(
            lasers, ANGLES
        )
        moved = site.model.expect(lasers + np.append(site.offsets[k], 0.0), ANGLES)
        assert np.allclose(moved.ranges, alone.ranges, atol=1e-6)
