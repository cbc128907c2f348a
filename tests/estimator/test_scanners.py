"""Scanners of many kinds and mounts: a field is learned with each, with which the robot is found and tracked."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from common.geometry import se2
from common.robot.scanner import SCANNERS, Scanner
from lab.accuracy import bound, tasks
from lab.accuracy.runner import quick_field
from lab.accuracy.scenes import Scene
from services.estimator.factory import DEFAULT_SIGMA_M, EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.gauss_newton import polish
from services.estimator.precise.global_seeds import SEED_SPACING_M, Seeds, thin_places
from services.estimator.precise.scan_likelihood import ScanLikelihood
from tests.estimator.models import ROOM

OFF_CENTRE = {"mount": (-0.12, 0.1, 2.0)}
MOUNTED = {
    "lms200, off-centre": SCANNERS["lms200"].model_copy(update=OFF_CENTRE),
    "tim571, upside down": SCANNERS["tim571"].with_beams(271).model_copy(update={"upside_down": True, **OFF_CENTRE}),
    "backwards, from 0 to 359 deg": SCANNERS["rplidar-a1"].model_copy(
        update={"first": 0.0, "upside_down": True, "mount": (-0.1, 0.0, np.pi)}
    ),
    "to the left alone": SCANNERS["lms200"].model_copy(update={"first": 0.0, "fov": float(np.deg2rad(140))}),
}
EVERY = {**SCANNERS, **MOUNTED}
PLACES = 6
TRACKED = 40  # number of scans
LEARNED = 100_000  # number of beams to learn from


@cache
def learned(name: str) -> FieldModel:
    scanner = SCANNERS[name]
    return quick_field(
        ROOM, ScannerGeometry.of(scanner), np.random.default_rng(0), LEARNED // scanner.beams, limited=True
    )


def precise(model: FieldModel, scanner: Scanner) -> PreciseEstimator:
    places = thin_places(ROOM.sample_free(2000, np.random.default_rng(0), 0.05), SEED_SPACING_M)
    geometry = ScannerGeometry.of(scanner)
    return PreciseEstimator(model, Seeds.at(model, places), geometry.mount, geometry.likelihood())


def biases(made: PreciseEstimator, scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Squared position error (N,) in m² caused by the model alone: scans without noise, descent from the true pose."""
    scanner, found = scene.scanner, []
    for pose, clean in zip(poses, scanner.limit(scene.clean(poses)), strict=True):
        view = ScanLikelihood(made.model, made.likelihood, made.mount, scanner.angles(), clean, scanner.range_max)
        off = polish(view, pose[None])[0][0] - pose
        found.append(float(np.square(off[:2]).sum()))
    return np.array(found)


def check(made: PreciseEstimator, scene: Scene, posteriors: list, poses: np.ndarray) -> None:
    """Mean squared error relative to the Cramer-Rao bound, and NEES, are each within 3.3 deviations (99.9 %)."""
    off = np.array([posterior.pose for posterior in posteriors]) - poses
    off[:, 2] = se2.wrap(off[:, 2])
    expected = np.square(bound.position(bound.single(scene, poses))) + biases(made, scene, poses)
    ratio = float(np.mean(np.square(off[:, :2]).sum(axis=1) / expected))
    nees = np.mean([o @ np.linalg.solve(p.covariance, o) for o, p in zip(off, posteriors, strict=True)])
    # For an efficient estimator the squares are chi squared distributed, with a variance of at most 2.
    assert ratio < 1 + 3.3 * np.sqrt(2 / len(off))
    assert nees < 3 + 3.3 * np.sqrt(6 / len(off))


def is_at(guess: np.ndarray, pose: np.ndarray) -> bool:
    off = np.abs(guess - pose)
    return bool(np.hypot(off[0], off[1]) < tasks.FOUND_DISTANCE and abs(se2.wrap(off[2])) < tasks.FOUND_YAW)


@pytest.mark.parametrize("name", EVERY)
def test_found_and_tracked(name):
    scanner = EVERY[name]
    made = precise(learned(scanner.name), scanner)
    scene = Scene(ROOM, scanner, np.random.default_rng(1))
    poses = scene.poses(PLACES)
    found = []
    for pose, clean in zip(poses, scene.clean(poses), strict=True):
        made.restart()
        posterior = made.update(scene.observe(clean, 0.0))
        # A scanner that sees half a circle may confuse corners of this plain room; then all hypotheses are kept.
        assert any(is_at(hypothesis.pose, pose) for hypothesis in posterior.hypotheses if hypothesis.weight > 0.05)
        if posterior.hypotheses[0].weight > 0.9:
            found.append((posterior, pose))
    assert len(found) >= PLACES // 2
    check(made, scene, [each for each, _ in found], np.array([pose for _, pose in found]))
    path = scene.path(TRACKED / scanner.rate)[:TRACKED]
    made.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    tracked = [made.update(scene.observe(scene.clean(pose[None])[0], k / scanner.rate)) for k, pose in enumerate(path)]
    assert {posterior.state for posterior in tracked[5:]} == {"tracking"}
    check(made, scene, tracked, path)


def test_field_of_another_scanner():
    """Learned with 270 deg, 20 mm noise and a beam per 1/3 deg; used with 180 deg, 5 mm noise and a beam per degree."""
    scanner = SCANNERS["lms200"]
    made = precise(learned("tim571"), scanner)
    scene = Scene(ROOM, scanner, np.random.default_rng(2))
    path = scene.path(TRACKED / scanner.rate)[:TRACKED]
    made.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    scans = scene.clean(path)
    check(made, scene, [made.update(scene.observe(scan, k / scanner.rate)) for k, scan in enumerate(scans)], path)


@pytest.mark.parametrize("name", ["lms200", "tim571, upside down", "backwards, from 0 to 359 deg"])
def test_particle_filter(name):
    scanner = EVERY[name]
    made = prepare_factory(EstimatorOptions(ROOM, "particle-filter"))(ScannerGeometry.of(scanner))
    scene = Scene(ROOM, scanner, np.random.default_rng(3))
    for pose, clean in zip(poses := scene.poses(3), scene.clean(poses), strict=True):
        made.restart(pose + np.array([0.05, -0.05, 0.03]))
        for k in range(10):
            posterior = made.update(scene.observe(clean, k / scanner.rate))
        off = (posterior.pose - pose)[:2]
        assert (
            off @ np.linalg.solve(posterior.covariance[:2, :2], off) < 13.8
        )  # chi squared with 2 degrees of freedom, 99.9 %
        assert np.hypot(*off) < 0.03


def test_stated_noise():
    scanner = SCANNERS["rplidar-a1"]
    stated = ScannerGeometry.of(scanner).likelihood()
    assert stated.relative == 0.01
    assert stated.deviation(np.array([5.0, np.inf])) == pytest.approx([0.05, 1e-3], rel=1e-3)
    assert ScannerGeometry.of(scanner).likelihood(0.03).deviation(np.array([5.0])) == 0.03
    silent = ScannerGeometry(scanner.angles(), np.zeros(3), 12.0)
    assert silent.likelihood().deviation(np.array([5.0])) == DEFAULT_SIGMA_M
    assert not silent.same(
        ScannerGeometry.of(scanner.model_copy(update={"mount": (0.0, 0.0, 0.0)})), bound_to_beams=False
    )
