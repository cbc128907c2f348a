"""The estimator service without a bus: its reactions to scans, goals, odometry and requests."""

from __future__ import annotations

import numpy as np
import pytest
from structlog.testing import capture_logs

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Goal, Odom, Pose, Prediction, Scan, Twist
from common.messages.requests import LocaliseRequest
from common.messages.topics import CMD_VEL, GOAL, LOCALISE, ODOM, SCAN
from common.robot.scanner import SCANNERS
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.service import EstimatorService, estimator_options
from services.estimator.settings import EstimatorSettings

SCANNER = SCANNERS["tim571"].with_beams(622)
WORLD = load_world("corridor")
TRUTH = np.array([5.0, 1.5, 2.0])


class StoringService(EstimatorService):
    """Stores messages instead of publishing them."""

    def __init__(self, settings):
        super().__init__(settings)
        self.sent = []

    def publish(self, topic, message):
        self.sent.append(message)


def opened(**settings):
    made = StoringService(EstimatorSettings(**settings))
    made.open()
    return made


@pytest.fixture
def paper():
    return opened(estimator="paper")


@pytest.fixture(scope="module")
def opened_precise():
    return opened()


@pytest.fixture
def precise(opened_precise):
    made = StoringService(EstimatorSettings())
    made.models = opened_precise.models
    return made


def exact(pose, scanner=SCANNER, mount=SCANNER.mount):
    return WORLD.ray_distances(se2.compose(pose, mount)[None], scanner.angles())[0]


def a_scan(stamp, pose=None, **changes) -> Scan:
    values = {
        "stamp_ns": stamp, "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment,
        "range_min": 0.05, "range_max": 25.0, "ranges": np.full(622, 2.0) if pose is None else exact(pose),
        "mount": Pose.of(SCANNER.mount),
    }  # fmt: skip
    return Scan(**{**values, **changes})


def test_settings_of_another_preset_are_reported(opened_precise):
    service = StoringService(EstimatorSettings(alpha=0.02, iterations=1, sigma=0.1))
    service.models = opened_precise.models
    with capture_logs() as lines:
        service.open()
    warnings = [line["event"] for line in lines if line["log_level"] == "warning"]
    assert warnings == [f"{name} applies only to preset paper; ignored" for name in ("alpha", "iterations")]


def test_belief_and_prediction(precise):
    precise.on_message(SCAN, a_scan(7, TRUTH))
    prediction, belief = precise.sent
    assert isinstance(prediction, Prediction)
    assert isinstance(belief, Belief)
    assert belief.stamp_ns == prediction.stamp_ns == 7
    assert (belief.estimator, belief.state) == ("precise", "tracking")
    assert np.abs(belief.pose.array() - TRUTH).max() < 0.005
    assert np.abs(prediction.ranges - exact(TRUTH))[prediction.sigma < 0.03].mean() < 0.005
    assert len(prediction.sigma) == 622
    assert belief.probability > 0.999
    assert np.linalg.eigvalsh(belief.covariance).min() > 0
    assert belief.hypotheses[0].pose == belief.pose
    assert sum(h.weight for h in belief.hypotheses) == pytest.approx(1)
    assert belief.free_energy == pytest.approx(belief.accuracy + belief.complexity)


def test_paper_belief(paper):
    paper.on_message(SCAN, a_scan(7))
    belief = paper.sent[-1]
    assert belief.estimator == "paper"
    assert belief.covariance is belief.hypotheses[0].covariance is belief.probability is belief.protection is None
    assert belief.pose.yaw == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("estimator", ["particle-filter", "amcl-defaults"])
def test_particle_filter_belief(estimator):
    service = opened(estimator=estimator, initial_pose="5,1.5,114.6")
    for stamp in range(5):
        service.on_message(SCAN, a_scan(stamp, TRUTH))
    belief = service.sent[-1]
    assert belief.estimator == estimator
    assert np.hypot(belief.pose.x - 5, belief.pose.y - 1.5) < 0.3


def test_repeated_scan(paper):
    for _ in range(2):
        paper.on_message(SCAN, a_scan(7))
    assert paper.sent[:2] == paper.sent[2:]
    paper.on_message(SCAN, a_scan(8))
    assert paper.sent[-1].pose != paper.sent[1].pose


@pytest.mark.parametrize("name", ["paper", "precise"])
def test_beams_without_range(name, request):
    service, ranges = request.getfixturevalue(name), exact(TRUTH)
    ranges[:50], ranges[50:60] = np.inf, -np.inf
    service.on_message(SCAN, a_scan(1, ranges=ranges))
    assert np.isfinite(service.sent[-1].free_energy)


@pytest.mark.parametrize(
    ("beams", "mount", "same"),
    [(621, SCANNER.mount, True), (90, (0.0, 0.1, 0.3), False)],  # the number varies with the motor; another scanner
)
def test_changed_scanner(precise, beams, mount, same):
    precise.on_message(SCAN, a_scan(1, TRUTH))
    before, other = precise.estimator, SCANNERS["tim571"].with_beams(beams)
    changes = {"angle_increment": other.angle_increment, "mount": Pose.of(mount)}
    precise.on_message(SCAN, a_scan(2, ranges=exact(TRUTH, other, mount), **changes))
    assert (precise.estimator is before) == same
    assert np.abs(precise.sent[-1].pose.array() - TRUTH).max() < 0.02


@pytest.mark.parametrize(
    "changes",
    [{"ranges": np.full(100, 2.0)}, {"angle_min": -1.0}, {"angle_increment": 0.001}, {"mount": Pose(x=0.0, y=0.1)}],
)
def test_scan_unfit_for_paper(paper, changes):
    paper.on_message(SCAN, a_scan(1, **changes))
    assert paper.sent == []
    assert "presage train --world corridor --preset paper" in paper.note
    paper.on_message(SCAN, a_scan(2))
    assert len(paper.sent) == 2
    assert paper.note == ""


def test_localise_request(paper):
    assert not paper.on_request(LOCALISE, LocaliseRequest()).ok  # there is no estimator to restart yet
    paper.on_message(SCAN, a_scan(1))
    for pose, expected in ((Pose(x=4.0, y=1.0), [4.0, 1.0]), (None, [9.0, 2.25])):
        assert paper.on_request(LOCALISE, LocaliseRequest(pose=pose)).ok
        assert paper.estimator.estimator.pose[:2].tolist() == expected
    with pytest.raises(UserError, match=r"\(400, 1\) is off the map: corridor goes from"):
        paper.on_request(LOCALISE, LocaliseRequest(pose=Pose(x=400.0, y=1.0)))
    assert paper.estimator.estimator.pose[:2].tolist() == [9.0, 2.25]


def test_goal_cancelled(paper):
    for cancel in (False, True):
        paper.on_message(GOAL, Goal(stamp_ns=0, pose=Pose(x=1.0, y=1.0), cancel=cancel))
        assert (paper.goal is None) == cancel


def an_odom(stamp) -> Odom:
    return Odom(stamp_ns=stamp, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=np.eye(3))


def test_scan_waits_for_odometry(precise):
    precise.settings = EstimatorSettings(prior="odometry")
    precise.on_message(ODOM, an_odom(1))
    precise.on_message(SCAN, a_scan(1, TRUTH))
    assert len(precise.sent) == 2
    precise.on_message(SCAN, a_scan(2, TRUTH))
    assert len(precise.sent) == 2
    precise.on_message(ODOM, an_odom(2))
    assert [m.stamp_ns for m in precise.sent] == [1, 1, 2, 2]
    precise.on_message(SCAN, a_scan(3, TRUTH))  # its odometry never comes, so
    precise.on_message(SCAN, a_scan(4, TRUTH))  # it is processed when the next scan comes
    assert precise.sent[-1].stamp_ns == 3
    assert precise.counters["scans_without_odometry"] == 1


def test_command_as_prior(precise):
    precise.on_message(CMD_VEL, CmdVel(stamp_ns=1, twist=Twist(vx=0.5)))
    assert precise._observation(a_scan(2), None).command is None
    precise.settings = EstimatorSettings(prior="command")
    assert precise._observation(a_scan(2), None).command.tolist() == [0.5, 0, 0]
    assert precise._observation(a_scan(501_000_000), None).command is None  # the robot has stopped by then
    assert precise._observation(a_scan(0), None).command is None  # stamps have begun again


@pytest.mark.parametrize("estimator", ["precise", "paper"])
def test_other_world_of_same_name(tmp_path, estimator):
    if estimator == "paper":
        pytest.importorskip("torch")
    file = tmp_path / "mine.yaml"
    file.write_text("name: corridor\nboundary: [[0, 0], [14, 0], [14, 4.5], [0, 4.5]]\n")
    with pytest.raises(UserError, match="another world of the same name 'corridor'"):
        opened(world=str(file), estimator=estimator)


def test_limits_of_the_robot():
    """A faster robot is expected to move faster, a slower one may still be pushed."""
    fast, slow = (EstimatorSettings(max_speed=speed, max_turn=2 * speed) for speed in (3.0, 0.3))
    assert (estimator_options(fast).motion.speed, estimator_options(fast).motion.turn) == (3.0, 6.0)
    assert estimator_options(slow).motion == MotionNoise()


def test_missing_model(tmp_path):
    with pytest.raises(UserError, match=f"presage train --world maze --preset precise --out {tmp_path}"):
        opened(world="maze", models=tmp_path)
    with pytest.raises(UserError, match="give learned, exact, or a file"):
        opened(model="best")


def test_exact_model():
    service = opened(model="exact")
    service.on_message(SCAN, a_scan(1, TRUTH))
    assert np.abs(service.sent[-1].pose.array() - TRUTH).max() < 1e-3
