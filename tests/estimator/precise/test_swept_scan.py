"""The pose and the accelerations during a sweep, against exact motions and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.robot.motion_distortion import correct_beams
from lab.accuracy.motion_distortion import DistortionJob, run
from lab.accuracy.scenes import Scene
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.swept_scan import SweptEvidence, acceleration_factors, acceleration_limits
from services.estimator.shared.generative_models import RayCaster
from tests.estimator.models import ROOM

PERIOD, HALF_SWEEP = 1 / 15, 0.025  # s
POSE = np.array([2.0, 1.5, 0.4])
LIMITS = np.array([[1.0, 1.0, 3.0], [1.0, 2.0, 3.0]])


def swept_view(seed):
    """A noisy scan at POSE, as if it had been corrected without any acceleration."""
    scene = Scene.of(ROOM, 271, seed)
    seen, mount = scene.observe(scene.clean(POSE[None])[0], 0.0), np.array(scene.scanner.mount)
    times = np.linspace(-HALF_SWEEP, HALF_SWEEP, len(seen.angles))
    return ScanLikelihood(RayCaster(ROOM), Likelihood(), mount, seen.angles, seen.ranges, seen.range_max, times=times)


def path(times, first, second):
    """Positions of a point that accelerates by ``first`` until the first beam, then by ``second``; 0 at time 0."""
    times, velocity = np.asarray(times, float), 0.7  # at the first beam
    begun = times + HALF_SWEEP
    moved = velocity * begun + np.where(begun < 0, first, second) * begun**2 / 2
    return moved - velocity * HALF_SWEEP - second * HALF_SWEEP**2 / 2


@pytest.mark.parametrize("seed", range(3))
def test_displacement_is_that_of_the_motion(seed):
    """The factors of both accelerations, against the motion itself: its distance from the chord between two sweeps."""
    first, second = np.random.default_rng(seed).uniform(-3, 3, 2)
    swept = SweptEvidence.from_scan(swept_view(seed), POSE[None], LIMITS, PERIOD, np.zeros(6))
    chord = -path(-PERIOD, first, second) / PERIOD  # the mean velocity
    expected = path(-HALF_SWEEP, first, second) + HALF_SWEEP * chord
    found = swept.at_stamp @ np.repeat([first, second], 3)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_gradient_by_the_accelerations():
    """Against finite differences: the accuracy of the scan if its beams were moved back by the displacements."""
    view = swept_view(1)
    swept = SweptEvidence.from_scan(view, POSE[None], LIMITS, PERIOD, np.zeros(6))
    factors = acceleration_factors(view.times, PERIOD)

    def accuracy(accelerations):
        moved = sum(factor[:, None] * each for factor, each in zip(factors, accelerations.reshape(2, 3), strict=True))
        in_base = se2.rotate(-POSE[2], moved[:, :2])
        ranges, angles = correct_beams(view.ranges, view.angles, np.column_stack([in_base, moved[:, 2]]), view.mount)
        corrected = ScanLikelihood(view.model, view.likelihood, view.mount, angles, ranges, view.range_max)
        return float(corrected.evidence(POSE[None]).accuracy[0])

    step = 0.01
    slope = np.array([accuracy(step * e) - accuracy(-step * e) for e in np.eye(6)]) / (2 * step)
    np.testing.assert_allclose(swept.joint.xi[0, 3:], -slope, rtol=0.05, atol=0.02 * np.abs(slope).max())


def test_marginal_is_that_of_the_joint_gaussian():
    """The mean and the covariance of the pose, and of the displacement, against a solution for all nine unknowns."""
    assumed = np.random.default_rng(2).uniform(-1, 1, 6)
    swept = SweptEvidence.from_scan(swept_view(2), POSE[None], LIMITS, PERIOD, assumed)
    unaware = SweptEvidence.from_scan(swept_view(2), POSE[None], LIMITS, PERIOD, np.zeros(6))
    np.testing.assert_allclose(unaware.joint.xi[0, 3:] - swept.joint.xi[0, 3:], swept.prior[0] @ assumed, atol=1e-9)
    information = swept.joint.curvature[0].copy()
    information[3:, 3:] += swept.prior[0]
    covariance, xi = np.linalg.inv(information), swept.joint.xi[0]
    mean, of_pose = covariance @ xi, swept.of_pose()
    np.testing.assert_allclose(np.linalg.inv(of_pose.curvature[0]), covariance[:3, :3], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.solve(of_pose.curvature[0], of_pose.xi[0]), mean[:3], atol=1e-9)
    displacement = swept.displacement(0, POSE + mean[:3], POSE + mean[:3])
    np.testing.assert_allclose(displacement.mean, swept.at_stamp @ (assumed + mean[3:]), atol=1e-9)
    at_stamp = np.concatenate([np.eye(3), swept.at_stamp], axis=1)
    np.testing.assert_allclose(
        displacement.covariance_at_stamp(covariance[:3, :3]), at_stamp @ covariance @ at_stamp.T, rtol=1e-6
    )


@pytest.mark.parametrize("period", [0.03, PERIOD, 1.0, 60.0])
def test_a_pause_does_not_make_the_pose_uncertain(period):
    """However long ago the last scan was, the robot does not move farther during the sweep than at full speed."""
    view, noise = swept_view(1), MotionNoise()
    limits = acceleration_limits(noise, view.times, period)
    prior = SweptEvidence.from_scan(view, POSE[None], limits, period, np.zeros(6))
    deviation = np.sqrt(np.diag(prior.at_stamp @ np.linalg.inv(prior.prior[0]) @ prior.at_stamp.T))
    farthest = HALF_SWEEP * np.array([2 * noise.speed, 2 * noise.speed, 2 * noise.turn])
    assert (deviation < farthest).all()


@pytest.mark.parametrize("prior", ["laser only", "odometry"])
def test_errors_are_as_stated_while_accelerating(prior):
    """Without the accelerations, the NEES was above 10, and one scan in twenty exceeded a protection level."""
    _, corrected, _ = run(DistortionJob("corridor", "precise", prior, 1, 12.0, 311, 3))
    assert corrected["nees_mean"] < 4.5
    assert corrected["protection_exceeded"]["count"] <= 0.01 * corrected["protection_exceeded"]["of"]
