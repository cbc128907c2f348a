"""The estimator service without a bus: its reactions to scans, goals, odometry and requests."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Goal, Odom, Pose, Prediction, Scan, Twist
from common.messages.requests import LocaliseRequest
from common.messages.topics import CMD_VEL, GOAL, LOCALISE, ODOM, SCAN
from common.robot.scanner import SCANNERS
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings

SCANNER = SCANNERS["tim571"].with_beams(622)
WORLD = load_world("corridor")
TRUTH = np.array([5.0, 1.5, 2.0])


class Heard(EstimatorService):
    """Stores messages instead of publishing them."""

    def __init__(self, settings):
        super().__init__(settings)
        self.sent = []

    def publish(self, topic, message):
        self.sent.append(message)


def opened(**settings):
    made = Heard(EstimatorSettings(**settings))
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
    made = Heard(EstimatorSettings())
    made.models = opened_precise.models
    return made


def a_scan(stamp, pose=None, **changes) -> Scan:
    ranges = np.full(622, 2.0)
    if pose is not None:
        laser = se2.compose(pose, SCANNER.mount)
        ranges = WORLD.ray_distances(laser[None], SCANNER.angles())[0]
    values = {
        "stamp_ns": stamp, "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment,
        "range_min": 0.05, "range_max": 25.0, "ranges": ranges, "mount": Pose.of(SCANNER.mount),
    }  # fmt: skip
    return Scan(**{**values, **changes})


def test_each_scan_gets_a_prediction_and_a_belief_of_its_stamp(precise):
    precise.on_message(SCAN, a_scan(7, TRUTH))
    prediction, belief = precise.sent
    assert isinstance(prediction, Prediction)
    assert isinstance(belief, Belief)
    assert belief.stamp_ns == prediction.stamp_ns == 7
    assert belief.estimator == "precise"
    assert belief.state == "tracking"
    assert np.abs(belief.pose.array() - TRUTH).max() < 0.005
    assert np.abs(prediction.ranges - a_scan(7, TRUTH).ranges)[prediction.sigma < 0.03].mean() < 0.005
    assert len(prediction.sigma) == 622
    assert np.linalg.eigvalsh(belief.covariance).min() > 0
    assert belief.hypotheses[0].pose == belief.pose
    assert sum(h.weight for h in belief.hypotheses) == pytest.approx(1)
    assert belief.free_energy == pytest.approx(belief.accuracy + belief.complexity)


def test_the_paper_has_one_heading_and_no_covariance(paper):
    paper.on_message(SCAN, a_scan(7))
    belief = paper.sent[-1]
    assert belief.estimator == "paper"
    assert belief.covariance is None
    assert belief.hypotheses[0].covariance is None
    assert belief.pose.yaw == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("estimator", ["particle-filter", "amcl-defaults"])
def test_the_particle_filter_answers_on_the_same_topics(estimator):
    service = opened(estimator=estimator, initial_pose="5,1.5,114.6")
    for stamp in range(5):
        service.on_message(SCAN, a_scan(stamp, TRUTH))
    belief = service.sent[-1]
    assert belief.estimator == estimator
    assert np.hypot(belief.pose.x - 5, belief.pose.y - 1.5) < 0.3


def test_a_scan_sent_again_is_answered_again_but_not_used_again(paper):
    paper.on_message(SCAN, a_scan(7))
    paper.on_message(SCAN, a_scan(7))
    assert paper.sent[:2] == paper.sent[2:]
    paper.on_message(SCAN, a_scan(8))
    assert paper.sent[-1].pose != paper.sent[1].pose


@pytest.mark.parametrize("name", ["paper", "precise"])
def test_no_return_and_too_close_are_used(name, request):
    service = request.getfixturevalue(name)
    scan = a_scan(1, TRUTH)
    ranges = scan.ranges.copy()
    ranges[:50], ranges[50:60] = np.inf, -np.inf
    service.on_message(SCAN, a_scan(1, ranges=ranges))
    assert np.isfinite(service.sent[-1].free_energy)


def test_precise_takes_any_scanner(precise):
    other = SCANNERS["tim571"].with_beams(90)
    laser = se2.compose(TRUTH, [0.0, 0.1, 0.3])
    ranges = WORLD.ray_distances(laser[None], other.angles())[0]
    precise.on_message(SCAN, a_scan(1, TRUTH))
    precise.on_message(
        SCAN,
        a_scan(2, ranges=ranges, angle_increment=other.angle_increment, mount=Pose(x=0.0, y=0.1, yaw=0.3)),
    )
    assert np.abs(precise.sent[-1].pose.array() - TRUTH).max() < 0.02


def test_beams_may_come_and_go(precise):
    """A scanner whose number of beams varies with its motor: 622 beams, then 621, over the same view."""
    precise.on_message(SCAN, a_scan(1, TRUTH))
    made = precise.estimator
    other = SCANNERS["tim571"].with_beams(621)
    laser = se2.compose(TRUTH, SCANNER.mount)
    ranges = WORLD.ray_distances(laser[None], other.angles())[0]
    precise.on_message(SCAN, a_scan(2, ranges=ranges, angle_increment=other.angle_increment))
    assert precise.estimator is made
    assert precise.sent[-1].state == "tracking"
    assert np.abs(precise.sent[-1].pose.array() - TRUTH).max() < 0.02


@pytest.mark.parametrize(
    "changes",
    [
        {"ranges": np.full(100, 2.0)},
        {"angle_min": -1.0},
        {"angle_increment": 0.001},
        {"mount": Pose(x=0.0, y=0.1)},
    ],
)
def test_a_scan_the_paper_was_not_trained_for_is_refused_with_the_command_that_helps(paper, changes):
    paper.on_message(SCAN, a_scan(1, **changes))
    assert paper.sent == []
    assert "presage train --world corridor --preset paper" in paper.note
    paper.on_message(SCAN, a_scan(2))  # the service continues
    assert len(paper.sent) == 2
    assert paper.note == ""


def test_localise_anew(paper):
    assert not paper.on_request(LOCALISE, LocaliseRequest()).ok  # there is no estimator to restart yet
    paper.on_message(SCAN, a_scan(1))
    assert paper.on_request(LOCALISE, LocaliseRequest(pose=Pose(x=4.0, y=1.0))).ok
    assert paper.estimator.estimator.pose[:2].tolist() == [4.0, 1.0]
    assert paper.on_request(LOCALISE, LocaliseRequest()).ok
    assert paper.estimator.estimator.pose[:2].tolist() == [9.0, 2.25]


def test_goals_are_remembered_and_cancelled(paper):
    paper.on_message(GOAL, Goal(stamp_ns=0, pose=Pose(x=1.0, y=1.0)))
    assert paper.goal is not None
    paper.on_message(GOAL, Goal(stamp_ns=0, pose=Pose(x=1.0, y=1.0), cancel=True))
    assert paper.goal is None


def an_odom(stamp) -> Odom:
    return Odom(stamp_ns=stamp, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=np.eye(3))


def test_with_odometry_a_scan_waits_for_the_odometry_of_its_stamp(precise):
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


def test_a_command_is_a_prior_only_when_told(precise):
    precise.on_message(CMD_VEL, CmdVel(stamp_ns=1, twist=Twist(vx=0.5)))
    assert precise._observation(a_scan(2)).command is None
    precise.settings = EstimatorSettings(prior="command")
    assert precise._observation(a_scan(2)).command.tolist() == [0.5, 0, 0]


@pytest.mark.parametrize("estimator", ["precise", "paper"])
def test_another_world_of_the_same_name_is_refused(tmp_path, estimator):
    file = tmp_path / "mine.yaml"
    file.write_text("name: corridor\nboundary: [[0, 0], [14, 0], [14, 4.5], [0, 4.5]]\n")
    with pytest.raises(UserError, match="another world of the same name 'corridor'"):
        opened(world=str(file), estimator=estimator)


def test_a_world_without_a_field_says_what_makes_it(tmp_path):
    with pytest.raises(UserError, match=f"presage train --world maze --preset precise --out {tmp_path}"):
        opened(world="maze", models=tmp_path)
    with pytest.raises(UserError, match="give learned, exact, or a file"):
        opened(model="best")


def test_exact_needs_nothing_learned():
    service = opened(model="exact")
    service.on_message(SCAN, a_scan(1, TRUTH))
    assert np.abs(service.sent[-1].pose.array() - TRUTH).max() < 1e-3
