"""Moving key scans into the frame of a rough map."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from lab.integrity.maps import noisy_grid
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.map_alignment import align_to_map, with_offset
from services.estimator.shared.generative_models import RayCaster


@pytest.mark.parametrize("seed", range(3))
def test_alignment_to_a_rough_grid(seed):
    scene = Scene.of(load_world("office"), 311, seed)
    rough = RayCaster(noisy_grid(scene))
    poses, scanner = scene.poses(60), scene.scanner
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    off = np.array([0.02, -0.015, 0.0])
    keys = ReferenceDrive(
        np.arange(60.0), poses + off, ranges, scanner.angles(), np.array(scanner.mount), scanner.range_max
    )
    moved = align_to_map(with_offset(rough, keys), keys).poses
    assert np.hypot(*(moved - poses)[:, :2].mean(axis=0)) == pytest.approx(0, abs=0.006)
