"""The estimators of the accuracy benchmark."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import load_world
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS, EstimatorSetup, LearnedSurfaces
from lab.accuracy.scenes import Scene
from services.estimator.factory import EstimatorOptions, ScannerGeometry, load_model


@pytest.mark.parametrize(
    "name", ["particle-filter-learned-field", "particle-filter-scan-matching", "particle-filter-beam-model"]
)
def test_tracking(name):
    scene = Scene.of(load_world("corridor"), 100, 5000)
    estimator = COMPARED_ESTIMATORS[name].make(EstimatorSetup(scene.world, ScannerGeometry.of(scene.scanner), 0))
    path = scene.path(1.0)
    estimator.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    for k, (pose, clean) in enumerate(zip(path, scene.clean(path), strict=True)):
        found = estimator.update(scene.observe(clean, k / scene.scanner.rate, pose))
    assert np.hypot(*(found.pose - path[-1])[:2]) < 0.1


def test_distances_of_a_learned_field():
    world = load_world("corridor")
    model = load_model(EstimatorOptions(world), world)[0]
    surfaces = LearnedSurfaces(model.field, world.bounds, world.name)
    x, y = np.array([3.0, 9.0, 100.0]), np.array([1.0, 1.5])
    found = surfaces.surface_distance_on_lattice(x, y, 2.0)
    assert found.shape == (2, 3)
    assert found[:, :2] == pytest.approx(world.surface_distance_on_lattice(x[:2], y, 2.0), abs=0.03)
    assert found[0, 2] == 2.0
