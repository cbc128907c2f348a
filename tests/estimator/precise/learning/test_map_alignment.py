"""Moving key scans into the frame of a rough map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from lab.integrity.maps import noisy_grid
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.map_alignment import align_to_map, with_offset
from services.estimator.shared.generative_models import RayCaster


def office_drive(seed):
    """A rough grid of the office, and key scans at their true poses."""
    scene = Scene.of(load_world("office"), 311, seed)
    poses, scanner = scene.poses(60), scene.scanner
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    mount = np.array(scanner.mount)
    drive = ReferenceDrive(np.arange(60.0), poses, ranges, scanner.angles(), mount, scanner.range_max)
    return RayCaster(noisy_grid(scene)), drive


def test_offset_is_the_same_again():
    rough, keys = office_drive(0)
    once = with_offset(rough, keys)
    assert once.offset > 0.002
    assert with_offset(once, keys).offset == pytest.approx(once.offset, abs=0.001)


@pytest.mark.parametrize("seed", range(3))
def test_alignment_to_a_rough_grid(seed):
    rough, keys = office_drive(seed)
    off = replace(keys, poses=keys.poses + np.array([0.02, -0.015, 0.0]))
    moved = align_to_map(with_offset(rough, off), off).poses
    assert np.hypot(*(moved - keys.poses)[:, :2].mean(axis=0)) == pytest.approx(0, abs=0.006)
