"""Calibration on real scans: shares of outliers, noise, motion, precision, and cells that were never seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.errors import UserError
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import Seeds
from services.estimator.precise.learning import calibration
from services.estimator.precise.learning.calibration import learn_motion, learn_outlier_fractions
from services.estimator.precise.learning.drive_learning import learn_drive
from services.estimator.precise.learning.field_learning import Recipe, learn_field, seen_cells
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.precise.likelihood import Evidence, Likelihood
from services.estimator.precise.noise import estimate_noise
from services.estimator.shared.generative_models import Expected
from services.estimator.shared.interface import Observation
from tests.lab.real_logs import drives as real_drive
from tests.lab.real_logs.drives import ANGLES, BEFORE, LONG, NONE, POSED, RANGE_MAX, SHORT, SIGMA, disturbed

RECIPE = Recipe(resolution=0.05, sweeps=5, beams_per_sweep=60_000)
SCANS = 160


@pytest.fixture(scope="module")
def drive():
    return real_drive.drive(SCANS)


@pytest.fixture(scope="module")
def learned(drive):
    return learn_drive(drive.part(np.arange(SCANS // 2)), RECIPE, None, lambda *_: None)


def test_drive_without_returns(drive):
    """Also where the surfaces of a map are given."""
    none = replace(drive, ranges=np.full_like(drive.ranges, np.inf))
    simulated = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges)
    with pytest.raises(UserError, match=r"no surface to learn from: .*Check that ranges are in metres"):
        learn_drive(none, RECIPE, simulated, lambda *_: None)


@pytest.mark.parametrize(
    ("curvature", "off", "message"),
    [(0.0, 0.0, "too few surfaces to find the pose"), (100.0, 1.0, "none of the 4 held-out scans fits the model")],
)
def test_scans_that_do_not_show_the_pose(curvature, off, message):
    matrices = curvature * np.eye(3)[None]
    fitted = [(np.array([[off, 0.0, 0.0]]), Evidence(np.zeros(1), np.zeros((1, 3)), *[matrices] * 3))] * 4
    with pytest.raises(UserError, match=message):
        calibration._pose_precision(fitted, np.zeros((4, 3)))


def test_outlier_shares():
    rng = np.random.default_rng(3)
    surface = rng.uniform(2, 8, (200, 121))
    expected = Expected(surface, np.full(surface.shape, 1e-3), np.zeros((*surface.shape, 3)))
    measured = disturbed(surface + SIGMA * rng.standard_normal(surface.shape), rng)
    found = learn_outlier_fractions(measured, expected, RANGE_MAX, Likelihood(SIGMA))
    assert found.short == pytest.approx(SHORT / (1 - NONE), abs=0.005)
    assert found.random == pytest.approx(LONG / (1 - NONE), abs=0.004)
    assert found.unseen == pytest.approx(NONE, abs=0.002)


def test_noise():
    rng = np.random.default_rng(1)
    clean = BEFORE.ray_distances(np.array([[3.0, 3.0, yaw] for yaw in np.linspace(0, 6, 40)]), ANGLES)
    blocked = np.where(np.abs(ANGLES - 0.3) < 0.1, 0.7, clean)
    blocked[:, 5] = np.inf
    for sigma in (0.005, 0.03):
        found = estimate_noise(blocked + sigma * rng.standard_normal(clean.shape), ANGLES)
        assert found == pytest.approx(sigma, rel=0.25)


def test_motion(drive):
    found = learn_motion(drive.stamps, drive.poses, drive.odom)
    assert found.period == pytest.approx(0.25)
    assert 0.3 < found.speed < 0.8  # m/s; the robot drives at 0.4 to 0.5 m/s
    without = learn_motion(drive.stamps, drive.poses, None)
    assert without.path_by_path != found.path_by_path
    odom_from_third_scan = drive.odom.copy()
    odom_from_third_scan[:2] = np.nan
    partly = learn_motion(drive.stamps, drive.poses, odom_from_third_scan)
    rest = learn_motion(drive.stamps[2:], drive.poses[2:], drive.odom[2:])
    assert partly.path_by_path == pytest.approx(rest.path_by_path)


def test_transient_object():
    """A person seen in a tenth of the scans leaves no surface in the field."""
    poses = np.array([[3.0, 3.0, yaw] for yaw in np.linspace(-np.pi, np.pi, 100)])
    ranges = BEFORE.ray_distances(poses, ANGLES)
    rng = np.random.default_rng(0)
    person = (rng.random(100) < 0.1)[:, None] & (np.abs(ANGLES) < 0.1)
    blocked = np.where(person, 1.0, ranges) + SIGMA * rng.standard_normal(ranges.shape)
    field = learn_field(Beams.of(poses, np.zeros(3), ANGLES, blocked), RECIPE)
    error = np.abs(field.trace(poses, ANGLES).ranges - ranges)
    assert (error > 0.3).mean() < 0.02


def test_unseen_cells():
    """The range of a beam into cells that were never seen is neither evidence for a pose nor against it."""
    poses = np.array([[2.0, 4.0, yaw] for yaw in np.linspace(2.8, 3.5, 100)])  # never facing right
    ranges = BEFORE.ray_distances(poses, ANGLES)
    beams = Beams.of(poses, np.zeros(3), ANGLES, ranges)
    seen = seen_cells(beams)
    assert seen.contains(np.array([[1.0, 4.0]]))[0]
    assert not seen.contains(np.array([[8.5, 1.0], [50.0, 0.0]])).any()
    model = FieldModel(learn_field(beams, RECIPE), seen=seen)
    right = np.array([[2.0, 4.0, 0.0]])
    expected = model.expect(right, np.zeros(1))
    assert np.isinf(expected.scale[0, 0])
    assert not expected.jacobian.any()
    likelihood = Likelihood()
    near, far = (likelihood.evaluate(np.array([r]), RANGE_MAX, expected).accuracy[0] for r in (5.0, 9.0))
    assert near == pytest.approx(far)


def test_covariance(learned):
    """NEES of poses found in held-out scans, with floors of the size of the references' error, 2 cm."""
    found = learned.calibration
    assert found.scans == 16
    assert 1.2 < found.nees_median < 3.6
    assert found.nees_mean < 6
    assert POSED[0] / 2 < found.floor_position < 2 * POSED[0]
    assert POSED[2] / 3 < found.floor_heading < 3 * POSED[2]
    assert found.likelihood.short == pytest.approx(SHORT, abs=0.05)
    assert all(abs(observed - stated) < 0.12 for stated, observed in found.coverage)


def test_second_half_of_the_drive(drive, learned):
    """With and without odometry from a known pose, and from an unknown pose."""
    settings = learned.calibration.settings()
    made = PreciseEstimator(
        learned.model, Seeds.at(learned.model, learned.places), drive.mount, learned.calibration.likelihood, settings
    )
    half = SCANS // 2
    for odometry, start in ((True, drive.poses[half]), (False, drive.poses[half]), (True, None)):
        made.restart(start, None if start is None else np.diag([0.01, 0.01, 0.0025]))
        errors, wrong = [], 0
        for k in range(half, SCANS, 1 if start is not None else 6):
            posterior = made.update(observation(drive, k, odometry=odometry))
            errors.append(np.hypot(*(posterior.pose - drive.poses[k])[:2]))
            wrong += posterior.state == "tracking" and errors[-1] > 0.5
        assert np.median(errors) < 0.05  # the references are 0.02 m off in x and in y
        assert np.mean(np.array(errors) < 0.5) > 0.95
        assert not wrong


def observation(drive, k, *, odometry):
    odom = drive.odom[k] if odometry else None
    return Observation(drive.ranges[k], ANGLES, RANGE_MAX, float(drive.stamps[k]), odom)
