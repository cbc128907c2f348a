"""Recent scans hold the pose where the model knows nothing, but not after a kidnapping."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World
from lab.accuracy.scenes import Scene
from services.estimator.precise.continuity import MIN_PROVEN_SCANS, MIN_SHARE_TO_BEGIN, Continuity
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.gauss_newton import View
from services.estimator.precise.global_seeds import Seeds, thin_places
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import Candidate
from services.estimator.precise.scan_memory import RecentScans
from services.estimator.shared.generative_models import Expected, RayCaster
from tests.estimator.models import ROOM

HALL = World(
    name="hall",
    boundary=[(0, 0), (16, 0), (16, 5), (0, 5)],
    obstacles=[
        {"box": {"center": (2.5, 4.2), "size": (0.8, 0.5), "yaw_deg": 15}},
        {"circle": {"center": (5.5, 0.8), "radius": 0.3}},
        {"box": {"center": (9.5, 4.3), "size": (0.7, 0.7), "yaw_deg": 40}},
        {"circle": {"center": (12.0, 0.9), "radius": 0.4}},
        {"box": {"center": (14.6, 2.6), "size": (0.5, 1.2)}},
    ],
)
LEARNED = 8.0  # m: the part of HALL with smaller x was learned
STEP = np.diag([0.2, 0.2, 0.3]) ** 2


@dataclass(frozen=True)
class HalfLearned:
    """A model of the hall that was learned only in its western half."""

    world: World = HALL
    ripple: float = 0.0

    def expect(self, lasers, angles):
        whole = RayCaster(self.world).expect(lasers, angles)
        ends = lasers[:, :1] + whole.ranges * np.cos(lasers[:, 2:] + angles)
        unknown = (ends > LEARNED) | (lasers[:, :1] > LEARNED)
        return Expected(
            np.where(unknown, np.inf, whole.ranges),
            np.where(unknown, np.inf, whole.scale),
            np.where(unknown[..., None], 0.0, whole.jacobian),
        )


def scan(scene, pose):
    """End points (K, 2) of a scan, m in the laser frame."""
    seen = scene.observe(scene.clean(np.array(pose)[None])[0], 0.0)
    return View(RayCaster(HALL), Likelihood(), np.zeros(3), seen.angles, seen.ranges, seen.range_max).points


@given(x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1), yaw=st.floats(-0.12, 0.12), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_match(x, y, yaw, seed):
    scene = Scene.of(ROOM, 361, seed)
    recent = RecentScans(np.array(scene.scanner.mount))
    here = np.array([3.0, 1.5, 0.4])
    assert recent.add(here, scan(scene, here))
    there = se2.compose(here, [x, y, yaw])
    match = recent.match(here[None], scan(scene, there), Candidate("any", here, STEP, 1.0))
    assert match is not None
    off = se2.between(there, match.pose)
    assert np.hypot(off[0], off[1]) < 0.02
    assert abs(off[2]) < 0.01
    assert match.share > 0.7
    assert not match.degenerate


def test_scan_from_elsewhere():
    scene = Scene.of(HALL, 361, 1)
    recent = RecentScans(np.array(scene.scanner.mount))
    here = np.array([3.0, 2.0, 0.0])
    recent.add(here, scan(scene, here))
    for there in ([12.5, 3.5, 2.0], [14.0, 1.2, -2.0], [9.0, 1.0, 1.0]):
        match = recent.match(here[None], scan(scene, there), Candidate("any", here, STEP, 1.0))
        assert match is None or match.share < MIN_SHARE_TO_BEGIN


def test_featureless_hall():
    bare = World(name="bare", boundary=[(0, 0), (60, 0), (60, 2), (0, 2)])
    scene = Scene.of(bare, 361, 1)
    recent = RecentScans(np.array(scene.scanner.mount))
    here = np.array([30.0, 1.0, 0.0])
    recent.add(here, scan(scene, here))
    match = recent.match(here[None], scan(scene, here), Candidate("any", here, STEP, 1.0))
    assert match is not None
    assert match.degenerate


def test_too_few_points():
    recent = RecentScans(np.zeros(3))
    assert not recent.add(np.zeros(3), np.zeros((3, 2)))
    assert recent.match(np.zeros((1, 3)), np.ones((100, 2)), Candidate("any", np.zeros(3), STEP, 1.0)) is None


@given(yaw=st.floats(-3, 3), x=st.floats(-5, 5))
@settings(max_examples=15, deadline=None)
def test_any_frame(yaw, x):
    """The same scans elsewhere in the map give the same relative pose, with the covariance rotated."""
    scene = Scene.of(ROOM, 361, 7)
    poses = [np.array([2.5 + 0.3 * k, 1.5, 0.1 * k]) for k in range(5)]
    points = [scan(scene, pose) for pose in poses]

    def matched(move):
        made = Continuity(np.array(scene.scanner.mount))
        made.reset(pose_given=True)
        for pose, seen in zip(poses[:4], points[:4], strict=True):
            made.add(se2.compose(move, pose), np.diag([1e-4, 1e-4, 1e-5]), seen, explained=True)
        start = se2.compose(move, poses[4])
        turn = np.eye(3)
        turn[:2, :2] = se2.rotate(float(move[2]), np.eye(2)).T
        found = made.match([Candidate("any", start, turn @ STEP @ turn.T, 1.0)], start, points[4], 0.0)
        assert found is not None
        return found.mean, turn.T @ found.covariance @ turn

    move = np.array([x, -x, yaw])
    (mean, covariance), (moved, turned) = matched(np.zeros(3)), matched(move)
    assert se2.between(se2.compose(move, mean), moved) == pytest.approx(np.zeros(3), abs=2e-4)
    assert turned == pytest.approx(covariance, rel=0.05, abs=1e-7)


def test_proof_and_contradiction():
    scene = Scene.of(ROOM, 361, 7)
    made = Continuity(np.array(scene.scanner.mount))
    here = np.array([2.5, 1.5, 0.0])
    candidates = [Candidate("any", here, STEP, 1.0)]
    for k in range(MIN_PROVEN_SCANS):
        assert made.match(candidates, here, scan(scene, here), 0.0) is None
        made.add(
            se2.compose(here, [0.3 * k, 0, 0]),
            np.eye(3) * 1e-4,
            scan(scene, here + np.array([0.3 * k, 0, 0])),
            explained=True,
        )
    assert made.match(candidates, here, scan(scene, here), 0.0) is not None
    made.begin_scan(1.0)
    assert made.match(candidates, here, scan(scene, here), 0.0) is None  # the robot may have moved by a metre
    made.begin_scan(0.1)
    matched = [made.match(candidates, here, scan(scene, here), 0.9) is not None for _ in range(30)]
    assert matched[0]
    assert not matched[-1]


def drive(made, scene, path, first=0):
    posteriors = []
    for k, pose in enumerate(path):
        posteriors.append(made.update(scene.observe(scene.clean(pose[None])[0], (first + k) / 15)))
    return posteriors


@pytest.fixture(scope="module")
def driven():
    """An estimator after a drive from the learned half to the other one, its scene, and the path."""
    scene = Scene.of(HALL, 271, 3)
    places = thin_places(HALL.sample_free(4000, np.random.default_rng(0), 0.05), 0.3)
    model = HalfLearned()
    seeds = Seeds.at(model, places[places[:, 0] < LEARNED])
    made = PreciseEstimator(model, seeds, np.array(scene.scanner.mount))
    x = np.linspace(3.0, 13.0, 200)
    path = np.column_stack([x, 2.5 + 0.3 * np.sin(x), 0.5 * np.sin(0.7 * x)])
    made.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    found = drive(made, scene, path)
    assert max(np.hypot(*(p.pose - pose)[:2]) for p, pose in zip(found, path, strict=True)) < 0.15
    assert found[40].state == "tracking"
    assert found[-1].state != "tracking"
    return made, scene, path


@pytest.mark.parametrize("kidnapped", [False, True])
def test_unlearned_room(driven, kidnapped):
    made, scene, path = copy.deepcopy(driven)
    then = np.tile([2.0, 1.5, 2.0], (20, 1)) if kidnapped else path[::-1]
    found = drive(made, scene, then, len(path))
    assert np.hypot(*(found[-1].pose - then[-1])[:2]) < 0.02
    assert found[-1].state == "tracking"
