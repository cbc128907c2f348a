"""The Python API: the code of its page, what it refuses, and a service of one's own."""

from __future__ import annotations

import inspect
import re
import runpy
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import presage
from common.geometry import se2
from common.messages.definitions import Belief, Odom, Pose, Scan, Twist
from common.messages.topics import ODOM, SCAN
from presage.replay.in_process import InProcessServices
from services.recorder.files.writer import RecordingWriter
from tests.conftest import ROOT

SCANNER = presage.SCANNERS["tim571"].with_beams(200)
POSE = np.array([4.0, 1.5, 1.0])


@pytest.fixture(scope="module")
def world():
    return presage.load_world("corridor")


@pytest.fixture(scope="module")
def ranges(world):
    return SCANNER.add_noise(
        world.ray_distances(se2.compose(POSE, np.array(SCANNER.mount))[None], SCANNER.angles())[0],
        np.random.default_rng(0),
    )


@pytest.fixture(scope="module")
def estimator(world):
    return presage.Estimator(world, scanner=SCANNER)


def scan_message(ranges, stamp_ns=0):
    return Scan(
        stamp_ns=stamp_ns,
        angle_min=SCANNER.angle_min,
        angle_increment=SCANNER.angle_increment,
        range_min=0.05,
        range_max=25.0,
        ranges=ranges,
        mount=Pose.of(SCANNER.mount),
    )


@pytest.mark.parametrize("page", ["docs/api.md", "README.md"])
def test_examples_of_a_page(page, ranges, tmp_path, monkeypatch):
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)
    writer = RecordingWriter(tmp_path / "run.mcap")
    for k in range(3):
        message = scan_message(ranges, k * 10**8)
        writer.write(SCAN, SCAN.key("robot"), message.encode(), message.stamp_ns, message.stamp_ns)
    writer.finish()
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
        np.testing.assert_allclose(names["belief"].pose, POSE, atol=0.02)
    if optimiser := names.get("MoreSteps"):
        arguments = [list(inspect.signature(each.descend).parameters) for each in (optimiser, presage.Optimiser)]
        assert arguments[0] == arguments[1]


def test_import_is_light():
    heavy = ["numpy", "numba", "torch", "zenoh", "pydantic", "matplotlib", "pybullet"]
    program = f"import sys, presage; print(sorted(set({heavy}) & set(sys.modules)), set(presage.__all__) <= set(dir()))"
    program = program.replace("dir()", "dir(presage)")
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "[] True"


def test_all_names_exist():
    assert all(getattr(presage, name) for name in presage.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        presage.nothing  # noqa: B018


def test_plain_ranges_are_a_scan(estimator, world, ranges):
    estimator.restart()
    belief = estimator.update(ranges, stamp=0.0)
    scan = presage.LaserScan(ranges, SCANNER.angles(), 25.0, 0.0, mount=SCANNER.mount, sigma=SCANNER.sigma)
    other = presage.Estimator(world).update(scan)
    assert belief.state == "tracking"
    assert (belief.pose.tobytes(), belief.free_energy) == (other.pose.tobytes(), other.free_energy)


def test_unknown_odometry(world, ranges):
    """NaN means that the odometry of a scan is unknown, as in a log."""
    estimator = presage.Estimator(world, scanner=SCANNER)
    beliefs = [estimator.update(ranges, stamp=k / 15, odom=(np.nan if k in {0, 3} else 0.0, 0, 0)) for k in range(6)]
    assert beliefs[-1].state == "tracking"
    np.testing.assert_allclose(beliefs[-1].pose, POSE, atol=0.02)
    scan = presage.LaserScan(ranges, SCANNER.angles(), 25.0, odom=(0, 0, np.nan), reference=(np.nan, 0, 0))
    assert scan.odom is scan.reference is None


def test_prediction_shapes(estimator, ranges):
    one, two = estimator.predict(POSE), estimator.predict([POSE, POSE], angles=[0.0, 0.1, 0.2])
    assert (one.ranges.shape, one.sigma.shape, two.ranges.shape) == ((200,), (200,), (2, 3))
    assert np.median(np.abs(one.ranges - ranges)) < 0.05


def test_mount_argument_replaces_the_scans(world, ranges):
    scan = presage.LaserScan(ranges, SCANNER.angles(), 25.0)  # the laser's own pose
    belief = presage.Estimator(world, mount=SCANNER.mount).update(scan)
    np.testing.assert_allclose(belief.pose, POSE, atol=0.02)
    with pytest.raises(presage.UserError, match=r"mount: give x, y in m and yaw in rad, not an array of shape \(2,\)"):
        presage.Estimator(world, mount=(0, 0))


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda e, r: presage.Estimator("corridor", scanner="sonar"), "no scanner 'sonar': give a Scanner, or one of"),
        (lambda e, r: presage.Estimator("nowhere"), "no world 'nowhere'"),
        (lambda e, r: presage.Estimator("corridor", "kalman"), "no estimator 'kalman'"),
        (lambda e, r: presage.Estimator("corridor", model="best"), "no model 'best'"),
        (lambda e, r: presage.Estimator("corridor", sigma=0), "sigma: give the noise of the scanner in m"),
        (lambda e, r: presage.Estimator("corridor", descent=presage.Descent()), "for preset paper only, not precise"),
        (
            lambda e, r: presage.Estimator("corridor", "particle-filter", optimiser=presage.GaussNewton()),
            "for preset precise only",
        ),
        (lambda e, r: presage.Estimator("corridor", initial_pose=(400, 0, 0)), "off the map"),
        (lambda e, r: presage.Estimator("corridor", initial_pose=(0,)), r"initial_pose: give x, y in m .*, not \(0,\)"),
        (
            lambda e, r: presage.Estimator("corridor", initial_pose="here"),
            "initial_pose: give x, y in m .*, not 'here'",
        ),
        (lambda e, r: presage.Estimator("corridor", likelihood=3), "likelihood: .* of presage.Likelihood, not 3"),
        (lambda e, r: presage.Estimator("corridor", model=3), "model: .* methods expect and expect_behind .*, not 3"),
        (lambda e, r: presage.Estimator("corridor", optimiser=3), "optimiser: .* the method descend, not 3"),
        (
            lambda e, r: presage.Estimator("corridor", likelihood=presage.Likelihood(), sigma=0.03),
            "give sigma or likelihood, not both",
        ),
        (lambda e, r: e.update(r[:50]), r"ranges of shape \(50,\), but scanner tim571 has 200 beams"),
        (lambda e, r: e.update(presage.LaserScan(r, SCANNER.angles(), 25.0)), "the scanner, its mount or its noise"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles()[1:], 25.0), "as many ranges as angles"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles(), 25.0, odom=(0, 0)), "odom of a scan has three numbers"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles(), 25.0, np.nan), "stamp of a scan: NaN and infinity"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles(), np.nan), "range_max of a scan: NaN and infinity"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles() * np.inf, 25.0), "angles of a scan: NaN and infinity"),
        (lambda e, r: presage.LaserScan(r, SCANNER.angles(), 25.0, mount=(0, 0, np.nan)), "mount of a scan: NaN"),
        (lambda e, r: presage.Estimator("corridor", mount=(0, np.nan, 0)), "mount: NaN and infinity"),
        (lambda e, r: presage.Estimator("corridor").update(r), "the directions of these ranges are not known"),
        (lambda e, r: presage.Estimator("corridor").predict(POSE), "which beams to predict is not known"),
        (lambda e, r: presage.Estimator("corridor").restart(), "nothing to restart"),
    ],
)
def test_refusals(estimator, ranges, call, why):
    with pytest.raises(presage.UserError, match=why):
        call(estimator, ranges)


class ChangedModel:
    """Exact rays, of which ``change`` returns something else."""

    def __init__(self, world, change, change_behind=lambda ranges: ranges):
        self.rays, self.change, self.change_behind = presage.RayCaster(world), change, change_behind

    def expect(self, lasers, angles):
        return self.change(self.rays.expect(lasers, angles))

    def expect_behind(self, lasers, angles, ranges):
        return self.change_behind(self.rays.expect_behind(lasers, angles, ranges))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        # Compiled loops would read beyond the end of this Jacobian.
        ((lambda e: replace(e, jacobian=e.jacobian[..., :2]),), r"jacobian \(N, B, 3\), not of shapes .*, \(2, 5, 2\)"),
        ((lambda e: replace(e, ranges=list(e.ranges)),), "not of shapes None"),
        ((lambda e: (e.ranges, e.scale, e.jacobian),), "expect must return presage.Expected, not tuple"),
        ((lambda e: e.part(slice(1)),), r"expect must return ranges \(N, B\), here \(2, 5\), not of shape \(1, 5\)"),
        ((lambda e: e, lambda ranges: ranges[0]), r"expect_behind must return ranges \(N, B\), here \(2, 5\)"),
        ((lambda e: replace(e, ranges=e.ranges * np.nan),), "expect returned NaN or negative ranges"),
        ((lambda e: replace(e, jacobian=e.jacobian * np.nan),), "its jacobian must be finite"),
    ],
)
def test_refused_models(world, changes, why):
    with pytest.raises(presage.UserError, match=why):
        presage.Estimator(world, model=ChangedModel(world, *changes))


class ChangedLikelihood(presage.Likelihood):
    """The default density, of which ``change`` returns something else."""

    change = staticmethod(lambda evidence: evidence)

    def evaluate(self, *arguments):
        return self.change(super().evaluate(*arguments))


class UncopiedLikelihood(presage.Likelihood):
    """A likelihood that cannot be copied."""

    def __init__(self, nu):
        super().__init__()
        object.__setattr__(self, "nu", nu)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda e: e.accuracy, "evaluate must return presage.Evidence, not ndarray"),
        (lambda e: replace(e, xi=e.xi[0]), r"return xi of shape \(2, 3\) for two poses, not \(3,\)"),
        (lambda e: replace(e, xi=e.xi * np.nan), "evaluate returned NaN or infinite xi"),
    ],
)
def test_refused_likelihoods(world, monkeypatch, change, why):
    monkeypatch.setattr(ChangedLikelihood, "change", staticmethod(change))
    with pytest.raises(presage.UserError, match=why):
        presage.Estimator(world, likelihood=ChangedLikelihood())
    with pytest.raises(presage.UserError, match=r"UncopiedLikelihood cannot be copied .* remove its __init__"):
        presage.Estimator(world, likelihood=UncopiedLikelihood(3.0))


def test_refused_optimiser(world, ranges):
    class Poses:
        def descend(self, scan, poses, prior, schedule):
            return poses

    with pytest.raises(presage.UserError, match=r"optimiser: Poses\.descend must return a tuple"):
        presage.Estimator(world, optimiser=Poses(), scanner=SCANNER).update(ranges)


def test_parameters_of_another_preset():
    with pytest.warns(UserWarning, match="^sigma applies only to preset precise; ignored$"):
        presage.Estimator("corridor", "particle-filter", sigma=0.1)
    with pytest.warns(UserWarning, match="^model applies only to preset precise; ignored$"):
        presage.Estimator("corridor", "amcl-defaults", model="exact")


def test_parameters_of_preset_paper(world):
    """They change how far the belief moves with each scan."""
    pose = np.array([4.0, 1.5, np.pi / 2])
    scanner = presage.SCANNERS["tim571"]
    scan = world.ray_distances(se2.compose(pose, np.array(scanner.mount))[None], scanner.angles())[0]
    start = (4.3, 1.5)
    moved = []
    for descent in (None, presage.Descent(alpha=1e-5, iterations=1)):
        estimator = presage.Estimator(world, "paper", scanner=scanner, initial_pose=start, descent=descent)
        moved.append(np.hypot(*(estimator.update(scan).pose[:2] - start)))
    assert moved[0] > 10 * moved[1] > 0
    assert estimator.fixed_heading == pytest.approx(np.pi / 2, abs=1e-6)


def test_example_policy(tmp_path):
    assert runpy.run_path(str(ROOT / "docs/examples/own_policy.py"))["drive"](tmp_path / "run.csv").state == "reached"
    rows = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    np.testing.assert_allclose(rows["free_energy_nats"], rows["accuracy_nats"] + rows["complexity_nats"])
    assert rows["error_m"].max() < 0.02


def test_example_estimator(ranges):
    example = runpy.run_path(str(ROOT / "docs/examples/my_estimator.py"))
    service = example["MyEstimator"](example["MySettings"](start="1,2,90"))
    services = InProcessServices([service], "robot")
    scan = scan_message(ranges, 5)
    assert services.send(SCAN, scan.encode()) == []
    for x in (7.0, 8.0):
        odom = Odom(stamp_ns=5, pose=Pose(x=x, y=0.0), twist=Twist(), covariance=np.eye(3))
        services.send(ODOM, odom.encode())
    (belief,) = services.send(SCAN, scan.encode())
    assert isinstance(belief, Belief)
    np.testing.assert_allclose(belief.pose.array(), [1, 3, np.pi / 2], atol=1e-12)
    assert belief.xi is belief.free_energy is belief.complexity is None
