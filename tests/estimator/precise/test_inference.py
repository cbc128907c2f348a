"""Likelihood and its gradient, descent, fusion by Bayes' rule, motion priors, hypotheses, ranking of seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.ray_casting import MIN_COSINE
from common.geometry.world import World
from services.estimator.precise import beam_sums, global_seeds
from services.estimator.precise.gauss_newton import MAX_STEP, Prior
from services.estimator.precise.global_seeds import Seeds, thin_places
from services.estimator.precise.hypotheses import (
    MAX_HYPOTHESES,
    SURROUNDINGS_TRANSITIONS,
    TrackedHypothesis,
    UnknownPlace,
    select_best,
    unobserved_directions,
    weigh,
)
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import (
    MotionCandidate,
    MotionNoise,
    expected_motion,
    fuse,
    motion_complexity,
    motion_cost,
    predict_motion,
    widen_unobserved,
)
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.search import NEAR_SCHEDULE_M
from services.estimator.shared.generative_models import Expected, RayCaster
from tests.estimator.models import ROOM

MOUNT = np.array([0.2, 0.05, 0.3])
ANGLES = np.deg2rad(np.linspace(-135, 135, 200))
TRUTH = np.array([3.1, 1.4, 0.7])


def scan(pose, rng, sigma=0.02):
    clean = ROOM.ray_distances(se2.compose(pose, MOUNT)[None], ANGLES)[0]
    return clean + sigma * rng.standard_normal(len(clean))


def view(ranges, likelihood=None, range_max=25.0):
    return ScanLikelihood(RayCaster(ROOM), likelihood or Likelihood(), MOUNT, ANGLES, ranges, range_max)


@pytest.mark.parametrize(("expected", "scale"), [(5.0, 1e-3), (5.0, 0.3), (12.0, 0.05), (np.inf, 0.1)])
def test_likelihood_is_a_density(expected, scale):
    o = np.linspace(0, 25.0, 2_000_001)
    density = Likelihood().density(o, expected, scale, 25.0)
    no_return = np.exp(-accuracy_of_no_return(expected, scale))
    assert density.sum() * (o[1] - o[0]) + no_return == pytest.approx(1, rel=1e-4)


def accuracy_of_no_return(expected, scale):
    one = Expected(np.array([[expected]]), np.array([[scale]]), np.zeros((1, 1, 3)))
    return Likelihood().evaluate(np.array([np.inf]), 25.0, one).accuracy[0]


def test_accuracy():
    likelihood, rng = Likelihood(), np.random.default_rng(0)
    g, m = rng.uniform(1, 9, 50), rng.uniform(1e-3, 0.1, 50)
    o = np.clip(g + rng.normal(0, 0.5, 50) * (rng.random(50) < 0.5), 0.1, 24)
    found = likelihood.evaluate(o, 25.0, Expected(g[None], m[None], np.zeros((1, 50, 3))))
    by_hand = -sum(np.log(likelihood.density(np.array([a]), b, c, 25.0)[0]) for a, b, c in zip(o, g, m, strict=True))
    assert found.accuracy[0] == pytest.approx(by_hand)


def test_beams_without_range():
    likelihood = Likelihood()
    expected = Expected(np.array([[3.0, np.inf, 3.0]]), np.full((1, 3), 1e-3), np.ones((1, 3, 3)))

    def accuracy(*o):
        return likelihood.evaluate(np.array(o), 25.0, expected).accuracy[0]

    assert accuracy(np.inf, np.inf, -np.inf) == pytest.approx(-np.log(0.05) - np.log(0.95))
    assert accuracy(-np.inf, -np.inf, -np.inf) == 0
    assert accuracy(3.0, -np.inf, -np.inf) < accuracy(np.inf, -np.inf, -np.inf)


@pytest.mark.parametrize("relative", [0.0, 0.05])
def test_slope_of_a_beam(relative):
    likelihood, step = Likelihood(relative=relative), 1e-6
    g, m, o = np.array([1.0, 4.0, 9.0]), np.full(3, 0.01), np.array([1.02, 3.9, 9.3])

    def energy(each, shift):
        one = Expected((g + shift)[None, each], m[None, each], np.ones((1, 1, 3)))
        return likelihood.evaluate(o[each], 25.0, one)

    for k in range(3):
        each = slice(k, k + 1)
        slope = (energy(each, step).accuracy[0] - energy(each, -step).accuracy[0]) / (2 * step)
        assert energy(each, 0.0).xi[0] == pytest.approx(-np.ones(3) * slope, rel=1e-4)
        assert energy(each, 0.0).accuracy[0] == pytest.approx(
            -np.log(likelihood.density(o[each], float(g[k]), float(m[k]), 25.0)[0])
        )


def smooth_beams(ranges, pose, step):
    """Whether each beam's density (B,) is smooth within ``step`` of ``pose``.

    The caster limits the derivative of a beam that grazes a surface, so that it is not that of the range. A beam may
    jump to another surface, and the density has a step where the range measured is the one expected.
    """
    offsets = step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    seen = RayCaster(ROOM).expect(se2.compose(pose + offsets, MOUNT), ANGLES)
    here, above, below = seen.ranges[0], seen.ranges[1:4], seen.ranges[4:]
    grazes = np.hypot(*seen.jacobian[0, :, :2].T) > 0.999 / MIN_COSINE
    jumps = (np.abs(above - 2 * here + below) > 1e-3 * step).any(axis=0)
    crosses = ((ranges < seen.ranges) != (ranges < here)).any(axis=0)
    return ~(grazes | jumps | crosses)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
@example(6339)  # a beam grazes the circle
def test_gradient(seed):
    rng = np.random.default_rng(seed)
    pose, step = TRUTH + rng.normal(0, [0.01, 0.01, 0.005]), 1e-6
    ranges = scan(TRUTH, rng)
    smooth = smooth_beams(ranges, pose, step)
    assert smooth.mean() > 0.9
    seen = view(np.where(smooth, ranges, -np.inf))
    found = seen.evidence(pose[None]).xi[0]
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        low, high = seen.evidence(np.array([pose - offset, pose + offset])).accuracy
        assert found[axis] == pytest.approx(-(high - low) / (2 * step), rel=1e-4, abs=5e-3)


def test_beam_weights():
    """The derivatives are the sums over the beams, each times its constant weight."""
    rng = np.random.default_rng(4)
    seen, poses = view(scan(TRUTH, rng)), TRUTH + rng.normal(0, 0.01, (2, 3))
    used = rng.random((2, len(ANGLES))) < 0.5
    for share in (1.0, 0.5):
        found = seen.evidence(poses, 0.05, share * used)
        for k in range(2):
            masked = view(np.where(used[k], seen.ranges, -np.inf)).evidence(poses[k : k + 1], 0.05)
            for name in ("xi", "curvature", "xi_noise_covariance", "xi_model_covariance"):
                assert getattr(found, name)[k] == pytest.approx(share * getattr(masked, name)[0], rel=1e-9, abs=1e-9)


def test_following():
    """A sixth of the beams is stopped by something new, which must not pull the estimate."""
    rng = np.random.default_rng(1)
    ranges = scan(TRUTH, rng)
    ranges[80:115] = np.minimum(ranges[80:115], 0.9) - 0.1
    poses, evidence = view(ranges).descend(TRUTH[None] + [[0.05, -0.05, 0.03]])
    assert np.abs(poses[0] - TRUTH).max() < 0.01
    deviation = np.sqrt(np.diag(np.linalg.inv(evidence.curvature[0])))
    assert (np.abs(poses[0] - TRUTH) < 4 * deviation).all()


def test_grazing_beam():
    """Where a beam touches a circle its range has no finite derivative, and a step along it would mean nothing."""
    tangent = np.array([4.5 - 2.0, 3 - 0.4 + 1e-7, 0.0])
    expected = RayCaster(ROOM).expect(tangent[None], np.zeros(1))
    assert expected.ranges[0, 0] == pytest.approx(2, abs=1e-3)
    assert np.hypot(*expected.jacobian[0, 0, :2]) == pytest.approx(1 / MIN_COSINE)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_descent(seed):
    rng = np.random.default_rng(seed)
    seen = view(scan(TRUTH, rng))
    starts = TRUTH + rng.normal(0, [0.1, 0.1, 0.05], (8, 3))
    poses, evidence = seen.descend(starts, None, NEAR_SCHEDULE_M)
    best = int(evidence.accuracy.argmin())
    assert np.hypot(*(poses[best] - TRUTH)[:2]) < 0.02


def test_prior_without_evidence():
    nothing = view(np.full(len(ANGLES), -np.inf))
    prior = Prior(TRUTH[None], np.diag([100.0, 100.0, 400.0])[None])
    poses, _ = nothing.descend(TRUTH[None] + 0.2, prior)
    assert np.abs(poses[0] - TRUTH).max() < 1e-3


@given(st.integers(0, 10_000))
def test_fusion_is_bayes_rule(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 0.1, (2, 3, 3))
    P, H = a @ a.T + 0.01 * np.eye(3), np.linalg.inv(b @ b.T + 0.01 * np.eye(3))
    prior, seen = rng.normal(0, 0.2, (2, 3))
    mode = seen + rng.normal(0, 0.05, 3)  # the parabola may be expanded at any point
    found = fuse(MotionCandidate(prior, P, 0.5), mode, H @ (seen - mode), H)
    information = np.linalg.inv(P) + H
    assert found.mean == pytest.approx(np.linalg.solve(information, np.linalg.inv(P) @ prior + H @ seen), abs=1e-6)
    assert found.information == pytest.approx(information, rel=1e-6)
    # Evidence: the scan's mean is N(prior, P + H^-1) distributed.
    S = P + np.linalg.inv(H)
    off = seen - prior
    by_hand = 0.5 * off @ np.linalg.solve(S, off) + 0.5 * np.linalg.slogdet(S @ H)[1] - np.log(0.5)
    assert found.negative_log_evidence == pytest.approx(by_hand, rel=1e-4, abs=1e-4)
    assert found.complexity >= -1e-6


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9),
    st.lists(st.floats(0, 1e9), min_size=3, max_size=3),
    st.lists(st.floats(1e-4, 300), min_size=3, max_size=3),
)
@example([0, 0, 0, 0.3, 0, 0, 4.7, 0, 0], [0, 1e4, 1e4], [2.9, 0.01, 0.01])  # no curvature along x: 39.5 m
def test_trust_region(numbers, curvatures, deviations):
    mean, mode, slope = np.array(numbers).reshape(3, 3)
    mean[2] = se2.wrap(mean[2])
    found = fuse(MotionCandidate(mean, np.diag(deviations) ** 2, 0.5), mode, slope, np.diag(curvatures))
    taken, off = (np.abs(se2.difference(pose, mean)) for pose in (found.mean, mode))
    assert (taken <= (off + MAX_STEP) * (1 + 1e-6) + 1e-6).all()
    assert (taken <= (3 * np.array(deviations) + 5 * MAX_STEP) * (1 + 1e-6) + 1e-6).all()


def test_motion_priors():
    noise, P = MotionNoise(), 1e-6 * np.eye(3)
    standing, going, wide = predict_motion(noise, TRUTH, P, 0.1, velocity=np.array([1.0, 0, 0]))
    assert standing.mean == pytest.approx(TRUTH)
    assert going.mean == pytest.approx(se2.compose(TRUTH, [0.1, 0, 0]))
    assert [np.trace(c.covariance[:2, :2]) for c in (standing, going, wide)] == sorted(
        np.trace(c.covariance[:2, :2]) for c in (standing, going, wide)
    )
    step = np.array([0.1, 0, 0.2])
    with_odometry = predict_motion(noise, TRUTH, P, 0.1, odom=step, velocity=np.ones(3))
    assert len(with_odometry) == 4  # standing, going on, by odometry, any motion
    assert sum(c.probability for c in with_odometry) == pytest.approx(1)
    odom = expected_motion(with_odometry)
    assert odom.probability > 0.95  # it is rarely wrong
    assert odom.mean == pytest.approx(se2.compose(TRUTH, step))
    commanded = predict_motion(noise, TRUTH, P, 0.1, command=np.array([0.5, 0, 0]), velocity=np.ones(3))[1]
    assert commanded.mean == pytest.approx(se2.compose(TRUTH, [0.05, 0, 0]))
    assert sum(c.probability for c in (standing, going, wide)) == pytest.approx(1)


def test_motion_cost():
    """A motion near an expected one costs nothing; any other what the prior says, and one too fast more."""
    noise, P, known = MotionNoise(), 1e-6 * np.eye(3), np.zeros((3, 3))
    motions = predict_motion(noise, TRUTH, P, 0.1, velocity=np.array([0.5, 0, 0]))
    standing, going, anywhere = motions
    for each in (standing, going):
        assert motion_cost(noise, motions, each.mean, known) == 0
        root = np.linalg.cholesky(each.covariance)
        assert motion_cost(noise, motions, each.mean + root @ [0.0, 2.99, 0.0], known) == 0
    aside = se2.compose(going.mean, [0.0, 0.08, 0.1])
    ratio = np.sqrt(np.linalg.det(anywhere.covariance) / np.linalg.det(going.covariance))
    cost = np.log(going.probability / anywhere.probability * ratio)
    assert motion_cost(noise, motions, aside, known) == pytest.approx(cost)
    too_fast = se2.compose(TRUTH, [0.5, 0.0, 0.0])
    assert motion_cost(noise, motions, too_fast, known) == pytest.approx(
        cost + 0.5 * (anywhere.squared_distance(too_fast) - 9)
    )
    # If nothing tells whether the robot moves, no motion of which it is capable costs anything.
    assert motion_cost(noise, predict_motion(noise, TRUTH, P, 0.1), aside, known) == 0


def test_motion_complexity():
    """It is minus the logarithm of the probability that the prediction gave to the poses that the scan leaves."""
    noise, known = MotionNoise(), np.diag([4e-3, 4e-3, 8e-3]) ** 2
    motions = predict_motion(noise, TRUTH, known, 0.1, velocity=np.array([0.5, 0, 0]))
    going = motions[1]
    offsets = np.random.default_rng(0).multivariate_normal(np.zeros(3), going.covariance, 400_000)
    fits = np.exp(-0.5 * np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(known), offsets))
    expected = -np.log(going.probability * fits.mean())
    assert motion_complexity(motions, going.mean, known) == pytest.approx(expected, abs=0.03)
    # A motion that is known exactly leaves only the probability that the robot moves like this.
    exact = [replace(each, covariance=1e-12 * each.covariance) for each in motions]
    assert motion_complexity(exact, going.mean, known) == pytest.approx(-np.log(going.probability))


def test_drift():
    """Equal shares of every motion add up: there and back they cancel, straight on they grow with the distance."""
    noise = MotionNoise(path_by_path=0, path_by_turn=0, turn_by_path=0, turn_by_turn=0, standing=0, slip=0.1)

    def drifted(steps):
        pose, P, drift = TRUTH, np.zeros((3, 3)), None
        for step in steps:
            moved = expected_motion(
                predict_motion(noise, pose, P, 0.1, odom=np.array(step), pose_slip_cross_covariance=drift)
            )
            pose, P, drift = moved.mean, moved.covariance, moved.pose_slip_cross_covariance
        return se2.rotation(-TRUTH[2]) @ P @ se2.rotation(-TRUTH[2]).T

    assert drifted([[0.2, 0, 0]] * 50) == pytest.approx(np.diag([1.0, 0, 0]), abs=1e-9)
    assert drifted([[0.2, 0, 0]] * 50 + [[-0.2, 0, 0]] * 50) == pytest.approx(np.zeros((3, 3)), abs=1e-9)
    assert np.sqrt(drifted([[0, 0.1, 0]] * 10)[1, 1]) == pytest.approx(0.1)
    assert np.sqrt(drifted([[0, 0, 0.3]] * 10)[2, 2]) == pytest.approx(0.3)


def test_unobserved_motion():
    """The deviation grows at full speed along the unobserved directions alone."""
    noise, found = MotionNoise(speed=1.0, turn=2.0), MotionCandidate(TRUTH, 1e-6 * np.eye(3), 1.0)
    along = np.array([[0.6, 0.8, 0.0]])
    one, every = found, found
    for k in range(30):
        one, every = (
            widen_unobserved(noise, each, directions, k, 0.1) for each, directions in ((one, along), (every, np.eye(3)))
        )
    values, vectors = np.linalg.eigh(one.covariance)
    assert np.sqrt(values) == pytest.approx([1e-3, 1e-3, 3], abs=1e-2)
    assert np.abs(vectors[:, 2]) == pytest.approx([0.6, 0.8, 0], abs=1e-6)
    assert np.sqrt(np.diag(every.covariance)) == pytest.approx([3, 3, 6], rel=1e-3)


def make_hypothesis(x, log_evidence, log_likelihood=0.0):
    pose, zero, one = np.array([x, 0.0, 0.0]), np.zeros((3, 3)), np.eye(3)
    evidence = {"log_evidence": log_evidence, "scan_log_likelihood": log_likelihood}
    return TrackedHypothesis(pose, one, zero, 1.0, 0.0, np.zeros(3), one, **evidence)


def test_hypothesis_weights():
    hypotheses = [
        make_hypothesis(5.0, -1.0),
        make_hypothesis(0.0, 3.0, -3.0),
        make_hypothesis(0.01, -3.0),
        make_hypothesis(9.0, -5000.0),
    ]
    found, unknown = weigh(hypotheses, -2.0)
    assert [m.pose[0] for m in found] == [0.0, 5.0]
    assert found[0].weight / found[1].weight == pytest.approx(np.e)
    assert sum(m.weight for m in found) == pytest.approx(1)
    assert unknown / (1 - unknown) == pytest.approx(np.exp(-2) / (1 + np.exp(-1)))
    (best,), unknown = weigh(hypotheses[1:2], 5000.0)
    assert best.weight == unknown == 1
    places = [make_hypothesis(float(x), -0.1 * x) for x in range(MAX_HYPOTHESES + 1)]
    assert [each.pose[0] for each in weigh(places, -2.0)[0]] == list(range(MAX_HYPOTHESES))


def test_unobserved_directions():
    """Along a hall, the ends show the position, unless something hides them."""
    hall = RayCaster(World(name="hall", boundary=[(0, 0), (20, 0), (20, 2), (0, 2)]))
    pose = np.array([10.0, 1.0, 0.3])
    clean = hall.expect(pose[None], ANGLES).ranges[0]
    seen = ScanLikelihood(hall, Likelihood(), np.zeros(3), ANGLES, clean, 25.0)
    curvature = seen.evidence(pose[None]).curvature
    assert unobserved_directions(seen, pose[None], curvature)[0].shape == (0, 3)
    rough, near = replace(seen, map_error=0.04), pose + np.array([[dx, 0, 0] for dx in (-0.04, 0, 0.04)])
    curvatures = rough.evidence(near, 0.0, rough.surface_evidence(near).weights).curvature
    assert [len(found) for found in unobserved_directions(rough, near, curvatures)] == [0, 0, 0]
    hidden = replace(seen, ranges=np.where(clean > 6, 0.8, clean))
    ((along,),) = unobserved_directions(hidden, pose[None], curvature)
    assert np.abs(along) == pytest.approx([1.0, 0.0, 0.0], abs=0.01)
    nothing = replace(seen, ranges=np.full_like(clean, 0.8))
    assert unobserved_directions(nothing, pose[None], curvature)[0] == pytest.approx(np.eye(3))


def test_headings_across_pi():
    poses = np.array([[0, 0, np.pi - 0.01], [0, 0, -np.pi + 0.01], [0, 0, 0.0]])
    assert select_best(poses, np.array([-1.0, 0.0, -2.0]), 8) == [1, 2]


def test_seed_ranking():
    rng = np.random.default_rng(3)
    seeds = Seeds.at(RayCaster(ROOM), thin_places(ROOM.sample_free(2000, rng, 0.05), 0.3))
    for _ in range(10):
        pose = np.array([*ROOM.sample_free(1, rng, 0.27)[0], rng.uniform(-np.pi, np.pi)])
        ranked = seeds.rank(view(scan(pose, rng)), 30)
        near = np.hypot(*(ranked - pose)[:, :2].T) < 0.4
        assert (near & (np.abs(se2.wrap(ranked[:, 2] - pose[2])) < 0.2)).any()


def test_seed_ranking_between_places():
    """A seed 0.14 m away is compared as if the laser stood at the pose, so that the search starts there."""
    rng = np.random.default_rng(6)
    seeds = Seeds.at(RayCaster(ROOM), thin_places(ROOM.sample_free(2000, rng, 0.05), 0.3))
    for place in seeds.places[rng.choice(len(seeds.places), 10, replace=False)]:
        laser = se2.compose(np.array([*place, rng.uniform(-np.pi, np.pi)]), np.array([0.1, -0.1, 0.0]))
        pose = se2.compose(laser, se2.inverse(view(np.ones(4)).mount))
        off = np.abs(se2.difference(seeds.rank(view(scan(pose, rng)), 10), pose))
        assert ((off[:, :2] < 0.05).all(axis=1) & (off[:, 2] < 0.03)).any()


def test_preselection(monkeypatch):
    rng = np.random.default_rng(5)
    seeds = Seeds.at(RayCaster(ROOM), thin_places(ROOM.sample_free(4000, rng, 0.05), 0.2))
    shared = []
    for _ in range(20):
        pose = np.array([*ROOM.sample_free(1, rng, 0.27)[0], rng.uniform(-np.pi, np.pi)])
        ranges = scan(pose, rng)
        ranges[: len(ranges) // 4] *= 0.5  # blocked
        exhaustive = seeds.rank(view(ranges), 30)
        with monkeypatch.context() as patch:
            patch.setattr(global_seeds, "FINELY_SELECTED_PLACES", len(seeds.places) // 3)
            shared.append(len({*map(tuple, seeds.rank(view(ranges), 30))} & {*map(tuple, exhaustive)}) / 30)
    assert np.mean(shared) > 0.95


def test_ranking_costs():
    rng = np.random.default_rng(4)
    panoramas = rng.integers(0, 256, (5, 2, 120)).astype(np.uint8)
    bins, measured, most = np.arange(0, 120, 2), rng.integers(1, 256, 60).astype(np.uint8), 200
    least, costs = np.empty(5, np.uint16), np.empty((5, 120), np.uint16)
    beam_sums.rank_places(panoramas.view(np.uint64), bins, measured, most, least, costs)
    assert np.array_equal(least, costs.min(axis=1))
    around = np.minimum(panoramas, most).transpose(1, 0, 2).astype(int)
    o = np.minimum(measured, most).astype(int)
    for heading in range(120):
        surface, behind = around[:, :, (bins + heading) % 120]
        late = np.minimum(np.minimum(o - surface, 10), 2 + np.minimum(np.abs(o - behind), 8))
        misfit = np.where(o > surface, late, np.minimum(surface - o, 6))
        assert np.array_equal(costs[:, heading], np.where(surface > 0, misfit, 4).sum(axis=1))


def test_thin_places():
    points = np.random.default_rng(0).uniform(0, 3, (5000, 2))
    thin = thin_places(points, 0.5)
    assert len(thin) == 36
    assert len({(int(x / 0.5), int(y / 0.5)) for x, y in thin}) == 36


def test_evidence_of_a_place_that_the_robot_was_not_at_before():
    """It begins with that of the places that a search may have missed; the robot seldom enters from off the map."""
    unknown, enter = UnknownPlace(), np.log(SURROUNDINGS_TRANSITIONS[2, 0])
    unknown.restart(1e-3, 1e-9)
    assert unknown.log_arrival == pytest.approx(np.log(1e-3), abs=1e-5)
    unknown.restart(1e-3, 5e-4)
    assert unknown.log_arrival == pytest.approx(np.log(5e-4 + 5e-4 * np.exp(enter)))
    unknown.exclude_mapped_places()
    assert unknown.log_arrival == pytest.approx(np.log(5e-4) + enter)
