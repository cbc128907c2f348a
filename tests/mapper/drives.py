"""Simulated drives."""

from __future__ import annotations

import numpy as np

from lab.accuracy.scenes import Scene
from services.mapper.slam.drive import Laser, RawDrive


def driven(world, truth, seed=1, beams=300):
    """The scans of a drive at true poses (N, 3)."""
    scene = Scene.of(world, beams, seed)
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(truth)])
    scanner = scene.scanner
    stamps = np.arange(len(truth)) / scanner.rate
    return RawDrive(stamps, ranges, Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max))
