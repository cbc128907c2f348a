"""Estimators on a ROS map: tables of the particle filter, global localisation, stated deviations."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from common.geometry.world import World
from common.robot.scanner import SCANNERS
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.particle_filter.beam_model import RangeTable
from services.estimator.particle_filter.likelihood_field import SurfaceDistances
from services.estimator.shared.interface import Observation
from tests.common.geometry.maps import rooms

SCANNER = SCANNERS["tim571"].with_beams(200)


@pytest.fixture(scope="module")
def hall():
    return World(name="rooms", grid=OccupancyGrid.of(rooms(260), 0.05, (0.0, 0.0, 0.0)))


def test_particle_filter_tables(hall):
    field = SurfaceDistances(hall)
    places = hall.sample_free(300, np.random.default_rng(0), 0.1)
    exact = hall.grid.geometry.distance(OCCUPIED, places)
    assert np.abs(field(places[:, 0], places[:, 1]) - np.minimum(exact, 2.0)).max() < 0.03  # half a cell, at corners
    table, angles = RangeTable(hall), np.arange(0, 360, 10) * np.pi / 180
    cell = np.floor(places[:20] / 0.05)
    middles = np.column_stack([(cell + 0.5) * 0.05, np.zeros(20)])
    assert table.ranges(middles, angles) == pytest.approx(hall.ray_distances(middles, angles), abs=1e-5)


def test_global_localisation(hall):
    rng = np.random.default_rng(3)
    geometry = ScannerGeometry(SCANNER.angles(), np.array(SCANNER.mount), SCANNER.range_max)
    make = prepare_factory(EstimatorOptions(world=hall, model="exact"))
    for place in hall.sample_free(3, rng, 0.4):
        pose = np.array([*place, rng.uniform(-np.pi, np.pi)])
        exact = hall.ray_distances(se2.compose(pose, geometry.mount), geometry.angles)[0]
        ranges = SCANNER.limit(exact + 0.02 * rng.standard_normal(len(exact)))
        found = make(geometry).update(Observation(ranges, geometry.angles, geometry.range_max))
        assert np.hypot(*(found.pose[:2] - place)) < 0.02


def test_deviation_covers_cell_errors():
    """A slanted room mapped with cells of 5 cm: the error of its walls, up to a cell, is the same at every scan."""
    corners = se2.rotate(0.3, np.array([(0.0, 0), (7, 0), (7, 5), (4, 5), (4, 3.5), (0, 3.5)]))
    room = World(name="room", boundary=corners.tolist())
    edges = np.roll(corners, -1, axis=0) - corners
    walls = np.concatenate([a + np.linspace(0, 1, 2000)[:, None] * ab for a, ab in zip(corners, edges, strict=True)])
    first = walls.min(axis=0) - 0.2
    column, row = np.floor((walls - first) / 0.05).astype(int).T
    values = np.full((row.max() + 4, column.max() + 4), FREE, np.uint8)
    values[row, column] = OCCUPIED
    mapped = World(name="mapped", grid=OccupancyGrid.of(values, 0.05, (float(first[0]), float(first[1]), 0.0)))
    rng, geometry = (
        np.random.default_rng(4),
        ScannerGeometry(SCANNER.angles(), np.array(SCANNER.mount), SCANNER.range_max),
    )
    make, misfits = prepare_factory(EstimatorOptions(world=mapped, model="exact")), []
    for place in room.sample_free(4, rng, 0.5):
        pose = np.array([*place, rng.uniform(-np.pi, np.pi)])
        estimator = make(geometry)
        estimator.restart(pose, np.diag([0.01, 0.01, 0.01]))
        exact = room.ray_distances(se2.compose(pose, geometry.mount), geometry.angles)[0]
        for k in range(20):
            ranges = SCANNER.limit(exact + 0.02 * rng.standard_normal(len(exact)))
            found = estimator.update(Observation(ranges, geometry.angles, geometry.range_max, k / 15, np.zeros(3)))
        assert found.state == "tracking"
        off = found.pose - pose
        off[2] = se2.wrap(off[2])
        misfits.append(off @ np.linalg.solve(found.covariance, off))
    assert np.mean(misfits) < 6  # three degrees of freedom; with scanner noise alone it would be hundreds
