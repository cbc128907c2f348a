"""Simulated drives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lab.accuracy.scenes import Scene
from services.mapper.slam.drive import Laser, RawDrive
from services.simulator.odometry import Odometer, OdometryNoise


def driven(world, truth, seed=1, beams=300):
    """The scans of a drive at true poses (N, 3)."""
    scene = Scene.of(world, beams, seed)
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(truth)])
    scanner = scene.scanner
    stamps = np.arange(len(truth)) / scanner.rate
    return RawDrive(stamps, ranges, Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max))


def odometry(truth, seed=0):
    """Poses (N, 3) in odom of a drive at true poses (N, 3), with the simulator's default noise."""
    odometer, poses = Odometer(OdometryNoise(), np.random.default_rng(seed)), [np.zeros(3)]
    for before, after in pairwise(truth):
        odometer.move(before, after)
        poses.append(odometer.pose)
    return np.array(poses)
