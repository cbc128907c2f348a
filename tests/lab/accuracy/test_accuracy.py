"""Parts of the accuracy benchmark: drivable paths, the Cramér-Rao bound, the tasks and the report."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.robot.robot import Robot
from lab.accuracy import bound, tasks
from lab.accuracy.report import _markdown, bench_accuracy, cell, scanners_of
from lab.accuracy.runner import AccuracyJob, _row
from lab.accuracy.scenes import TWINS, Scene, alike, twin_of, twin_path
from services.estimator.shared.interface import Hypothesis, Posterior
from services.simulator.odometry import OdometryNoise

CONSOLE = Console(quiet=True)


@pytest.mark.parametrize("world", ["office", "maze"])
def test_paths_within_limits(world):
    scene = Scene.of(load_world(world), 60, 0)
    path = scene.path(60)
    assert len(path) == 900
    step = np.diff(path, axis=0)
    speed = np.hypot(step[:, 0], step[:, 1]) * scene.scanner.rate
    assert speed.max() < 1.0 + 1e-6
    assert speed.mean() > 0.2
    assert np.abs(se2.wrap(step[:, 2])).max() * scene.scanner.rate < 1.0 + 1e-6
    assert scene.world.clearance(path[:, :2]).min() > Robot().radius - 1e-6


def test_bound_by_finite_differences():
    scene = Scene.of(load_world("maze"), 200, 0)
    pose, step = scene.poses(1)[0], 1e-5
    columns = []
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        ahead, back = scene.clean(np.array([pose + offset, pose - offset]))
        columns.append((ahead - back) / (2 * step))
    J = np.array(columns).T
    J = J[np.abs(J).max(axis=1) < 50]  # leave out beams that jump to another object within the step
    by_hand = J.T @ J / scene.scanner.sigma**2
    assert bound.information(scene, pose[None])[0] == pytest.approx(by_hand, rel=0.05, abs=0.02 * by_hand.max())


def test_bound_along_a_path():
    scene = Scene.of(load_world("maze"), 200, 0)
    path = scene.path(3)
    alone, along = bound.single(scene, path), bound.recursive(scene, path, OdometryNoise())
    assert (bound.position(along) <= bound.position(alone) + 1e-12).all()
    still = np.tile(path[:1], (20, 1))
    last = bound.recursive(scene, still, OdometryNoise(0, 0, 0, 0))[-1]
    assert last == pytest.approx(bound.single(scene, path[:1])[0] / 20, rel=1e-3)


def test_bound_with_a_prior():
    scene = Scene.of(load_world("maze"), 200, 0)
    path = scene.path(2)
    one = bound.single(scene, path)
    start = np.diag([1e-3, 1e-3, 1e-3]) ** 2
    first = bound.recursive(scene, path, OdometryNoise(), start)[0]
    assert np.linalg.inv(first) == pytest.approx(np.linalg.inv(one[0]) + np.linalg.inv(start), rel=1e-6)
    known = bound.heading_known(one)
    assert (bound.position(known) <= bound.position(one)).all()
    assert known[0, :2, :2] == pytest.approx(np.linalg.inv(bound.information(scene, path[:1])[0, :2, :2]), rel=1e-6)


def test_median_of_the_bound():
    assert bound.median_error(np.tile(np.diag([1.0, 1.0, 1.0]), (3, 1, 1))) == pytest.approx(
        np.sqrt(np.log(4)), rel=0.03
    )


def test_blocked_ranges():
    scene = Scene.of(load_world("office"), 622, 0)
    for clean in scene.clean(scene.poses(10)):
        blocked = scene.blocked(clean, 0.3)
        assert (blocked <= clean).all()
        assert (blocked < clean).mean() >= 0.3


def test_unknown_furniture():
    scene = Scene.of(load_world("office"), 622, 0)
    for pose in scene.poses(5):
        seen, clean = scene.furnished(pose, 0.3), scene.clean(pose[None])[0]
        assert ((seen <= clean) | np.isinf(seen)).all()
        assert (seen != clean).mean() >= 0.3


def test_twin_path():
    scene = Scene.of(TWINS, 200, 1)
    path, same = twin_path(scene)
    assert 5 <= same < len(path)
    assert alike(scene, path)[:same].all()
    assert not alike(scene, path)[-1]
    assert twin_of(twin_of(path)) == pytest.approx(path)
    assert abs(twin_of(path) - path) == pytest.approx(np.tile([6.1, 0, 0], (len(path), 1)))
    assert TWINS.clearance(path[:, :2]).min() > Robot().radius


class ScriptedEstimator:
    """An estimator whose state and poses are a function of the number of scans and the true poses."""

    def __init__(self, paths, believe):
        self.paths, self.believe, self.trial = iter(paths), believe, 0

    def restart(self):
        self.path, self.scans = next(self.paths), 0

    def update(self, observation):
        pose = self.path[self.scans]
        self.scans += 1
        state, poses = self.believe(self.scans, pose, twin_of(pose))
        hypotheses = tuple(Hypothesis(np.array(each), np.eye(3), 1 / len(poses)) for each in poses)
        return Posterior(state, hypotheses, 0.0, 0.0, np.zeros(3), np.eye(3), np.zeros(1))


def nothing_at_first(scans, pose, twin):
    return ("ambiguous", [pose, twin]) if scans >= 20 else ("localising", [np.array([3.0, 5.0, 0.0])])


def nothing_until_later(scans, pose, twin):
    return ("ambiguous", [pose, twin]) if scans >= 21 else ("localising", [pose])


def the_true_room_alone(scans, pose, twin):
    return "tracking", [pose]


def the_other_room_alone(scans, pose, twin):
    return "tracking", [twin]


def another_heading_in_the_twin(scans, pose, twin):
    return "ambiguous", [pose, twin + np.array([0, 0, np.deg2rad(6)])]


@pytest.mark.parametrize(
    ("believe", "kept", "wrong"),
    [
        (nothing_at_first, 2, 0),
        (nothing_until_later, 0, 0),
        (the_true_room_alone, 0, 0),
        (the_other_room_alone, 0, 2),
        (another_heading_in_the_twin, 0, 0),
    ],
)
def test_both_rooms_kept(believe, kept, wrong):
    paths = [twin_path(scene)[0] for scene in [Scene.of(TWINS, 60, 4)] for _ in range(2)]
    scene = Scene.of(TWINS, 60, 4)
    scene.observe = lambda clean, stamp: None  # the noise would change the paths drawn after it
    found = tasks.twins(ScriptedEstimator(paths, believe), scene, 2)["two rooms alike: both kept"]
    assert (found.found, found.total, found.wrong) == (kept, 2, wrong)


def test_short_table(capsys):
    outcome = tasks.TaskOutcome(
        found=1, total=3, wrong=2, errors=[np.array([0.003, 0.004, 0.0])], groups=[0], nees=[2.5]
    )
    nothing = tasks.TaskOutcome(total=3, wrong=1)
    tim = scanners_of("tim571")[0]
    job = AccuracyJob("precise", "office", tim, 3, 1.0, 0)
    rows = [_row(job, "office", task, each) for task, each in (("kidnapped", outcome), ("blocked", nothing))]
    table = _markdown(rows, "office")
    assert "| kidnapped | precise | 1/3 (6 to 79 %) | 2 | 5.00 | 5.00 | 2.50 |  |" in table
    assert "| blocked | precise | 0/3 (0 to 56 %) | 1 |  |  |  |  |" in table
    assert cell(rows[0]) == "5.00/5.00 mm; 1/3, 2 wrong"
    assert rows[0]["found_share_95"] == pytest.approx([0.061, 0.792], abs=1e-3)


def test_scans_of_a_path_have_no_confidence_interval():
    tim = scanners_of("tim571")[0]
    along = tasks.TaskOutcome(found=9, total=9, independent=False)
    assert _row(AccuracyJob("precise", "office", tim, 3, 1.0, 0), "office", "tracking", along)["found_share_95"] is None


def test_rows_and_files(tmp_path):
    file, figure, scanner = tmp_path / "a.json", tmp_path / "a.png", tmp_path / "few-beams.yaml"
    scanner.write_text("{name: few-beams, beams: 200, fov_deg: 270, rate: 15, range_max: 25, sigma: 0.02}")
    options = ("maze", "precise-exact", "standing,odometry", 2, 0.05, 5, 2, 1)
    bench_accuracy(*options, file, figure, CONSOLE, scanner=str(scanner))
    data = json.loads(file.read_text())
    rows = {row["task"]: row for row in data["rows"]}
    assert set(rows) == {"from nothing, 1 scan", "standing, 20 scans", "tracking, odometry"}
    assert rows["tracking, odometry"]["of"] == 90
    assert rows["standing, 20 scans"]["of"] == 4
    low, high = rows["standing, 20 scans"]["position_error_rms_95_m"]
    assert low <= rows["standing, 20 scans"]["position_error_rms_m"] <= high
    assert 0 < rows["tracking, odometry"]["position_error_rms_m"] < 0.02
    assert rows["standing, 20 scans"]["bound_rms_m"] == pytest.approx(
        rows["from nothing, 1 scan"]["bound_rms_m"] / np.sqrt(20)
    )
    assert {"seed", "commit", "arguments"} <= set(data)
    assert figure.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("nowhere", "precise", ""), "no world"),
        (("office", "best", ""), "no estimator"),
        (("office", "precise", "running"), "no task"),
    ],
)
def test_unknown_options(words, why):
    with pytest.raises(UserError, match=why):
        bench_accuracy(*words, 2, 0.1, 0, 1, 1, None, None, CONSOLE)


def test_scanners():
    named = [(one.name, one.beams) for one in scanners_of("tim571,lms200")]
    assert named == [("tim571", 622), ("lms200", 181)]
    with pytest.raises(UserError, match="no scanner 'sonar'"):
        scanners_of("sonar")
