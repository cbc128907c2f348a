"""Preset precise as a whole, with exact rays and with the shipped fields."""

from __future__ import annotations

import subprocess
import sys
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World, load_world
from common.limits import MAX_BEAMS
from lab.accuracy import bound, tasks
from lab.accuracy.runner import quick_field
from lab.accuracy.scenes import TIM571, TWINS, Scene
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.estimator import TARGET_BEAMS, PreciseEstimator
from services.estimator.precise.global_seeds import Seeds, thin_places
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Observation
from tests.conftest import WAIT_TIMEOUT_S
from tests.estimator.models import ROOM

BEAMS = 271
WIDE_HALL = World(name="wide-hall", boundary=[(0, 0), (40, 0), (40, 30), (0, 30)])
HALL = World(name="hall", boundary=[(0, 0), (60, 0), (60, 2), (0, 2)])  # longer than the scanner's 25 m


def estimator(
    world: World, beams: int = BEAMS, range_max: float = 25.0, seed: int = 3
) -> tuple[PreciseEstimator, Scene]:
    scene = Scene.of(world, beams, seed, TIM571.model_copy(update={"range_max": range_max}))
    model = RayCaster(world)
    places = thin_places(world.sample_free(4000, np.random.default_rng(0), 0.05), 0.3)
    return PreciseEstimator(model, Seeds.at(model, places), np.array(scene.scanner.mount)), scene


def feed(made, scene, pose, count, first=0):
    clean = scene.clean(pose[None])[0]
    return [made.update(scene.observe(clean, (first + k) / 15)) for k in range(count)]


def off(posterior, pose):
    error = posterior.pose - pose
    error[2] = se2.wrap(error[2])
    return error


def test_search_with_many_beams(monkeypatch):
    made, scene = estimator(ROOM, beams=MAX_BEAMS)
    predicted = []

    def expect(self, lasers, angles):
        predicted.append((len(lasers), len(angles)))
        return cast(self, lasers, angles)

    cast = RayCaster.expect
    monkeypatch.setattr(RayCaster, "expect", expect)
    pose = scene.poses(1)[0]
    posterior = feed(made, scene, pose, 1)[0]
    assert np.abs(off(posterior, pose)).max() < 0.01
    assert posterior.predicted.shape == posterior.sigma.shape == (MAX_BEAMS,)
    assert max(beams for poses, beams in predicted if poses > 1) < 2 * TARGET_BEAMS


def test_error_and_bound():
    made, scene = estimator(ROOM)
    outcome = tasks.standing(made, scene, 12)
    one, many = outcome["from nothing, 1 scan"], outcome["standing, 20 scans"]
    assert one.found >= 11  # some of the poses see bare walls only, which fit as well after half a turn
    rms = [np.sqrt(np.mean(np.square(np.array(o.errors)[:, :2]).sum(1))) for o in (one, many)]
    limit = [np.sqrt(np.mean(np.square(o.bounds))) for o in (one, many)]
    assert 0.7 * limit[0] < rms[0] < 1.4 * limit[0]  # less would be an error of the test
    assert rms[1] < 1.6 * limit[1]


def test_covariance():
    """NEES of 50 scans: mean of chi squared with 3 degrees of freedom, 99.9 % band."""
    made, scene = estimator(ROOM)
    outcome = tasks.TaskOutcome()
    for pose in scene.poses(50):
        made.restart(pose, np.diag([0.05**2] * 3))  # far wider than the covariance of a scan
        outcome.add(feed(made, scene, pose, 1)[0], pose, None)
    assert len(outcome.nees) >= 49
    assert np.mean(outcome.nees) == pytest.approx(3, abs=3.3 * np.sqrt(6 / 50))


@pytest.mark.parametrize("odometry", [False, True])
def test_tracking(odometry):
    made, scene = estimator(ROOM)
    (outcome,) = tasks.tracking(made, scene, 10.0, odometry=odometry).values()
    assert outcome.found == outcome.total == 150
    rms = np.sqrt(np.mean(np.square(np.array(outcome.errors)[:, :2]).sum(1)))
    assert rms < 1.3 * np.sqrt(np.mean(np.square(outcome.bounds)))


def test_kidnapping():
    made, scene = estimator(load_world("maze"))  # unlike the empty room, it has no two similar places
    outcome = tasks.kidnapped(made, scene, 8)
    assert outcome["kidnapped, 1 scan"].found == 8
    assert outcome["kidnapped, 3 scans"].wrong == 0
    assert made._change_rate.remembered < 1  # nothing around the robot has changed


def test_blocked_beams():
    made, scene = estimator(ROOM)
    outcome, poses = tasks.TaskOutcome(), scene.poses(10)
    for pose, clean in zip(poses, scene.clean(poses), strict=True):
        made.restart()
        outcome.add(made.update(scene.observe(scene.blocked(clean, 0.3), 0.0)), pose, None)
    assert outcome.found >= 9
    assert np.median(np.hypot(*np.array(outcome.errors)[:, :2].T)) < 0.01


def test_standing_in_a_featureless_hall():
    """The position is unknown along the walls, and well known across."""
    made, scene = estimator(HALL, 90)
    pose = np.array([30.0, 0.9, 0.1])
    made.restart(pose, np.diag([0.04, 0.04, 0.01]))
    for k, posterior in enumerate(feed(made, scene, pose, 10)):
        along, across = np.sqrt(np.diag(posterior.covariance)[:2])
        assert along > 0.15, k
        assert across < 0.01, k
    limit = np.linalg.inv(bound.information(scene, pose[None])[0])
    assert limit[0, 0] > 100 * limit[1, 1]


@pytest.mark.parametrize("learned", [False, True])
def test_driving_in_a_featureless_hall(learned):
    """Without odometry and features the error along the walls grows, but remains within the stated covariance."""
    start, speed, scans = np.array([27.0, 0.9, 0.1]), 0.8, 75
    for seed in (0,) if learned else (0, 3):
        made, scene = estimator(HALL, 360, seed=seed)
        if learned:
            geometry = ScannerGeometry(scene.scanner.angles()[::4], np.array(scene.scanner.mount), 25.0)
            made.model = quick_field(HALL, geometry, np.random.default_rng(0), 3000)
        made.restart(start, np.diag([1e-4, 1e-4, 1e-4]))
        for k in range(scans):
            pose = start + np.array([speed / 15 * k, 0, 0])
            posterior = feed(made, scene, pose, 1, k)[0]
        error, stated = off(posterior, pose), np.sqrt(np.diag(posterior.covariance))
        assert abs(error[0]) < 3 * stated[0]
        assert stated[0] > 1
        assert abs(error[1]) < 0.02
        assert posterior.state != "tracking"


def drive(made, scene, path, slip=None):
    """Posteriors along poses (N, 3); with odometry that reports a share ``slip`` too much, or without."""
    made.restart(path[0], np.diag([1e-4, 1e-4, 1e-4]))
    odom, found = path[0], []
    for k, (pose, clean) in enumerate(zip(path, scene.clean(path), strict=True)):
        if slip is not None and k:
            odom = se2.compose(odom, (1 + slip) * se2.between(path[k - 1], pose))
        found.append(made.update(scene.observe(clean, k / 15, None if slip is None else odom)))
    return found


def straight(x, y, yaw, length, speed=1.0):
    along = np.arange(0, length, speed / 15)[:, None]
    return np.array([x, y, yaw]) + along * np.array([np.cos(yaw), np.sin(yaw), 0.0])


def test_motion_along_a_hall_by_what_the_map_lacks():
    """The map explains most of the scan, but only new columns show the motion along it."""
    made, _ = estimator(HALL, 360)
    columns = [{"circle": {"center": (25.0 + 3 * k, 0.3 + 1.4 * (k % 2)), "radius": 0.1}} for k in range(6)]
    scene = Scene.of(World(name="hall", boundary=HALL.boundary, obstacles=columns), 360, 4)
    path = straight(27.0, 1.0, 0.0, 3.0, speed=0.8)
    found = drive(made, scene, path)
    assert made.hypotheses[0].explained > made.settings.min_explained_fraction
    error, stated = off(found[-1], path[-1]), np.sqrt(np.diag(found[-1].covariance))
    assert abs(error[0]) < min(0.2, 3 * stated[0])


def test_slip_where_nothing_is_in_range():
    """The error of slipping wheels grows with the distance; the belief does not presume that it averages out."""
    made, scene = estimator(WIDE_HALL, range_max=4.0)
    path = straight(2.0, 2.0, 0.6, 16.0)
    found = drive(made, scene, path, slip=0.06)
    error = [float(np.hypot(*off(posterior, pose)[:2])) for posterior, pose in zip(found, path, strict=True)]
    assert all(posterior.state != "tracking" for posterior, e in zip(found, error, strict=True) if e > 0.2)
    along = se2.rotation(-0.6) @ off(found[-1], path[-1])
    stated = np.sqrt((se2.rotation(-0.6) @ found[-1].covariance @ se2.rotation(0.6))[0, 0])
    assert 0.5 < along[0] < 2 * stated < 2


def test_odometry_where_scans_confirm_it():
    """Slip does not reduce the accuracy in view of walls."""
    made, scene = estimator(ROOM)
    path = straight(1.0, 1.0, 0.2, 3.0)
    found = drive(made, scene, path, slip=0.06)
    assert all(posterior.state == "tracking" for posterior in found)
    assert max(np.abs(off(posterior, pose)[:2]).max() for posterior, pose in zip(found, path, strict=True)) < 0.02
    assert np.sqrt(np.trace(found[-1].covariance[:2, :2])) < 0.005


def test_slip_back_to_a_similar_place():
    """After a drift by the distance of two equal pillars, the scan fits at the wrong one."""
    pillars = [{"box": {"center": (x, 0.25), "size": (0.4, 0.5)}} for x in np.arange(3.0, 37.0, 0.8)]
    world = World(name="pillars", boundary=WIDE_HALL.boundary, obstacles=pillars)
    made, scene = estimator(world, range_max=4.0, seed=5)
    path = np.concatenate([straight(6.0, 2.0, 0.4, 12.0), straight(17.05, 6.67, -0.4, 8.0)])  # pillars again from 6 m
    found = drive(made, scene, path, slip=0.05)
    error = [float(np.hypot(*off(posterior, pose)[:2])) for posterior, pose in zip(found, path, strict=True)]
    assert max(error) > 0.3
    assert not [e for posterior, e in zip(found, error, strict=True) if posterior.state == "tracking" and e > 0.2]


def test_nothing_in_range_without_odometry():
    """The belief widens in all directions as fast as the robot can drive and turn, up to the whole map."""
    made, scene = estimator(WIDE_HALL, range_max=4.0)
    path = straight(2.0, 2.0, 0.6, 12.0)
    found = drive(made, scene, path)
    first = int(np.argmax((scene.clean(path) > 4.0).all(axis=1)))
    for k in (first + 30, len(path) - 1):
        stated = np.sqrt(np.diag(found[k].covariance))
        assert (np.abs(off(found[k], path[k])) < 2 * stated).all()
        assert (stated[:2] > 1).all()
        assert stated[2] > 1
    assert found[-1].state != "tracking"
    limit = np.sqrt(np.diag(made.seeds.spread))
    assert (np.sqrt(np.diag(found[-1].covariance)) < 1.01 * limit).all()


@pytest.mark.parametrize("start", [[7.7, 2.5, -2.6], [7.7, 2.5]], ids=["pose", "position"])
def test_initial_pose(start):
    made, scene = estimator(TWINS)
    pose = np.array([7.5, 2.6, -2.7])
    made.restart(np.array(start))
    posterior = feed(made, scene, pose, 1)[0]
    assert posterior.state == "tracking"
    assert np.abs(off(posterior, pose)).max() < 0.02


def test_wrong_initial_pose():
    """A pose at which the map explains nothing of the scan: the robot is found elsewhere."""
    made, scene = estimator(load_world("maze"))
    wrong, pose = scene.poses(2)
    made.restart(wrong, np.diag([1e-4, 1e-4, 1e-4]))
    posterior = feed(made, scene, pose, 1)[0]
    assert np.abs(off(posterior, pose)).max() < 0.02


def test_unexplained_scans():
    made, scene = estimator(ROOM)
    rng, angles = np.random.default_rng(0), scene.scanner.angles()
    garbage = [Observation(rng.uniform(0.1, 20, BEAMS), angles, 25.0, k / 15) for k in range(3)]
    assert [made.update(o).state for o in garbage] == ["localising"] * 3
    pose = np.array([3.0, 1.5, 1.0])
    assert feed(made, scene, pose, 3, 3)[-1].state == "tracking"
    posterior = [made.update(o) for o in garbage][-1]
    assert posterior.state == "lost"
    assert feed(made, scene, pose, 2, 9)[-1].state == "tracking"


@pytest.mark.parametrize("value", [np.inf, -np.inf])
def test_empty_scans(value):
    made, scene = estimator(ROOM)
    pose = np.array([3.0, 1.5, 1.0])
    empty = Observation(np.full(BEAMS, value), scene.scanner.angles(), 25.0, 0.0)
    for posterior in (made.update(empty), *feed(made, scene, pose, 2, 1), made.update(empty)):
        assert np.isfinite(posterior.pose).all()
        assert np.isfinite(posterior.covariance).all()
        assert np.isfinite(posterior.free_energy)
    assert np.abs(off(feed(made, scene, pose, 3, 5)[-1], pose)).max() < 0.02


def test_covered_scanner():
    """Scans that show nothing do not put off the search in the first scan that does."""
    made, scene = estimator(ROOM)
    pose = np.array([3.0, 1.5, 1.0])
    feed(made, scene, pose, 3)
    for k in range(3, 43):
        made.update(Observation(np.full(BEAMS, -np.inf), scene.scanner.angles(), 25.0, k / 15))
    assert [each.state for each in feed(made, scene, pose, 3, 43)][-1] == "tracking"


@pytest.mark.parametrize("world", ["corridor", "maze", "office"])
def test_shipped_fields(world):
    """Finds 10 of 10 poses to a few millimetres; nothing was tuned on these poses and this noise."""
    scene = Scene.of(load_world(world), 622, 4242)
    scanner = scene.scanner
    made = prepare_factory(EstimatorOptions(world))(
        ScannerGeometry(scanner.angles(), np.array(scanner.mount), scanner.range_max)
    )
    errors = []
    for pose in scene.poses(10):
        made.restart()
        errors.append(off(feed(made, scene, pose, 1)[0], pose))
    position = np.hypot(*np.array(errors)[:, :2].T)
    assert position.max() < 0.02
    assert np.median(position) < 0.003
    assert np.rad2deg(np.median(np.abs(np.array(errors)[:, 2]))) < 0.06


def odd_scan(kind, clean, rng):
    """A scan of one of `KINDS`; only an ordinary one is possible in the world."""
    count = len(clean)
    return {
        "ordinary": clean,
        "no return": np.full(count, np.inf),
        "says nothing": np.full(count, -np.inf),
        "random": rng.uniform(0.05, 25, count),
        "a ring": np.full(count, rng.uniform(0.1, 3)),
        "scaled": clean * rng.uniform(0.2, 1.5),
        "blocked": clean * np.where(rng.random(count) < 0.7, rng.uniform(0.05, 1, count), 1),
    }[kind]


KINDS = ("ordinary", "no return", "says nothing", "random", "a ring", "scaled", "blocked")


@pytest.fixture(scope="module")
def hall_estimator():
    """An estimator with few beams in HALL."""
    made, scene = estimator(HALL, 60)
    made.bounds = scene.world.bounds
    return made, scene


@given(st.lists(st.sampled_from(KINDS), min_size=5, max_size=12), st.integers(0, 1000), st.sampled_from([1 / 15, 1.0]))
@example(["random"] * 20, 25, 1.0)
@settings(max_examples=5, deadline=None)
def test_belief_stays_in_the_map(hall_estimator, kinds, seed, period):
    """Also checks that a hypothesis moves at most 20 steps of a descent, 10 m, beyond what motion allows."""
    made, scene = hall_estimator
    rng = np.random.default_rng(seed)
    pose = np.array([rng.uniform(5, 55), rng.uniform(0.5, 1.5), rng.uniform(-3, 3)])
    made.restart(pose, np.diag([1e-4] * 3))
    clean = scene.clean(pose[None])[0]
    for k, kind in enumerate(["ordinary", *kinds]):
        before = np.array([hypothesis.pose[:2] for hypothesis in made.hypotheses])
        ranges = odd_scan(kind, clean, rng)
        observation = Observation(ranges, scene.scanner.angles(), 25.0, k * period)
        posterior = made.track(observation)
        searched = posterior is None
        posterior = posterior or made.search()
        for each in posterior.hypotheses:
            assert np.isfinite(each.pose).all()
            assert np.isfinite(each.covariance).all()
            assert 0 <= each.pose[0] <= 60
            assert 0 <= each.pose[1] <= 2
            assert np.diag(each.covariance)[:2].max() < 2 * 60**2
        if not searched:
            for hypothesis in made.hypotheses:
                moved = np.abs(hypothesis.pose[:2] - before).max(axis=1).min()
                assert moved <= 20 * 0.5 + 3 * made.settings.motion.speed * period


def test_lost_along_a_corridor():
    """A few beams that happen to fit are no feature: what was lost along a plain corridor stays lost."""
    world = World(name="plain", boundary=[(0, 0), (35, 0), (35, 2), (0, 2)])
    made, scene = estimator(world, 622)
    scene = Scene(world, scene.scanner.model_copy(update={"range_max": 8.0}), scene.rng)
    count = 90
    path = np.column_stack([32 - 0.0635 * np.arange(count), np.full(count, 1.0), np.linspace(2.4, 6.0, count)])
    made.restart(path[0], np.diag([0.05**2] * 3))
    states = []
    for k, (pose, clean) in enumerate(zip(path, scene.clean(path), strict=True)):
        posterior = made.update(scene.observe(clean, k / 15))
        states.append(posterior.state)
        error = np.hypot(*off(posterior, pose)[:2])
        assert error < 0.2 or posterior.state != "tracking"
        assert error < 3.5 * np.sqrt(np.linalg.eigvalsh(posterior.covariance[:2, :2])[-1])
    assert states[0] == "tracking"
    assert states[-1] != "tracking"


def test_alternatives_along_a_corridor():
    """Lost along a corridor, and turning, the robot comes to one of several equal pillars: each of them is possible."""
    pillars = [{"box": {"center": (x, 0.2), "size": (0.4, 0.4)}} for x in np.arange(4.5, 60, 3.0)]
    made, scene = estimator(World(name="pillars", boundary=HALL.boundary, obstacles=pillars), range_max=1.5)
    turn = np.array([0.0, 0.0, 0.02])
    here, other = np.array([[21.5, 1.0, 0.0], [24.5, 1.0, 0.0]])
    made.restart(here, np.diag([1e-4] * 3))
    feed(made, scene, here, 1)
    before = replace(made.hypotheses[0], noise_covariance=np.diag([4.0, 1e-6, 1e-6]))
    made.hypotheses = [before]
    view = made._scan_likelihood(scene.observe(scene.clean((here + turn)[None])[0], 1 / 15))
    motions = made._predict_motion(before, 1 / 15, None, None)  # standing still is expected
    match = made._match_map(view, [motions], 1 / 15, with_odometry=False)
    evidence = deepcopy(match.evidence)
    best, motion = made._fuse(0, match, motions, scene.observe(scene.clean((here + turn)[None])[0], 1 / 15))
    for name, values in vars(evidence).items():
        assert np.array_equal(getattr(match.evidence, name), values)  # the match still states what the scan shows
    assert np.abs(best.pose - here - turn).max() < 0.01
    assert not made._find_alternatives(view, before, motion, motions)  # the match did not make the pose more certain
    found = made._find_alternatives(view, best, motion, motions)
    assert min(np.abs(each.pose - other - turn).max() for each in found) < 0.01


COUNT_COMPILED = """
import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.shared.interface import Observation

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith("services.")]
    loops = {d for m in modules for d in vars(m).values() if isinstance(d, Dispatcher)}
    return {f"{d.__name__}{signature}" for d in loops for signature in d.signatures}

angles = np.linspace(-np.pi, np.pi, 90)
for model in ("learned", "exact"):
    make = prepare_factory(EstimatorOptions(model=model))
    before = compiled()
    assert before
    made = make(ScannerGeometry(angles, np.zeros(3), 25.0))
    rng = np.random.default_rng(0)
    for k in range(40):
        pose = np.array([3 + 0.05 * k, 1.5, 0.0] if k < 30 else [12.0, 1.5, 1.0])
        ranges = made.predict(pose[None], angles).ranges[0] + rng.normal(0, 0.02, 90)
        ranges[20:30] = 1.0 if k > 10 else np.inf
        odom, time_increment = pose if k > 20 else None, 5e-4 if k > 15 else 0.0
        made.update(Observation(ranges, angles, 25.0, k / 15, odom, time_increment=time_increment))
    assert compiled() == before, compiled() - before
"""


def test_no_scan_waits_for_compilation():
    subprocess.run([sys.executable, "-c", COUNT_COMPILED], check=True, timeout=WAIT_TIMEOUT_S)


def test_a_search_does_not_forget_the_velocity():
    """The robot goes on turning, so a hypothesis that the search found expects the same."""
    made, scene = estimator(load_world("maze"))
    poses = np.array([[1.5, 3.0, yaw] for yaw in np.arange(20) / 15])
    for k, clean in enumerate(scene.clean(poses)):
        made.update(scene.observe(clean, k / 15))
    found = made._search_everywhere([made._scan[0]])
    made.hypotheses = [replace(made.hypotheses[0], log_evidence=-1e3)]  # so that those that were found are better
    made._add_hypotheses(found, made._scan[0])
    assert made.hypotheses[0].velocity == pytest.approx([0, 0, 1], abs=0.2)
