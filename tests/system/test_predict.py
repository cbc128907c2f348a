"""The query `predict` of a real estimator over zenoh, blocking and asynchronous."""

from __future__ import annotations

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, RequestResult
from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Pose, Scan
from common.messages.requests import PredictReply, PredictRequest
from common.messages.topics import BELIEF, PREDICT, SCAN
from common.robot.scanner import SCANNERS
from tests.conftest import WAIT_TIMEOUT_S

TIMEOUT_S = 60.0
SCANNER = SCANNERS["tim571"].with_beams(180)
WORLD = load_world("office")


def seen(pose):
    return WORLD.ray_distances(se2.compose(pose, np.array(SCANNER.mount)), SCANNER.angles())[0]


@pytest.fixture
def estimator(bus, process):
    """A running estimator that has processed one scan."""
    running, beliefs = process("estimator", "--world", "office"), Inbox()
    bus.subscribe(BELIEF, beliefs)
    assert wait_until(lambda: "estimator" in bus.alive(), TIMEOUT_S), running.output
    assert bus.wait_matching(SCAN, TIMEOUT_S)
    early = bus.query(PREDICT, PredictRequest(poses=np.zeros((1, 3))), PredictReply, timeout=WAIT_TIMEOUT_S)
    assert early.reason == "no scan has come yet"
    scan = Scan(
        stamp_ns=1, angle_min=SCANNER.angle_min, angle_increment=SCANNER.angle_increment, range_min=0.05,
        range_max=25.0, ranges=seen(np.array([3.0, 4.0, 0.0])), mount=Pose.of(SCANNER.mount),
    )  # fmt: skip
    bus.put(SCAN, scan.encode())
    assert wait_until(lambda: len(beliefs) > 0, TIMEOUT_S), running.output
    return running


def test_predictions(estimator, bus):
    rng = np.random.default_rng(0)
    poses = np.column_stack([WORLD.sample_free(100, rng, 0.27), rng.uniform(-np.pi, np.pi, 100)])
    request = PredictRequest(poses=poses, beams=61)
    waited = bus.query(PREDICT, request, PredictReply, timeout=WAIT_TIMEOUT_S)
    ranges = waited.ranges.reshape(100, 61)
    exact = WORLD.ray_distances(se2.compose(poses, np.array(SCANNER.mount)), waited.angles)
    assert np.median(np.abs(ranges - exact)) < 0.001
    inbox = Inbox()
    for number in range(5):
        bus.send_request(PREDICT, request, number, inbox, TIMEOUT_S)
    assert wait_until(lambda: len(inbox) == 5, TIMEOUT_S)
    answers = [inbox.get(0) for _ in range(5)]
    assert all(isinstance(each, RequestResult) and each.reply() == waited for each in answers)
    assert sorted(each.number for each in answers) == list(range(5))

    too_many = PredictRequest(poses=np.zeros((1001, 3)))
    assert not bus.query(PREDICT, too_many, PredictReply, timeout=WAIT_TIMEOUT_S).ok
    all_beams = PredictRequest(poses=poses, beams=181)  # one more than the scanner has
    assert len(bus.query(PREDICT, all_beams, PredictReply, timeout=WAIT_TIMEOUT_S).angles) == 180
    walls = PredictRequest(poses=np.array([[0.0, 0.0, 0.0], [1e4, -5.0, 7.0], [4.6, 0.9, 1.0]]))
    assert bus.query(PREDICT, walls, PredictReply, timeout=WAIT_TIMEOUT_S).ok
    not_finite = PredictRequest.model_construct(poses=np.full((1, 3), np.nan), beams=None)
    with pytest.raises(UserError, match=r"refused: PredictRequest\.poses: .* not finite"):
        bus.query(PREDICT, not_finite, PredictReply, timeout=WAIT_TIMEOUT_S)
    assert bus.query(PREDICT, request, PredictReply, timeout=WAIT_TIMEOUT_S) == waited
    assert estimator.stop() == 0
    assert "Traceback" not in estimator.output
