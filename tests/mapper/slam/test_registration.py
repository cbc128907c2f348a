"""Registration along a corridor: noise must not be taken for information about the place along it."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from lab.accuracy.scenes import Scene
from services.mapper.slam.elements import elements_of_scan
from services.mapper.slam.registration import PosePrior, Surface, register

CORRIDOR = World(name="corridor", boundary=[(0, 0), (60, 0), (60, 2), (0, 2)])  # longer than the scanner sees
HERE = np.array([30.0, 1.0, 0.3])
PRIOR = np.diag([0.05, 0.05, 0.05])  # standard deviations


def elements_at(pose, beams, seed):
    scene = Scene.of(CORRIDOR, beams, seed)
    seen = scene.observe(scene.clean(pose[None])[0], 0.0)
    return elements_of_scan(seen.ranges, seen.angles, np.array(scene.scanner.mount), seen.range_max)


@pytest.mark.parametrize("beams", [60, 270, 622])
def test_corridor_does_not_show_the_place_along_it(beams):
    """Along the corridor, the robot moves as the prior predicts; across it, as the scans show."""
    moved, expected = HERE + np.array([0.1, 0.02, 0.01]), HERE + np.array([0.1, 0.0, 0.0])
    prior, errors, deviations = PosePrior(expected, np.linalg.inv(PRIOR**2)), [], []
    for seed in range(20):
        before = Surface(elements_at(HERE, beams, seed).transformed(HERE))
        found = register(before, elements_at(moved, beams, seed + 100), expected, prior)
        errors.append(found.pose - moved)
        deviations.append(found.information[0, 0] ** -0.5)
    along, across, turn = np.sqrt(np.mean(np.square(errors), axis=0))
    assert along < 0.025
    assert across < 0.01
    assert turn < 0.005
    assert np.median(deviations) > 0.1


def test_variance_of_directions():
    walls = [elements_at(HERE, 622, seed) for seed in range(20)]
    x, y = np.concatenate([se2.rotate(float(HERE[2]), wall.normals) for wall in walls]).T
    direction_variances = np.concatenate([wall.direction_variances for wall in walls])
    assert direction_variances.mean() == pytest.approx(np.mean(np.arctan(x / y) ** 2), rel=0.3)
