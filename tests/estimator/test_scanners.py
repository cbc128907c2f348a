"""Any scanner on any side of the robot: a field learned with it in a second, the place found, tracked, honestly stated."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from common import se2
from common.scanner import SCANNERS, Scanner
from presage.accuracy import bound, tasks
from presage.accuracy.running import quick_field
from presage.accuracy.scenes import Scene
from services.estimator.building import Choice, Geometry, prepare
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.gauss_newton import View, polish
from services.estimator.precise.seeding import SPACING, Seeds, thin_places
from tests.estimator.models import ROOM

OFF_CENTRE = {"mount": (-0.12, 0.1, 2.0)}
MOUNTED = {
    "rplidar-a1, backwards": SCANNERS["rplidar-a1"].model_copy(update={"mount": (-0.1, 0.0, np.pi)}),
    "lms200, off-centre": SCANNERS["lms200"].model_copy(update=OFF_CENTRE),
    "tim571, upside down": SCANNERS["tim571"].with_beams(271).model_copy(update={"upside_down": True, **OFF_CENTRE}),
    "from 0 to 359 deg": SCANNERS["rplidar-a1"].model_copy(update={"first": 0.0, "upside_down": True}),
    "to the left alone": SCANNERS["lms200"].model_copy(update={"first": 0.0, "fov": float(np.deg2rad(140))}),
}
EVERY = {**SCANNERS, **MOUNTED}
PLACES = 12
TRACKED = 90  # scans


@cache
def learned(name: str) -> FieldModel:
    return quick_field(ROOM, Geometry.of(SCANNERS[name]), np.random.default_rng(0), 150)


def precise(model: FieldModel, scanner: Scanner) -> PreciseEstimator:
    places = thin_places(ROOM.sample_free(2000, np.random.default_rng(0), 0.05), SPACING)
    geometry = Geometry.of(scanner)
    return PreciseEstimator(model, Seeds.at(model, places), geometry.mount, geometry.likelihood())


def biases(made: PreciseEstimator, scene: Scene, poses: np.ndarray) -> np.ndarray:
    """(N,) m², squared position error that the model alone leaves: scans without noise, descended from the truth."""
    scanner, found = scene.scanner, []
    for pose, clean in zip(poses, scanner.limit(scene.clean(poses)), strict=True):
        view = View(made.model, made.likelihood, made.mount, scanner.angles(), clean, scanner.range_max)
        off = polish(view, pose[None])[0][0] - pose
        found.append(float(np.square(off[:2]).sum()))
    return np.array(found)


def check(made: PreciseEstimator, scene: Scene, posteriors: list, poses: np.ndarray) -> None:
    """Mean squared error by the Cramer-Rao bound's, and NEES, each within 3.3 deviations of such a mean (99.9 %)."""
    off = np.array([posterior.pose for posterior in posteriors]) - poses
    off[:, 2] = se2.wrap(off[:, 2])
    expected = np.square(bound.position(bound.single(scene, poses))) + biases(made, scene, poses)
    ratio = float(np.mean(np.square(off[:, :2]).sum(axis=1) / expected))
    nees = np.mean([o @ np.linalg.solve(p.covariance, o) for o, p in zip(off, posteriors, strict=True)])
    print(
        f"{scene.scanner.name} ratio {ratio:.2f} of {1 + 3.3 * np.sqrt(2 / len(off)):.2f} nees {nees:.2f} of {3 + 3.3 * np.sqrt(6 / len(off)):.2f} bias {np.sqrt(biases(made, scene, poses).mean()) * 1e3:.2f} bound {np.sqrt(expected.mean()) * 1e3:.2f}"
    )
    assert ratio < 1 + 3.3 * np.sqrt(
        2 / len(off)
    )  # an efficient estimator's squares are chi squared: variance 2 at most
    assert nees < 3 + 3.3 * np.sqrt(6 / len(off))


@pytest.mark.parametrize("name", EVERY)
def test_it_is_found_from_nothing_and_tracked_at_the_bound(name):
    scanner = EVERY[name]
    made = precise(learned(scanner.name), scanner)
    scene = Scene(ROOM, scanner, np.random.default_rng(1))
    poses = scene.poses(PLACES)
    found = []
    for pose, clean in zip(poses, scene.clean(poses), strict=True):
        made.restart()
        found.append(made.update(scene.observe(clean, 0.0)))
        assert np.hypot(*(found[-1].pose - pose)[:2]) < tasks.FOUND_DISTANCE
    check(made, scene, found, poses)
    path = scene.path(TRACKED / scanner.rate)[:TRACKED]
    made.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    tracked = [made.update(scene.observe(scene.clean(pose[None])[0], k / scanner.rate)) for k, pose in enumerate(path)]
    assert {posterior.state for posterior in tracked[5:]} == {"tracking"}
    check(made, scene, tracked, path)
