"""The estimator's shell without a bus: what it answers to which scan."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages import Belief, Goal, LocaliseRequest, Pose, Prediction, Scan
from common.scanner import SCANNERS
from common.topics import GOAL, LOCALISE, SCAN
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings

SCANNER = SCANNERS["tim571"].with_beams(622)


class Heard(EstimatorService):
    """Keeps what it would publish."""

    def __init__(self, settings):
        super().__init__(settings)
        self.sent = []

    def publish(self, topic, message):
        self.sent.append(message)


@pytest.fixture
def service():
    made = Heard(EstimatorSettings())
    made.open()
    return made


def a_scan(stamp, **changes) -> Scan:
    values = {
        "stamp_ns": stamp, "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment,
        "range_min": 0.05, "range_max": 25.0, "ranges": np.full(622, 2.0), "mount": Pose.of(SCANNER.mount),
    }  # fmt: skip
    return Scan(**{**values, **changes})


def test_each_scan_gets_a_prediction_and_a_belief_of_its_stamp(service):
    service.on_message(SCAN, a_scan(7))
    prediction, belief = service.sent
    assert isinstance(prediction, Prediction)
    assert isinstance(belief, Belief)
    assert belief.stamp_ns == prediction.stamp_ns == 7
    assert len(prediction.ranges) == 622
    assert belief.covariance is None
    assert belief.free_energy == pytest.approx(belief.accuracy + belief.complexity)
    assert belief.pose.yaw == pytest.approx(np.pi / 2)


def test_a_scan_sent_again_is_answered_again_but_not_used_again(service):
    service.on_message(SCAN, a_scan(7))
    service.on_message(SCAN, a_scan(7))
    assert service.sent[:2] == service.sent[2:]
    service.on_message(SCAN, a_scan(8))
    assert service.sent[-1].pose != service.sent[1].pose


def test_no_return_and_too_close_are_used(service):
    ranges = np.full(622, 2.0)
    ranges[:50], ranges[50:60] = np.inf, -np.inf
    service.on_message(SCAN, a_scan(1, ranges=ranges))
    assert np.isfinite(service.sent[-1].free_energy)


@pytest.mark.parametrize(
    "changes",
    [
        {"ranges": np.full(100, 2.0)},
        {"angle_min": -1.0},
        {"angle_increment": 0.001},
        {"mount": Pose(x=0.0, y=0.1)},
    ],
)
def test_a_scan_of_another_scanner_is_refused_with_the_command_that_helps(service, changes):
    service.on_message(SCAN, a_scan(1, **changes))
    assert service.sent == []
    assert "presage train --world corridor" in service.note
    service.on_message(SCAN, a_scan(2))  # and it goes on
    assert len(service.sent) == 2
    assert service.note == ""


def test_localise_anew(service):
    assert not service.on_request(LOCALISE, LocaliseRequest()).ok  # nothing to restart yet
    service.on_message(SCAN, a_scan(1))
    assert service.on_request(LOCALISE, LocaliseRequest(pose=Pose(x=4.0, y=1.0))).ok
    assert service.estimator.pose[:2].tolist() == [4.0, 1.0]
    assert service.on_request(LOCALISE, LocaliseRequest()).ok
    assert service.estimator.pose[:2].tolist() == [9.0, 2.25]


def test_goals_are_remembered_and_cancelled(service):
    service.on_message(GOAL, Goal(stamp_ns=0, pose=Pose(x=1.0, y=1.0)))
    assert service.goal is not None
    service.on_message(GOAL, Goal(stamp_ns=0, pose=Pose(x=1.0, y=1.0), cancel=True))
    assert service.goal is None
