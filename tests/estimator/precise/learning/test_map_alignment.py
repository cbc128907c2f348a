"""Moving key scans into the frame of a rough map."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from lab.integrity.maps import noisy_grid
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.map_alignment import align_to_map, move_into_cells
from services.estimator.shared.generative_models import RayCaster


def test_surfaces_settle_in_the_cells_of_a_grid():
    scene = Scene.of(load_world("office"), 311, 5)
    rough = noisy_grid(scene)
    poses, scanner = scene.poses(60), scene.scanner
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    off = np.array([0.02, -0.015, 0.0])
    keys = ReferenceDrive(
        np.arange(60.0), poses + off, ranges, scanner.angles(), np.array(scanner.mount), scanner.range_max
    )
    for moved in (move_into_cells(rough, keys), align_to_map(RayCaster(rough), keys).poses):
        assert np.hypot(*(moved - poses)[:, :2].mean(axis=0)) == pytest.approx(0, abs=0.006)
