"""Estimators with scans that are distorted by motion."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from lab.accuracy.motion_distortion import observations
from lab.accuracy.scenes import Scene
from services.estimator.particle_filter import ParticleFilter
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.global_seeds import Seeds, thin_places
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Observation
from services.estimator.shared.motion_correction import correct_motion, pose_at_stamp
from tests.estimator.models import ROOM
from tests.estimator.test_particle_filter import CERTAIN, SMALL, drive

MODEL = RayCaster(ROOM)


def precise(mount):
    return PreciseEstimator(MODEL, Seeds.at(MODEL, ROOM.sample_free(500, np.random.default_rng(0), 0.3)), mount)


def particle_filter(mount):
    return ParticleFilter(ROOM, SMALL, tuple(mount), 1)


def rms(make, kind, prior):
    """RMS of the position error in m along a curve at up to 1 m/s and 1 rad/s."""
    scene, path = Scene.of(ROOM, 271, 5), drive(45)
    found = make(np.array(scene.scanner.mount))
    found.restart(path[0], CERTAIN)
    poses = np.array([found.update(each).pose for each in observations(scene, path, kind, prior)])
    return float(np.sqrt(np.square(poses - path[:-1])[10:, :2].sum(1).mean()))


@pytest.mark.parametrize("prior", ["laser only", "odometry"])
@pytest.mark.parametrize("make", [precise, particle_filter])
def test_error_over_that_without_distortion(make, prior):
    instantaneous, corrected, uncorrected = map(
        partial(rms, make, prior=prior), ("instantaneous", "corrected", "uncorrected")
    )
    assert corrected < 1.3 * instantaneous < uncorrected


@pytest.mark.parametrize("make", [precise, particle_filter])
def test_replay_that_starts_again(make):
    """The duration of the motion back to the start is unknown, so scans are not corrected for it."""
    scene, path = Scene.of(ROOM, 271, 5), drive(60)
    found = make(np.array(scene.scanner.mount))
    found.restart(path[0], CERTAIN)
    scans = observations(scene, path, "corrected", "odometry")
    for each in scans:
        found.update(each)
    error = found.update(scans[0]).pose - path[0]
    assert np.hypot(*error[:2]) < 0.2


def test_jump_is_no_motion():
    """The first scan after a robot that stood is carried along a wall is not corrected for the jump."""
    world = load_world("corridor")
    scene, model = Scene.of(world, 811, 5), RayCaster(world)
    mount = np.array(scene.scanner.mount)
    places = thin_places(world.sample_free(4000, np.random.default_rng(0), 0.05), 0.3)
    made = PreciseEstimator(model, Seeds.at(model, places), mount)
    here, there = np.array([4.62, 1.51, 0.92]), np.array([13.0, 1.2, 0.92])
    made.restart(here, CERTAIN)
    for k, clean in enumerate(scene.clean(np.array([here] * 3 + [there]))):
        posterior = made.update(scene.observe(clean, k / 15, time_increment=0.05 / 811))
    assert posterior.state == "tracking"
    np.testing.assert_allclose(posterior.pose, there, atol=0.01)


def test_pose_at_the_stamp():
    """In the middle of a sweep of half the scan period, half of that is a quarter of the way back."""
    observation = Observation(np.ones(11), np.zeros(11), 9.0, time_increment=0.005)
    here, motion = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.02, 0.2])
    found = pose_at_stamp(here, motion / 0.1, 0.1, observation)
    np.testing.assert_allclose(se2.between(here, found), 0.25 * se2.inverse(motion), atol=1e-12)
    assert pose_at_stamp(here, None, 0.1, observation) is here
    assert correct_motion(observation, None, here) is observation
