"""Information gain against its limits and against brute force; selection of destinations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from common.geometry import se2
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from services.controller.policies.epistemic import (
    CandidateMotions,
    DestinationSelector,
    PredictionTrust,
    best_index,
    candidate_poses,
    entropy,
    expected_free_energy,
    information_gain,
)
from tests.controller.driving import shipped

R = 25.0
SECOND = 1_000_000_000


def gain_of(ranges, sigma=0.02, weights=None, trust=None):
    """Gain for ranges (K, M, B)."""
    weights = np.ones(len(ranges)) if weights is None else weights
    return information_gain(weights, ranges, np.full(ranges.shape, sigma), R, trust)


@st.composite
def predictions(draw):
    """Weights (K,), ranges (K, M, B), some of them without return, and sigma (K, M, B)."""
    count = draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (count, int(rng.integers(1, 5)), int(rng.integers(1, 40)))
    ranges = rng.uniform(0, 30, shape)
    ranges[rng.random(shape) < 0.1] = np.inf
    ranges = np.where(rng.random(shape) < rng.random(), ranges[:1], ranges)  # a random share of the beams is equal
    weights = rng.random(count) * (rng.random(count) < 0.8)
    assume(weights.sum() > 0)
    return weights, ranges, rng.uniform(0.001, 2, shape)


@given(predictions())
def test_gain_is_between_zero_and_the_entropy(predicted):
    weights, ranges, sigma = predicted
    gain = information_gain(weights, ranges, sigma, R)
    assert gain.shape == ranges.shape[1:2]
    assert (gain >= 0).all()
    assert (gain <= entropy(weights) + 1e-12).all()
    equal = np.broadcast_to(ranges[:1], ranges.shape)  # no gain for any sigma
    assert information_gain(weights, equal, sigma, R) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("beams", [61, 811])
@pytest.mark.parametrize("outliers", [0.25, 0.0])
def test_gain_of_different_scans(beams, outliers):
    weights, ranges = np.array([0.5, 0.3, 0.2]), np.array([1.0, 4.0, 9.0])[:, None, None] * np.ones((3, 1, beams))
    gain = gain_of(ranges, weights=weights, trust=PredictionTrust(outliers=outliers))
    assert gain == pytest.approx(entropy(weights), rel=2e-3)


def test_gain_by_number_of_beams():
    """The numbers in the docstring of PredictionTrust."""
    gain = gain_of(np.stack([np.full((61, 61), 5.0), 5.0 + 3.0 * np.tri(61, 61, -1)]))
    assert (np.diff(gain) > 0).all()
    assert gain[3] < 0.2
    assert gain[8] == pytest.approx(0.4, abs=0.05)
    assert gain[20] > 0.6


@pytest.mark.parametrize(("first", "low", "high"), [(5.0, 0.6, 0.7), (np.inf, 0, 1e-12), (R - 1e-3, 0, 1e-3)])
def test_no_return(first, low, high):
    assert low <= gain_of(np.array([first, np.inf])[:, None, None] * np.ones((2, 1, 61)))[0] <= high


@pytest.mark.parametrize(("sigma", "share"), [(0.02, 0.85), (0.05, 0.8), (0.2, 0.65)])
def test_gain_and_mutual_information(sigma, share):
    """Against Monte Carlo with the same model, including outliers, and as many beams as sectors.

    With predictions about three deviations apart the gain is at least ``share`` of it, with eight at least 0.9.
    """
    rng = np.random.default_rng(5)
    trust = PredictionTrust(outliers=0.25, blur=0.0, sectors=6)
    weights, offsets = np.array([0.5, 0.3, 0.2]), rng.uniform(-1, 1, (3, 6))
    for spread in (0.0, 0.3, 1.0, 3.0, 8.0):
        ranges = 9 + 1.4 * spread * sigma * offsets
        true = mutual_information(weights, ranges, sigma, trust.outliers, rng)
        (found,) = gain_of(ranges[:, None], sigma, weights, trust)
        assert found <= true + 0.008, spread  # sampling error of 40 000 draws
        assert found >= {3.0: share, 8.0: 0.9}.get(spread, 0) * true, spread


def mutual_information(weights, ranges, sigma, outliers, rng, draws=40_000):
    """H(k) - E[H(k | o)] in nats for independent beams with density (1 - e) N + e / R; ranges (K, B)."""
    k = rng.choice(len(weights), draws, p=weights)
    o = ranges[k] + sigma * rng.standard_normal((draws, ranges.shape[1]))
    wild = rng.random(o.shape) < outliers
    o[wild] = rng.uniform(0, R, wild.sum())
    core = np.exp(-0.5 * ((o[:, None] - ranges) / sigma) ** 2) / np.sqrt(2 * np.pi * sigma**2)
    log = np.log((1 - outliers) * core + outliers / R).sum(axis=2) + np.log(weights)
    posterior = np.exp(log - log.max(axis=1, keepdims=True))
    posterior /= posterior.sum(axis=1, keepdims=True)
    left = -np.sum(posterior * np.log(np.maximum(posterior, 1e-300)), axis=1)
    return entropy(weights) - left.mean()


def test_candidate_poses():
    hypotheses = np.array([[1.0, 2.0, 0.0], [5.0, 1.0, np.pi / 2]])
    found = candidate_poses(hypotheses, np.array([[2.0, 1.0, 0.5], [0.0, 0.0, 0.0]]))
    assert found == pytest.approx(np.array([[[3, 3, 0.5], [1, 2, 0]], [[4, 3, np.pi / 2 + 0.5], [5, 1, np.pi / 2]]]))


def test_best_index_prefers_short_paths():
    lengths = np.array([4.0, 2.0, np.inf, 2.0])
    energy = expected_free_energy(np.array([0.6, 0.6, 0.69, 0.6]), lengths, 0.0)
    assert best_index(energy, lengths) == 1
    energy = expected_free_energy(np.array([0.6, 0.5, 0.69, 0.5]), lengths, 0.02)
    assert energy == pytest.approx([-0.52, -0.46, np.inf, -0.46])
    assert best_index(energy, lengths) == 0
    assert best_index(np.full(3, np.inf), np.full(3, np.inf)) is None
    assert best_index(np.zeros(0), np.zeros(0)) is None


class TwoRooms:
    """Two rooms, 6 m apart. Scans differ from x = 3 m on in each of them, increasingly with x."""

    def __init__(self, **settings):
        self.selector = DestinationSelector(**settings)
        self.robot = 0.0  # m, x in the left room

    def motions(
        self, x=0.0, *, swapped=False, weights=(0.5, 0.5), moves=((1, 0), (2, 0), (4, 0), (0, 4)), lengths=None
    ):
        self.robot = x
        hypotheses = np.array([[x, 0.0, 0.0], [x + 6.0, 0.0, 0.0]])
        moves = np.array([[*move, 0.0] for move in moves], float).reshape(-1, 3)
        lengths = np.hypot(*moves[:, :2].T) if lengths is None else np.array(lengths)
        return CandidateMotions(hypotheses[::-1] if swapped else hypotheses, np.array(weights), moves, lengths)

    def choose(self, stamp, motions):
        poses = motions.poses().reshape(len(motions.hypotheses), -1, 3)
        ranges = np.full((*poses.shape[:2], 61), 5.0)
        for k, (row, hypothesis) in enumerate(zip(poses, motions.hypotheses, strict=True)):
            if hypothesis[0] - self.robot >= 3.0:  # the room on the right
                beams = np.clip(20 * (row[:, 0] - 8.9), 0, 61)
                ranges[k][np.arange(61) < beams[:, None]] = 8.0
        return self.selector.choose(stamp, motions, ranges, np.full(ranges.shape, 0.02), R)


@pytest.fixture
def rooms():
    return TwoRooms(timeout=10.0)


@pytest.mark.parametrize(
    ("motions", "destination"),
    [
        ({}, [4.0, 0, 0]),
        ({"swapped": True}, [10.0, 0, 0]),
        ({"moves": [(1, 0), (2, 0)]}, None),  # no gain
        ({"moves": []}, None),
        ({"lengths": [np.inf] * 4}, None),  # no path
        ({"weights": (1.0, 0.0)}, None),
    ],
)
def test_chooses_the_place_where_scans_differ(rooms, motions, destination):
    found = rooms.choose(0, rooms.motions(**motions))
    assert found is None if destination is None else found == pytest.approx(destination)


def test_swapped_hypotheses(rooms):
    rooms.choose(0, rooms.motions())
    for k in range(1, 30):
        motions = rooms.motions(0.1 * k, swapped=k % 2 == 1)
        found = rooms.selector.follow(k * SECOND // 15, motions.hypotheses, motions.weights)
        assert found == pytest.approx([10.0, 0, 0] if k % 2 else [4.0, 0, 0]), k
        assert rooms.selector.displacement(motions.hypotheses[0]) == pytest.approx([4.0 - 0.1 * k, 0, 0])


def test_reached_destination(rooms):
    assert rooms.choose(0, rooms.motions(moves=[(4, 0), (4, 3)])) == pytest.approx([4, 0, 0])
    for k in range(1, 41):
        rooms.selector.follow(k, rooms.motions(0.1 * k).hypotheses, [0.5, 0.5])
    assert rooms.selector.chosen is None
    assert rooms.choose(50, rooms.motions(4.0, moves=[(0.2, 0), (0, 3)])) == pytest.approx([4.0, 3.0, 0])
    rooms.selector.chosen = None
    assert rooms.choose(51, rooms.motions(4.0, moves=[(0.2, 0)])) == pytest.approx([4.2, 0, 0])


@pytest.mark.parametrize(
    ("stamp", "shift", "weights", "kept"),
    [
        (15 * SECOND, 0.0, (0.5, 0.5), True),
        (15 * SECOND + 1, 0.0, (0.5, 0.5), False),  # timeout
        (5 * SECOND, 0.0, (0.7, 0.3), True),
        (5 * SECOND, 0.0, (0.97, 0.03), False),  # resolved
        (5 * SECOND, 2.0, (0.5, 0.5), False),  # the hypotheses jumped
        (4 * SECOND, 0.0, (0.5, 0.5), False),  # the simulation was reset
    ],
)
def test_destination_is_dropped(rooms, stamp, shift, weights, kept):
    motions = rooms.motions()
    rooms.choose(5 * SECOND, motions)
    found = rooms.selector.follow(stamp, motions.hypotheses + np.array([0.0, shift, 0.0]), weights)
    assert (found is not None) == kept
    assert (rooms.selector.displacement(motions.hypotheses[0]) is not None) == kept
    rooms.selector.reset()
    assert rooms.selector.follow(5 * SECOND, motions.hypotheses, (0.5, 0.5)) is None


def test_better_destination(rooms):
    assert rooms.choose(0, rooms.motions(moves=[(4, 0)])) == pytest.approx([4, 0, 0])
    # Slightly shorter with equal gain: kept. Ten metres shorter with equal gain: changed.
    more = [(4, 0), (3.9, 1)]
    assert rooms.choose(1, rooms.motions(moves=more, lengths=[5.0, 4.0])) == pytest.approx([4, 0, 0])
    assert rooms.choose(2, rooms.motions(moves=more, lengths=[15.0, 4.0])) == pytest.approx([3.9, 1, 0])
    assert rooms.choose(3, rooms.motions(weights=(0.99, 0.01))) is None  # its gain has fallen
    assert rooms.selector.chosen is None


def test_identical_rooms():
    """World `twins` with exact rays; destinations are spread over the room and the corridor outside."""
    world, scanner, twin = shipped("twins"), SCANNERS["tim571"].with_beams(61), np.array([6.0, 0.0, 0.0])
    here, door = np.array([2.0, 2.2, 0.3]), np.array([2.95, 4.5])
    places = np.stack(np.meshgrid(np.arange(0.4, 5.8, 0.5), np.arange(0.4, 6.2, 0.5)), axis=-1).reshape(-1, 2)
    places = places[(world.clearance(places) > Robot().radius) & (world.clearance(places + twin[:2]) > Robot().radius)]
    outside = places[:, 1] > door[1]
    through_the_door = np.hypot(*(door - here[:2])) + np.hypot(*(places - door).T)
    lengths = np.where(outside, through_the_door, np.hypot(*(places - here[:2]).T))
    moves = se2.between(here, np.column_stack([places, np.full(len(places), here[2])]))
    for first, second in ((here, here + twin), (here + twin, here)):
        motions = CandidateMotions(np.array([first, second]), np.array([0.5, 0.5]), moves, lengths)
        ranges = world.ray_distances(se2.compose(motions.poses(), np.array(scanner.mount)), scanner.angles())
        ranges = ranges.reshape(2, len(places), 61)
        gain = gain_of(ranges)
        assert np.median(gain[places[:, 1] < 3.5]) < 0.01
        assert gain[outside].max() > 0.6
        chosen = DestinationSelector().choose(0, motions, ranges, np.full(ranges.shape, 0.02), scanner.range_max)
        assert chosen[1] > 4.5
        assert 0 < chosen[0] - (first[0] - here[0]) < 5.8
