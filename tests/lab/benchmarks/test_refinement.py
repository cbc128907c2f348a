"""The benchmark of maps made from one drive."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import World
from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import drive_for
from lab.benchmarks.refinement import wall_errors
from lab.integrity.buildings import make_building
from services.estimator.shared.generative_models import RayCaster


def test_walls_of_the_true_world_are_right():
    box = {"box": {"center": (2.0, 1.0), "size": (0.5, 0.4), "yaw_deg": 20}}
    hall = World(name="hall", boundary=[(0, 0), (5, 0), (5, 4), (0, 4)], obstacles=[box])
    scene = Scene.of(hall, 50, 1)
    poses, model = scene.poses(5), RayCaster(scene.world)
    assert wall_errors(model, poses, scene, np.zeros(3)) == pytest.approx(0, abs=1e-6)
    moved = wall_errors(model, poses, scene, np.array([0.01, 0.0, 0.0]))
    assert moved.max() == pytest.approx(0.01, abs=1e-6)
    assert 0.001 < moved.mean() < 0.009


def test_drive_has_the_length_that_was_asked_for():
    building = make_building(3)
    path = drive_for(Scene.of(building.world, 50, 1), building, 600.0)
    assert path.shape == (3000, 3)
    assert np.hypot(*np.diff(path[:, :2], axis=0).T).max() < 0.5
