"""Expected free energy against brute force, finite differences, and its limit, equation 4 of the paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra

from common.geometry import se2
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.controller.policies import expected_free_energy as efe
from services.controller.policies.active_localisation import ViewpointPaths, VisitedPlaces, path_energy
from services.controller.policies.expected_free_energy import entropy, place_information
from services.controller.policies.free_space import FreeSpace, Grid
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.controller.policies.paper_action import ActionParameters, action_gradient
from services.controller.policies.scan_information import (
    DIRECTIONS,
    MAP_ERROR_M,
    UNKNOWN_VARIANCE,
    ScanInformation,
    _ambiguity,
)
from tests.controller.driving import box, room, scan, shipped
from tests.controller.policies.reference_paths import moves

R = 25.0


def gain_of(ranges, sigma=0.02, weights=None):
    """Gain for ranges (K, M, B)."""
    weights = np.ones(len(ranges)) if weights is None else weights
    return place_information(weights, ranges, np.full(ranges.shape, sigma), R)


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
    gain = place_information(weights, ranges, sigma, R)
    assert gain.shape == ranges.shape[1:2]
    assert (gain >= 0).all()
    assert (gain <= entropy(weights) + 1e-12).all()
    equal = np.broadcast_to(ranges[:1], ranges.shape)  # no gain for any sigma
    assert place_information(weights, equal, sigma, R) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("beams", [61, 811])
def test_gain_of_different_scans(beams):
    weights, ranges = np.array([0.5, 0.3, 0.2]), np.array([1.0, 4.0, 9.0])[:, None, None] * np.ones((3, 1, beams))
    gain = gain_of(ranges, weights=weights)
    assert gain == pytest.approx(entropy(weights), rel=2e-3)


def test_gain_by_number_of_beams():
    """The numbers in the docstring."""
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
    """Against Monte Carlo with the same model, including outliers and the error of arrival.

    There are as many beams as sectors, so that each counts fully.
    With predictions about three deviations apart the gain is at least ``share`` of it, with eight at least 0.9.
    """
    rng = np.random.default_rng(5)
    weights, offsets = np.array([0.5, 0.3, 0.2]), rng.uniform(-1, 1, (3, efe.INDEPENDENT_SECTORS))
    deviation = np.hypot(sigma, efe.ARRIVAL_ERROR_M)
    for spread in (0.0, 0.3, 1.0, 3.0, 8.0):
        ranges = 9 + 1.4 * spread * deviation * offsets
        true = mutual_information(weights, ranges, deviation, efe.OUTLIER_SHARE, rng)
        (found,) = gain_of(ranges[:, None], sigma, weights)
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


def test_identical_rooms():
    """World `twins` with exact rays; places are spread over the room and the corridor outside."""
    world, scanner, twin = shipped("twins"), SCANNERS["tim571"].with_beams(61), np.array([6.0, 0.0, 0.0])
    here, door = np.array([2.0, 2.2, 0.3]), np.array([2.95, 4.5])
    places = np.stack(np.meshgrid(np.arange(0.4, 5.8, 0.5), np.arange(0.4, 6.2, 0.5)), axis=-1).reshape(-1, 2)
    places = places[(world.clearance(places) > Robot().radius) & (world.clearance(places + twin[:2]) > Robot().radius)]
    outside = places[:, 1] > door[1]
    through_the_door = np.hypot(*(door - here[:2])) + np.hypot(*(places - door).T)
    lengths = np.where(outside, through_the_door, np.hypot(*(places - here[:2]).T))
    moves = se2.between(here, np.column_stack([places, np.full(len(places), here[2])]))
    goal = np.array([4.5, 3.0])  # in the first room
    for first, second in ((here, here + twin), (here + twin, here)):
        paths = ViewpointPaths(np.array([first, second]), np.array([0.5, 0.5]), moves, lengths)
        poses = se2.compose(paths.poses().reshape(-1, 3), np.array(scanner.mount))
        ranges = world.ray_distances(poses, scanner.angles()).reshape(2, len(places), 61)
        gain = gain_of(ranges)
        assert np.median(gain[places[:, 1] < 3.5]) < 0.01
        assert gain[outside].max() > 0.6
        energy = path_energy(
            paths,
            ranges,
            np.full(ranges.shape, 0.02),
            scanner.range_max,
            lambda points: np.hypot(*np.moveaxis(points - goal, -1, 0)),
            VisitedPlaces().novelty,
        )
        assert places[np.argmin(energy.total), 1] > 4.5


def test_visited_places():
    visited, far = VisitedPlaces(), np.array([[0.0, 0.0], [3.0, 0.0], [-3.0, 0.0]])
    assert visited.novelty(far) == pytest.approx([0, 0.99, 0.99], abs=0.01)
    for number in range(50):  # 3 m ahead, then it turns round
        visited.integrate(
            number * 10**9 // 15, np.array([1.0, 0, 0]) if number < 46 else np.array([0, 0, np.pi * 15 / 4])
        )
    assert visited.novelty(far) == pytest.approx([0, 0, 0.99], abs=0.02)
    visited.add(far[2])
    assert visited.novelty(far)[2] == pytest.approx(0)


def test_motion_probabilities():
    energy = np.array([0.3, 0.1, np.inf]) * 5.0 / efe.PROBABILITY_PRECISION
    probabilities = [efe.motion_probability(each, energy) for each in energy[:2]]  # the third is excluded
    assert probabilities == pytest.approx([0.2689, 0.7311], abs=1e-4)


def test_one_step_and_a_known_pose():
    """The risk's gradient is that of the paper's equation 4, with the precision that a linear preference has there."""
    action, yaw, step, preferred = np.array([0.4, -0.1]), 0.7, 1e-6, np.array([3.0, 1.0])
    observed = np.array([1.0, 2.0])

    def distance(a):
        return np.hypot(*(observed + se2.rotate(yaw, a) - preferred))

    def risk(a):
        during, at_end = efe.expected_distance(np.repeat(distance(a), 2), 0.0)  # the same in a single step
        return efe.NATS_PER_METRE * (during + at_end)

    numeric = [(risk(action + e) - risk(action - e)) / (2 * step) for e in step * np.eye(2)]
    parameters = ActionParameters(horizon=1.0, action_precision=0.0)
    exact = action_gradient(action, observed, preferred, yaw, parameters)
    assert numeric == pytest.approx(2 * efe.NATS_PER_METRE / distance(action) * exact, rel=1e-6)


@pytest.mark.parametrize(("deviation", "noise"), [(0.3, 0.1), (0.05, 0.2), (0.2, 0.01)])
def test_pose_information(deviation, noise):
    """The gain by measuring x is the mutual information of the measurement and the blurred x, by enumeration."""
    blur = np.sqrt(efe.RESOLUTION_COVARIANCE[0, 0])
    x = np.linspace(-4, 4, 801) * np.hypot(deviation, max(noise, blur))
    joint = np.exp(-(x**2) / (2 * deviation**2))[:, None] * np.exp(-((x - x[:, None]) ** 2) / (2 * noise**2))
    blurred = np.exp(-((x - x[:, None]) ** 2) / (2 * blur**2)) @ joint  # (x at the resolution, measurement)
    p = blurred / blurred.sum()
    independent = np.outer(p.sum(axis=1), p.sum(axis=0))
    mutual = np.sum(p * np.log(np.where(p > 0, p / np.maximum(independent, 1e-300), 1.0)))
    covariance, information = np.diag([deviation**2, 0, 0]), np.diag([noise**-2, 0, 0])
    gain = efe.remaining_entropy(covariance, np.zeros((3, 3))) - efe.remaining_entropy(covariance, information)
    assert gain == pytest.approx(mutual, abs=0.01)


def test_expected_square():
    rng = np.random.default_rng(3)
    for value, deviation in [(0.5, 0.0), (0.5, 0.1), (-0.2, 0.3), (0.9, 0.5)]:
        sampled = np.mean(np.clip(value + deviation * rng.standard_normal(100_000), 0, 1) ** 2)
        assert efe.expected_square(np.array(value), deviation) == pytest.approx(sampled, abs=0.05)


def test_information_of_scans():
    """In the middle of a room, against finite differences of exact ranges; and without a wall in range."""
    hall, step = room(8, 6), 1e-5
    observed = scan(0, [4.0, 3.0, 0.0], hall)
    found = information_of(hall, observed)
    pose = np.array([4.25, 3.25, 0.0])  # the centre of a cell
    (cell,) = found.information_grid.cell_of(pose[None, :2])
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    differences = [
        hall.ray_distances((pose + e)[None], angles)[0] - hall.ray_distances((pose - e)[None], angles)[0]
        for e in step * np.eye(3)
    ]
    J = np.transpose(differences) / (2 * step)
    incidence = 1 / np.hypot(J[:, 0], J[:, 1])
    variance = 0.02**2 + (MAP_ERROR_M / incidence) ** 2
    exact = len(observed.ranges) / DIRECTIONS * np.einsum("b,bi,bj->ij", 1 / variance, J, J)
    np.testing.assert_allclose(found.information[cell], exact, rtol=0.15, atol=0.03 * exact.max())
    short = information_of(hall, observed.model_copy(update={"range_max": 1.0}))
    assert short.information[cell] == pytest.approx(0)
    block = information_of(room(8, 6, box(4, 3, 1.2, 1.2)), observed)  # no scan is possible from the cells inside
    assert block.ambiguity.max() < 0.01


def information_of(world, observed):
    return ScanInformation.of(FreeSpaceGraph(FreeSpace.of(world), 0.27), observed, 1.0)


def test_ambiguity_of_the_pose():
    """Against the least over all places that a scan may have fixed the pose at, by enumeration; in two rooms."""
    world = room(8, 6, box(4, 2.5, 0.2, 5))  # the way round the wall leads past y = 5
    graph = FreeSpaceGraph(FreeSpace.of(world, 0.2), 0.27)
    grid = Grid((0.0, 0.0), 1.0, (6, 8))
    rng, count = np.random.default_rng(1), grid.cell_count
    information = np.zeros((count, 3, 3))
    for cell in rng.choice(count, 6, replace=False):
        factor = rng.standard_normal((3, 5)) * np.array([30.0, 30.0, 60.0])[:, None]
        information[cell] = factor @ factor.T
    left = np.linalg.inv(information + np.eye(3) / UNKNOWN_VARIANCE)
    scan_variances = np.column_stack([np.linalg.eigvalsh(left[:, :2, :2]), left[:, 2, 2]])
    expected = np.zeros(graph.grid.cell_count)
    centres = graph.grid.centres()
    free = graph.free.clearance >= graph.min_clearance
    distances = dijkstra(moves(np.where(free, graph.grid.resolution, np.inf)))
    for variance, resolution in zip(scan_variances.T, np.diag(efe.RESOLUTION_COVARIANCE), strict=True):
        staying = np.zeros(count)
        for k in range(count):  # a metre of drift, then the scans of a metre, until it stays the same
            for _ in range(2000):
                staying[k] = 1 / (1 / (staying[k] + efe.DRIFT_PER_METRE**2) + 1 / variance[k])
        start = grid.interpolate(np.sqrt(staying).reshape(grid.shape), centres)
        deviation = np.minimum(start, (start[:, None] + efe.DRIFT_PER_METRE * distances).min(axis=0))
        expected += np.log(np.sqrt(1 + deviation**2 / resolution))
    found = _ambiguity(graph, grid, information).ravel()
    assert np.ptp(found) > 1
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_out_of_sight():
    """In a hall with a range of 2 m, a metre costs more the farther the walls are out of sight; near them, little."""
    hall = room(12, 9, *(box(x, y, 0.5, 0.6, "") for x in range(1, 12, 2) for y in (0.3, 8.7)))
    observed = scan(0, [6.0, 1.5, 0.0], hall).model_copy(update={"range_max": 2.0})
    short = information_of(hall, observed)
    near, edge, middle = short.ambiguity_grid.interpolate(
        short.ambiguity, np.array([[6.0, 1.3], [6.0, 3.4], [6.0, 4.5]])
    )
    assert near < 0.01 < edge < middle
    seldom = information_of(hall, observed.model_copy(update={"scan_time": 1.0}))
    # Where scans tell most, the entropy is proportional to the time between them: here 1 s instead of 1/15 s.
    assert seldom.ambiguity.min() == pytest.approx(15 * short.ambiguity.min(), rel=0.05)
