"""Refining the poses of a drive by the field learned from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from presage.learning.pose_refinement import refine_poses
from services.estimator.precise.learning.calibration import ReferenceDrive


def test_errors_of_single_scans_average_out():
    scene = Scene.of(load_world("office"), 311, 5)
    poses, scanner = scene.path(20.0)[::3], scene.scanner
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    stamps, mount = 1e9 + 0.2 * np.arange(len(poses)), np.array(scanner.mount)
    drive = ReferenceDrive(stamps, poses, ranges, scanner.angles(), mount, scanner.range_max)
    off = np.random.default_rng(1).normal(scale=[0.005, 0.005, 0.001], size=poses.shape)

    def error(found):
        difference = (found - poses)[:, :2]
        return np.sqrt(((difference - difference.mean(axis=0)) ** 2).sum(axis=1).mean())

    refined = refine_poses(replace(drive, poses=poses + off), lambda _done: None)
    assert error(refined) < 0.5 * error(poses + off)
