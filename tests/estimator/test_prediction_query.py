"""Query `predict`: predicted scans compared with exact rays, and requests that are refused."""

from __future__ import annotations

from types import SimpleNamespace

import msgpack
import numpy as np
import pytest

from common.bus.inbox import Call, Inbox
from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Pose
from common.messages.requests import PredictReply, PredictRequest
from common.messages.topics import PREDICT, SCAN
from common.robot.scanner import SCANNERS
from common.runtime.service import Loop
from services.estimator.prediction_query import answer_prediction
from services.estimator.shared.interface import Predicted
from tests.estimator.test_service import SCANNER, TRUTH, a_scan, opened

HEADING = np.pi / 2  # of the paper's decoder
FAR = [
    [-500.0, 3.0, 0.0],
    [1e4, -1e4, 1e4],
    [6.8, 3.95, 1.0],
    [0.0, 0.0, 0.0],
    [18.0, 4.5, 3.0],
]  # far outside the map, and inside walls


def ready(**settings):
    service = opened(**settings)
    service.on_message(SCAN, a_scan(1, TRUTH))
    return service


@pytest.fixture(scope="module")
def precise():
    return ready()


@pytest.fixture(scope="module")
def paper():
    return ready(estimator="paper")


def predicted(service, poses, beams=None):
    """Returns angles (B,), ranges (N, B) and sigma (N, B)."""
    reply = service.on_request(PREDICT, PredictRequest(poses=np.asarray(poses, float), beams=beams))
    assert reply.ok, reply.reason
    shape = (len(poses), len(reply.angles))
    return reply.angles, reply.ranges.reshape(shape), reply.sigma.reshape(shape)


def anywhere(world, count, seed=0, heading=None):
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-np.pi, np.pi, count) if heading is None else np.full(count, heading)
    return np.column_stack([world.sample_free(count, rng, 0.27), yaw])


def exact(world, poses, angles):
    return world.ray_distances(se2.compose(poses, np.array(SCANNER.mount)), angles)


@pytest.mark.parametrize("name", ["corridor", "office"])
def test_the_learned_field_predicts_exact_rays_and_knows_how_well(name):
    service, world = ready(world=name), load_world(name)
    poses = anywhere(world, 100)
    angles, ranges, sigma = predicted(service, poses, 61)
    error = np.abs(ranges - exact(world, poses, angles))
    assert np.median(error) < 0.001
    assert (error > 0.05).mean() < 0.02
    assert (sigma >= 0.02).all()
    assert (
        error < 3 * np.sqrt(np.maximum(sigma**2 - 0.02**2, 1e-6))
    ).mean() > 0.95  # within three deviations of the model alone
    assert error[sigma > 0.05].mean() > 10 * error[sigma < 0.03].mean()


@pytest.mark.parametrize(
    ("settings", "sigma"),
    [
        ({"model": "exact"}, 0.02), ({"model": "exact", "sigma": 0.05}, 0.05), ({"estimator": "particle-filter"}, None),
        ({"estimator": "amcl-defaults"}, None),
    ],
)  # fmt: skip
def test_who_has_the_world_itself_predicts_it_exactly(settings, sigma):
    service, world = ready(**settings), load_world("corridor")
    poses = anywhere(world, 20)
    angles, ranges, stated = predicted(service, poses, 61)
    assert ranges == pytest.approx(exact(world, poses, angles), abs=1e-5)
    expected = service.estimator.settings.sigma_hit if sigma is None else sigma
    assert stated == pytest.approx(np.full(ranges.shape, expected), rel=1e-3)


def test_the_paper_s_decoder_predicts_at_its_heading(paper):
    world = load_world("corridor")
    poses = anywhere(world, 50, heading=HEADING)
    angles, ranges, sigma = predicted(paper, poses, 61)
    assert np.median(np.abs(ranges - exact(world, poses, angles))) < 0.2  # the card states 0.05 m
    assert (sigma == np.float32(paper.estimator.card.test_l1_mean)).all()
    own = paper.estimator.model.predict(poses[7])[0]
    assert predicted(paper, poses[7:8])[1][0] == pytest.approx(own, rel=1e-4, abs=1e-4)


def test_the_paper_refuses_other_headings_and_says_which(paper):
    poses = np.array([[5.0, 1.5, HEADING], [5.0, 1.5, 0.0]])
    with pytest.raises(UserError, match=r"at its one heading, 90\.0 deg, and was asked for 0\.0 deg"):
        paper.on_request(PREDICT, PredictRequest(poses=poses, beams=10))
    predicted(paper, [[5.0, 1.5, HEADING + 4 * np.pi]], 10)  # the same heading


def test_beams_are_some_of_the_scanner_s_first_and_last_among_them(precise):
    poses = anywhere(load_world("corridor"), 5)
    angles, ranges, sigma = predicted(precise, poses)
    assert angles == pytest.approx(SCANNER.angles(), abs=1e-6)
    for beams in (2, 3, 61, 621, 622):
        some, fewer, less = predicted(precise, poses, beams)
        index = np.searchsorted(angles, some)
        assert (angles[index] == some).all()
        assert (some[0], some[-1], len(some)) == (angles[0], angles[-1], beams)
        assert np.ptp(np.diff(index)) <= 1
        assert np.array_equal(fewer, ranges[:, index])
        assert np.array_equal(less, sigma[:, index])


def test_beyond_the_scanner_s_range_no_return_is_expected():
    service = opened()
    service.on_message(SCAN, a_scan(1, TRUTH, range_max=8.0))
    angles, ranges, sigma = predicted(service, TRUTH[None])
    far = exact(load_world("corridor"), TRUTH[None], angles)
    assert (far > 8).any()
    assert np.array_equal(np.isposinf(ranges[np.abs(far - 8) > 0.1]), far[np.abs(far - 8) > 0.1] > 8)
    assert np.isfinite(sigma).all()


@pytest.mark.parametrize(
    "settings", [{}, {"model": "exact"}, {"estimator": "particle-filter"}, {"estimator": "paper"}], ids=str
)
def test_poses_nobody_can_be_at_get_whatever_the_model_predicts(settings):
    service, poses = ready(**settings), np.array(FAR)
    if settings.get("estimator") == "paper":
        poses[:, 2] = HEADING
    _, ranges, sigma = predicted(service, poses, 61)
    assert not np.isnan(ranges).any()
    assert (ranges >= 0).all()
    assert (sigma > 0).all()


def test_the_mounting_is_the_scan_s():
    service = opened()
    service.on_message(SCAN, a_scan(1, TRUTH, mount=Pose(x=0.0, y=0.1, yaw=0.3)))
    angles, ranges, _ = predicted(service, TRUTH[None], 61)
    there = load_world("corridor").ray_distances(se2.compose(TRUTH, [0.0, 0.1, 0.3]), angles)
    assert np.median(np.abs(ranges - there)) < 0.002


def test_a_prediction_changes_no_belief():
    def beliefs(*, asked):
        service = ready()
        for stamp in range(2, 5):
            if asked:
                predicted(service, anywhere(load_world("corridor"), 30), 61)
            service.on_message(SCAN, a_scan(stamp, TRUTH + np.array([0.02 * stamp, 0, 0])))
        return service.sent

    assert beliefs(asked=True) == beliefs(asked=False)


class Answering:
    """A service's loop without a bus: takes a request as bytes, and returns the reply as bytes or the refusal."""

    def __init__(self, service):
        self.loop = Loop(service, SimpleNamespace(robot="robot"), Inbox())

    def ask(self, payload: bytes):
        found = []
        self.loop._answer(Call(PREDICT, payload, lambda p: found.append(PredictReply.decode(p)), found.append))
        (answer,) = found
        return answer


@pytest.mark.parametrize(
    ("poses", "beams", "why"),
    [
        (np.zeros((1001, 3)), 2, "1001 poses are too many to predict at once: ask for 1000 at most"),
        (np.zeros((1, 3)), 623, "the scanner has 622 beams, not 623"),
    ],
)
def test_too_much_is_refused_with_what_can_be_asked(precise, poses, beams, why):
    reply = Answering(precise).ask(PredictRequest(poses=poses, beams=beams).encode())
    assert not reply.ok
    assert why in reply.reason
    assert len(reply.ranges) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"poses": np.array([0.0, np.nan, 0.0]).tobytes()},
        {"poses": np.array([np.inf, 0.0, 0.0]).tobytes()},
        {"poses": b"1234567"},
        {"poses": "here"},
        {"poses": [[0.0, 0.0, 0.0]]},
        {"poses": None},
        {"beams": 1},
        {"beams": -5},
        {"beams": 10**6},
        {"beams": 7.5},
    ],
    ids=str,
)
def test_what_is_no_request_is_refused_and_survived(precise, change):
    answering = Answering(precise)
    refusal = answering.ask(msgpack.packb({"poses": np.zeros((1, 3)).tobytes(), "beams": 61, **change}))
    assert isinstance(refusal, str)
    assert "PredictRequest" in refusal
    assert answering.ask(b"\xc1") != ""
    assert answering.ask(PredictRequest(poses=np.zeros((1, 3))).encode()).ok
    assert answering.loop.failed == 0


def test_nothing_asked_is_nothing_answered(precise):
    reply = precise.on_request(PREDICT, PredictRequest(poses=np.zeros((0, 3)), beams=61))
    assert reply.ok
    assert (len(reply.angles), len(reply.ranges), len(reply.sigma)) == (61, 0, 0)


def test_a_scanner_of_very_many_beams_is_not_predicted_a_thousand_times():
    class Model:
        def predict(self, poses, angles):
            return Predicted(np.ones((len(poses), len(angles))), np.ones((len(poses), len(angles))))

    angles = np.linspace(-2, 2, 2000)
    assert answer_prediction(Model(), PredictRequest(poses=np.zeros((500, 3))), angles, 25.0).ok
    with pytest.raises(UserError, match="1000 poses of 2000 beams are too many ranges"):
        answer_prediction(Model(), PredictRequest(poses=np.zeros((1000, 3))), angles, 25.0)


def test_before_the_first_scan_there_is_no_scanner_to_predict():
    reply = opened(model="exact").on_request(PREDICT, PredictRequest(poses=np.zeros((1, 3))))
    assert isinstance(reply, PredictReply)
    assert not reply.ok
    assert reply.reason == "no scan has come yet"


def test_the_shipped_scanner_is_what_these_tests_take():
    assert SCANNERS["tim571"].with_beams(622) == SCANNER
