"""Panorama networks as generative models: training, derivatives and reproducibility."""

from __future__ import annotations

import numpy as np
import pytest

from lab.accuracy.panorama import PanoramaShape, train_panorama
from services.estimator.paper.decoder import use_one_core
from tests.estimator.models import ROOM

ANGLES = np.deg2rad(np.linspace(-135, 135, 91))
use_one_core()  # on a busy machine, several threads that wait for one another take minutes instead of seconds
SMALL = {"bins": 120, "width": 64, "layers": 2, "frequencies": 16}


def lasers(count, seed):
    rng = np.random.default_rng(seed)
    return np.column_stack([ROOM.sample_free(count, rng, 0.2), rng.uniform(-np.pi, np.pi, count)])


def trained(steps=150, seed=0, **shape):
    poses = lasers(300, 0)
    return train_panorama(
        PanoramaShape(**{**SMALL, **shape}), poses, ANGLES, ROOM.ray_distances(poses, ANGLES), steps, seed
    )


@pytest.mark.parametrize("shape", [{}, {"inputs": "grid"}, {"activation": "relu", "loss": "l1"}])
def test_training(shape):
    poses = lasers(100, 1)
    exact = ROOM.ray_distances(poses, ANGLES)
    error = np.abs(trained(**shape).expect(poses, ANGLES).ranges - exact)
    assert error.mean() < 0.6 * np.abs(exact - np.median(exact)).mean()


def test_learned_precision():
    poses = lasers(100, 1)
    expected = trained(400).expect(poses, ANGLES)
    error = np.abs(expected.ranges - ROOM.ray_distances(poses, ANGLES))
    surer = expected.scale < np.median(expected.scale)
    assert error[~surer].mean() > 1.5 * error[surer].mean()


def test_reproducible_training():
    poses = lasers(5, 2)
    first, again, other = (trained(20, seed).expect(poses, ANGLES).ranges for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_jacobian():
    model = trained(100)
    pose = lasers(1, 3)[0]
    found = model.expect(pose[None], ANGLES).jacobian[0]
    for axis, step in enumerate((2e-3, 2e-3, 2 * np.pi / 120)):  # the derivative by yaw is over whole bins
        offset = step * np.eye(3)[axis]
        ahead, back = model.expect(np.array([pose + offset, pose - offset]), ANGLES).ranges
        assert found[:, axis] == pytest.approx((ahead - back) / (2 * step), rel=1e-2, abs=1e-2)
