"""The pose of a drive in a rough map."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from lab.accuracy.scenes import Scene
from lab.integrity.buildings import make_building
from lab.integrity.maps import scaled_map
from presage.learning.placement import _relative_scale, place_drive
from services.estimator.precise.learning.calibration import ReferenceDrive


@pytest.fixture(scope="module")
def keys():
    scene = Scene.of(make_building(77021).world, 622, [77021, 38])
    poses = scene.path(60.0)[::20]
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    scanner = scene.scanner
    return ReferenceDrive(
        np.arange(len(poses), dtype=float), poses, ranges, scanner.angles(), np.array(scanner.mount), scanner.range_max
    )


def test_map_of_another_building(keys):
    with pytest.raises(UserError, match="of the drive was found in the map"):
        place_drive(make_building(77022).world, keys)


def test_map_without_furniture(keys):
    building = make_building(77021)
    placement = place_drive(building.furnished([]).world, keys)
    assert placement.found > 0.9
    assert placement.scale == 1
    assert np.abs(placement.poses - keys.poses).max() < 0.02


def test_map_that_is_too_large(keys):
    assert place_drive(scaled_map(make_building(77021).world, 1.02), keys).scale == pytest.approx(1.02, abs=0.01)


def test_scale_within_the_errors_of_the_map():
    rng = np.random.default_rng(0)
    local = rng.uniform(-5, 5, (60, 2))
    for scale, expected in ((1.0, 1.0), (1.002, 1.0), (1.02, 1.02)):
        found = scale * local + 0.02 * rng.standard_normal(local.shape)
        assert _relative_scale(local, found) == pytest.approx(expected, abs=0.002)
    assert _relative_scale(np.zeros((5, 2)), np.zeros((5, 2))) == 1
