"""Query `predict`: predicted scans compared with exact rays, and requests that are refused."""

from __future__ import annotations

from types import SimpleNamespace

import msgpack
import numpy as np
import pytest

from common.bus.inbox import Inbox, IncomingRequest
from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Pose
from common.messages.requests import PredictReply, PredictRequest
from common.messages.topics import PREDICT, SCAN
from common.runtime.service import ServiceLoop
from services.estimator.prediction_query import answer_prediction
from services.estimator.shared.interface import Predicted
from tests.estimator.test_service import SCANNER, TRUTH, WORLD, a_scan, opened

HEADING = np.pi / 2  # of the paper's decoder
# Far outside the map, and inside walls.
FAR = [[-500.0, 3.0, 0.0], [1e4, -1e4, 1e4], [6.8, 3.95, 1.0], [0.0, 0.0, 0.0], [18.0, 4.5, 3.0]]


def ready(settings=None, **scan):
    service = opened(**(settings or {}))
    service.on_message(SCAN, a_scan(1, TRUTH, **scan))
    return service


@pytest.fixture(scope="module")
def precise():
    return ready()


@pytest.fixture(scope="module")
def paper():
    return ready({"estimator": "paper"})


def predicted(service, poses, beams=None):
    """Returns angles (B,), ranges (N, B) and sigma (N, B)."""
    reply = service.on_request(PREDICT, PredictRequest(poses=np.asarray(poses, float), beams=beams))
    assert reply.ok, reply.reason
    shape = (len(poses), len(reply.angles))
    return reply.angles, reply.ranges.reshape(shape), reply.sigma.reshape(shape)


def random_poses(world, count, heading=None):
    rng = np.random.default_rng(0)
    yaw = rng.uniform(-np.pi, np.pi, count) if heading is None else np.full(count, heading)
    return np.column_stack([world.sample_free(count, rng, 0.27), yaw])


def exact(world, poses, angles, mount=SCANNER.mount):
    return world.ray_distances(se2.compose(poses, np.array(mount)), angles)


@pytest.mark.parametrize("name", ["corridor", "office"])
def test_learned_field(name):
    service, world = ready({"world": name}), load_world(name)
    poses = random_poses(world, 100)
    angles, ranges, sigma = predicted(service, poses, 61)
    error, model_sigma = np.abs(ranges - exact(world, poses, angles)), np.sqrt(np.maximum(sigma**2 - 0.02**2, 1e-6))
    assert np.median(error) < 0.001
    assert (error > 0.05).mean() < 0.02
    assert (sigma >= 0.02).all()
    assert (error < 3 * model_sigma).mean() > 0.95
    assert error[sigma > 0.05].mean() > 10 * error[sigma < 0.03].mean()


@pytest.mark.parametrize(
    ("settings", "sigma"),
    [
        ({"model": "exact"}, 0.02),
        ({"model": "exact", "sigma": 0.05}, 0.05),
        ({"estimator": "particle-filter"}, 0.1),
        ({"estimator": "amcl-defaults"}, 0.2),
    ],
)
def test_exact_models(settings, sigma):
    service, poses = ready(settings), random_poses(WORLD, 20)
    angles, ranges, stated = predicted(service, poses, 61)
    assert ranges == pytest.approx(exact(WORLD, poses, angles), abs=1e-5)
    assert stated == pytest.approx(np.full(ranges.shape, sigma), rel=1e-3)


def test_paper(paper):
    poses = random_poses(WORLD, 50, HEADING)
    angles, ranges, sigma = predicted(paper, poses, 61)
    assert np.median(np.abs(ranges - exact(WORLD, poses, angles))) < 0.2  # the card states 0.05 m
    assert (sigma == np.float32(paper.estimator.card.test_l1_mean)).all()
    own = paper.estimator.model.predict(poses[7])[0]
    assert predicted(paper, poses[7:8])[1][0] == pytest.approx(own, rel=1e-4, abs=1e-4)
    predicted(paper, [[5.0, 1.5, HEADING + 4 * np.pi]], 10)  # the same heading
    with pytest.raises(UserError, match=r"at its one heading, 90\.0 deg, and was asked for 0\.0 deg"):
        predicted(paper, [[5.0, 1.5, HEADING], [5.0, 1.5, 0.0]], 10)


@pytest.mark.parametrize("beams", [2, 3, 61, 621, 622])
def test_subset_of_beams(precise, beams):
    poses = random_poses(WORLD, 5)
    angles, ranges, sigma = predicted(precise, poses)
    assert angles == pytest.approx(SCANNER.angles(), abs=1e-6)
    some, some_ranges, some_sigma = predicted(precise, poses, beams)
    index = np.searchsorted(angles, some)
    assert np.array_equal(angles[index], some)
    assert (some[0], some[-1], len(some)) == (angles[0], angles[-1], beams)
    assert np.ptp(np.diff(index)) <= 1
    assert np.array_equal(some_ranges, ranges[:, index])
    assert np.array_equal(some_sigma, sigma[:, index])


def test_beyond_range_max():
    angles, ranges, sigma = predicted(ready(range_max=8.0), TRUTH[None])
    far = exact(WORLD, TRUTH[None], angles)
    clear = np.abs(far - 8) > 0.1
    assert (far > 8).any()
    assert np.array_equal(np.isposinf(ranges[clear]), far[clear] > 8)
    assert np.isfinite(sigma).all()


@pytest.mark.parametrize("settings", [{}, {"model": "exact"}, {"estimator": "particle-filter"}, {"estimator": "paper"}])
def test_impossible_poses(settings):
    poses = np.array(FAR)
    if settings.get("estimator") == "paper":
        poses[:, 2] = HEADING
    _, ranges, sigma = predicted(ready(settings), poses, 61)
    assert not np.isnan(ranges).any()
    assert (ranges >= 0).all()
    assert (sigma > 0).all()


def test_mount_of_the_scan():
    mount = (0.0, 0.1, 0.3)
    angles, ranges, _ = predicted(ready(mount=Pose.of(mount)), TRUTH[None], 61)
    assert np.median(np.abs(ranges - exact(WORLD, TRUTH[None], angles, mount))) < 0.002


def test_belief_is_unchanged():
    def beliefs(*, predicting):
        service = ready()
        for stamp in range(2, 5):
            if predicting:
                predicted(service, random_poses(WORLD, 30), 61)
            service.on_message(SCAN, a_scan(stamp, TRUTH + np.array([0.02 * stamp, 0, 0])))
        return service.sent

    assert beliefs(predicting=True) == beliefs(predicting=False)


def ask(service, payload: bytes):
    """Passes a request through the service's loop; returns the reply, or the refusal as text."""
    found = []
    loop = ServiceLoop(service, SimpleNamespace(robot="robot"), Inbox())
    loop._answer(
        IncomingRequest(PREDICT, payload, lambda reply: found.append(PredictReply.decode(reply)), found.append)
    )
    assert loop.failed == 0
    return found[0]


def test_too_large_request(precise):
    reply = ask(precise, PredictRequest(poses=np.zeros((1001, 3)), beams=2).encode())
    assert not reply.ok
    assert "1001 poses are too many to predict at once: request at most 1000" in reply.reason
    assert len(reply.ranges) == 0


@pytest.mark.parametrize(("beams", "predicted"), [(61, 61), (622, 622), (623, 622), (None, 622)])
def test_number_of_beams(precise, beams, predicted):
    reply = ask(precise, PredictRequest(poses=np.array([[3.5, 1.5, 0.0]]), beams=beams).encode())
    assert reply.ok
    assert len(reply.angles) == len(reply.ranges) == predicted
    assert reply.angles[[0, -1]] == pytest.approx(precise.geometry.angles[[0, -1]])


@pytest.mark.parametrize(
    "change",
    [
        {"poses": np.array([0.0, np.nan, 0.0]).tobytes()}, {"poses": np.array([np.inf, 0.0, 0.0]).tobytes()},
        {"poses": b"1234567"}, {"poses": "here"}, {"poses": [[0.0, 0.0, 0.0]]}, {"poses": None}, {"beams": 1},
        {"beams": -5}, {"beams": 10**6}, {"beams": 7.5},
    ],
    ids=str,
)  # fmt: skip
def test_invalid_request(precise, change):
    refusal = ask(precise, msgpack.packb({"poses": np.zeros((1, 3)).tobytes(), "beams": 61, **change}))
    assert isinstance(refusal, str)
    assert "PredictRequest" in refusal
    assert ask(precise, PredictRequest(poses=np.zeros((1, 3))).encode()).ok


def test_no_poses(precise):
    reply = ask(precise, PredictRequest(poses=np.zeros((0, 3)), beams=61).encode())
    assert (reply.ok, len(reply.angles), len(reply.ranges), len(reply.sigma)) == (True, 61, 0, 0)


def test_too_many_ranges():
    class Model:
        def predict(self, poses, angles):
            return Predicted(np.ones((len(poses), len(angles))), np.ones((len(poses), len(angles))))

    angles = np.linspace(-2, 2, 2000)
    assert answer_prediction(Model(), PredictRequest(poses=np.zeros((500, 3))), angles, 25.0).ok
    with pytest.raises(UserError, match=r"1000 poses with 2000 beams each are too many .* at most 1000000 ranges"):
        answer_prediction(Model(), PredictRequest(poses=np.zeros((1000, 3))), angles, 25.0)


def test_before_the_first_scan():
    reply = ask(opened(model="exact"), PredictRequest(poses=np.zeros((1, 3))).encode())
    assert (reply.ok, reply.reason) == (False, "no scan has come yet")
