from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from presage.learning.odometry_check import odometry_warnings

PATH = Scene.of(load_world("office"), 30, 5).path(60)[::8]


def moved(motions):
    poses = [np.zeros(3)]
    for motion in motions:
        poses.append(se2.compose(poses[-1], motion))
    return np.array(poses)


def warnings(factors=(1.0, 1.0, 1.0), noise=0.0, yaw=0.0):
    """About an odometry whose motions are multiplied by ``factors``; the mount of the laser is wrong by ``yaw``."""
    rng = np.random.default_rng(3)
    motions = se2.between(PATH[:-1], PATH[1:])
    odom = moved(motions * factors + noise * rng.normal(size=motions.shape))
    return " ".join(odometry_warnings(se2.compose(PATH, np.array([0.0, 0.0, yaw])), odom))


@pytest.mark.parametrize(
    ("odometry", "warning"),
    [
        ({"factors": (1.2, 1.2, 1.0)}, "1.20 times the distances"),
        ({"factors": (1.0, 1.0, 0.8)}, "0.80 times the turns"),
        ({"factors": (1.0, -1.0, -1.0)}, "turns right where the scans turn left"),
        ({"factors": (0.0, 0.0, 0.0)}, "0.00 times the distances"),
        ({"yaw": np.deg2rad(10)}, "10 deg to the left"),
        ({"yaw": -np.deg2rad(90)}, "90 deg to the right"),
    ],
)
def test_contradiction(odometry, warning):
    assert warning in warnings(**odometry)


@pytest.mark.parametrize("odometry", [{}, {"noise": 0.02}, {"factors": (1.05, 1.05, 0.95)}, {"yaw": 0.03}])
def test_usual_errors(odometry):
    assert not warnings(**odometry)


def test_unknown_poses():
    odom = PATH * (1.2, 1.2, 1.0)
    odom[::2] = np.nan
    assert not odometry_warnings(PATH, odom)
    assert not odometry_warnings(PATH[:1], odom[:1])
