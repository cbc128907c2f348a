"""The particle filter's parts compared with the textbook: densities, motion, resampling, clusters."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import World
from services.estimator.particle_filter import ParticleFilterSettings, motion, resampling
from services.estimator.particle_filter.beam_model import BeamModel, RangeTable
from services.estimator.particle_filter.clusters import cluster_hypotheses, labels, moments
from services.estimator.particle_filter.fit_averages import FitAverages
from services.estimator.particle_filter.likelihood_field import LikelihoodField, SurfaceDistances
from tests.estimator.models import ROOM

HALL = World(name="hall", boundary=[(0, 0), (10, 0), (10, 10), (0, 10)])
ALPHAS = (0.04, 0.02, 0.03, 0.05, 0.01)


def test_distance_field():
    field, rng = SurfaceDistances(ROOM, 0.05), np.random.default_rng(0)
    points = rng.uniform((-1, -1), (7, 5), (4000, 2))
    exact = np.clip(ROOM.clearance(points), -2, 2)
    found = field(points[:, 0], points[:, 1])
    assert np.abs(found - exact).max() < 0.03  # largest where a cell contains a medial axis or a corner
    assert np.median(np.abs(found - exact)) < 1e-4
    x, y = (field.origin[k] + 0.05 * rng.integers(5, field.shape[k] - 5, 500) for k in (0, 1))
    nodes = np.clip(ROOM.clearance(np.column_stack([x, y])), -2, 2)
    assert np.abs(field(x, y) - nodes).max() < 2e-4  # single precision finds the node to 1e-6 of a cell


def test_surfaces_and_saturation():
    """The distance is 0 on the boundary of free space, to 0.1 mm, so that no pose is drawn into the walls."""
    field = SurfaceDistances(HALL, 0.07)
    along = np.linspace(0.5, 9.5, 50)
    assert np.abs(field(np.zeros(50), along)).max() < 1e-4
    assert np.abs(field(along, np.full(50, 10.0))).max() < 1e-4
    assert np.all(field(np.array([-500.0, 5.0, 1e4]), np.array([5.0, 900.0, -1e4])) == -2.0)
    assert field(np.array([5.0]), np.array([5.0]))[0] == 2.0


def test_too_large_world():
    huge = World(name="huge", boundary=[(0, 0), (440, 0), (440, 440), (0, 440)])
    with pytest.raises(UserError, match="coarser resolution"):
        SurfaceDistances(huge)
    with pytest.raises(UserError, match="too many"):
        RangeTable(huge)


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.5])
def test_likelihood_field_is_a_density(sigma):
    """Integrates over all ranges of a beam perpendicular to a wall, without other surfaces nearby."""
    field = LikelihoodField(SurfaceDistances(HALL, 0.05), 0.95, 0.05)
    z, pose = np.linspace(0, 25, 25001), np.array([[5.0, 5.0, 0.0]])
    ends = np.concatenate([field.ends(pose, np.array([r]), np.zeros(1))[0] for r in z[::10]])
    density = field.densities(ends, sigma, 25.0)
    # Beyond max_dist the Gaussian has its value at max_dist, which is 4 sigma for the largest sigma.
    assert np.sum(density) * 0.01 == pytest.approx(1.0, abs=6e-3)


def test_product_of_many_beams():
    field = LikelihoodField(SurfaceDistances(ROOM), 0.95, 0.05)
    far = np.full((2, 811), 1.5)
    log = field.log_product(far, 0.1, 25.0)
    assert np.allclose(log, 811 * np.log(0.05 / 25), rtol=1e-5)  # e^-5040
    assert np.all(np.isfinite(field.log_cubes(far, 0.1, 25.0)))


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 30), st.floats(0.02, 1), st.floats(0.05, 3))
def test_beam_model_is_a_density(expected, sigma, rate):
    model, z = BeamModel(0.5, 0.1, 0.05, 0.5, sigma, rate), np.linspace(0, 10, 40001)
    middles = (z[1:] + z[:-1]) / 2
    p = np.exp(model.log_density(middles, np.array([[expected]]), 10.0))[0]
    nothing = np.exp(model.log_density(np.array([np.inf]), np.array([[expected]]), 10.0))[0, 0]
    assert p.sum() * (z[1] - z[0]) + nothing == pytest.approx(1.0, abs=2e-3)


def test_beam_model():
    model, expected = BeamModel(0.7, 0.2, 0.05, 0.05, 0.1, 1.0), np.array([[5.0]])
    near, hit, beyond, *unmeasured = (
        model.log_density(np.array([r]), expected, 25.0)[0, 0] for r in (2.0, 5.0, 8.0, -np.inf, np.nan)
    )
    assert hit > near > beyond
    assert unmeasured == [0, 0]


def test_range_table():
    table, rng = RangeTable(ROOM, 0.02), np.random.default_rng(1)
    poses = np.column_stack([ROOM.sample_free(50, rng, 0.3), rng.uniform(-np.pi, np.pi, 50)])
    angles = np.linspace(-2, 2, 30)
    error = np.abs(table.ranges(poses, angles) - ROOM.ray_distances(poses, angles))
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.95) < 0.05


def test_omni_moments():
    rng, step, n = np.random.default_rng(2), np.array([0.3, 0.4, 0.2]), 200_000
    moved = motion.omni(np.tile([1.0, 2.0, 0.7], (n, 1)), step, ALPHAS, rng)
    mean = se2.compose(np.array([1.0, 2.0, 0.7]), step)
    a1, a2, a3, a4, a5 = ALPHAS
    p2, t2 = 0.25, 0.04
    along, across, turn = a3 * p2 + a1 * t2, a1 * t2 + a5 * p2, a4 * t2 + a2 * p2
    bearing = 0.7 + np.arctan2(0.4, 0.3)
    axes = np.array([[np.cos(bearing), np.sin(bearing)], [np.sin(bearing), -np.cos(bearing)]]).T
    assert np.allclose(moved.mean(axis=0), mean, atol=4 * np.sqrt(along / n))
    assert np.allclose(np.cov(moved[:, :2].T), axes @ np.diag([along, across]) @ axes.T, atol=2e-4)
    assert np.var(moved[:, 2]) == pytest.approx(turn, rel=0.02)


@pytest.mark.parametrize("sign", [1, -1], ids=["forward", "backward"])
@pytest.mark.parametrize("path", [0.5, 0.004], ids=["far", "short"])
def test_differential_moments(sign, path):
    """On a straight line: path variance alpha3 p², turn variance 2 alpha2 p²; driving backwards is no turn by pi."""
    rng, n = np.random.default_rng(3), 200_000
    moved = motion.differential(np.zeros((n, 3)), np.array([sign * path, 0.0, 0.0]), ALPHAS, rng)
    shrunk = np.exp(-0.5 * ALPHAS[1] * path**2)  # expectation of the cosine of the first turn
    deviation = path * np.sqrt(ALPHAS[2])
    assert moved[:, 0].mean() == pytest.approx(sign * path * shrunk, abs=4 * deviation / np.sqrt(n))
    assert np.std(moved[:, 0]) == pytest.approx(deviation, rel=0.02)
    assert np.var(se2.wrap(moved[:, 2])) == pytest.approx(2 * ALPHAS[1] * path**2, rel=0.02)


def test_differential_turns_in_place():
    moved = motion.differential(np.zeros((100_000, 3)), np.array([0, 0, 0.3]), ALPHAS, np.random.default_rng(4))
    assert moved[:, 2].mean() == pytest.approx(0.3, abs=1e-3)
    assert np.var(moved[:, 2]) == pytest.approx(ALPHAS[0] * 0.09, rel=0.02)
    assert np.hypot(moved[:, 0], moved[:, 1]).max() < 0.5


@settings(max_examples=40, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2), st.floats(0, 1))
def test_command_is_an_arc(vx, vy, w, dt):
    fine, pose = np.array([vx, vy, w]) * dt / 500, np.zeros(3)
    for _ in range(500 if abs(w) > 1e-9 else 1):
        pose = pose + np.array([*se2.rotate(pose[2] + fine[2] / 2, fine[:2]), fine[2]])
    if abs(w) <= 1e-9:
        pose = np.array([vx, vy, w]) * dt
    assert np.allclose(motion.arc(np.array([vx, vy, w]), dt), pose, atol=3e-6)


def test_low_variance_resampling():
    rng, weights = np.random.default_rng(5), np.array([0.05, 0.0, 0.33, 0.12, 0.5])
    draws = np.stack([np.bincount(resampling.low_variance(weights, 17, rng), minlength=5) for _ in range(20_000)])
    assert np.allclose(draws.mean(axis=0), 17 * weights, atol=0.02)
    assert np.all(np.abs(draws - 17 * weights) < 1)
    assert draws.sum(axis=1).tolist() == [17] * 20_000


@pytest.mark.parametrize(
    ("bins", "z", "bound"),
    [
        (2, 0.99, 20),  # 1 / (2 * 0.05) = 10 times (1 - 2/9 + sqrt(2/9) * 0.99)^3 = (7/9 + 0.466690...)^3 = 1.92721
        (101, 0.99, 1140),  # 1000 (1 - 1/450 + 0.0471405 * 0.99)^3 = 1000 * 1.0444469^3 = 1139.34
        (1, 0.99, 1),
        (101, 1.6449, 1244),  # 2 n err is nearly the 0.95 quantile of chi squared with 100 degrees of freedom, 124.342
    ],
)
def test_kld_bound(bins, z, bound):
    assert float(resampling.kld_bound(bins, 0.05, z)) == pytest.approx(bound, abs=1 if z > 1 else 0)


@pytest.mark.parametrize(
    ("draws", "bins", "count"), [(20_000, 1, 500), (20_000, 20_000, 20_000), (20_000, 101, 1140), (100, 1, 500)]
)
def test_adaptive_count(draws, bins, count):
    assert resampling.adaptive_count(np.arange(draws) % bins, 0.05, 0.99, 500, 20_000) == count


def test_cluster_labels():
    poses = np.array([[0.1, 0.1, np.pi - 0.05], [0.1, 0.1, -np.pi + 0.05], [-0.1, -0.4, -3.0], [2.0, 0.1, 3.1]])
    found = labels(poses)
    assert found[0] == found[1] == found[2] != found[3]
    chain = np.column_stack([np.arange(40) * 0.5 + 0.25, np.full(40, 0.25), np.zeros(40)])
    assert len(np.unique(labels(chain[np.random.default_rng(6).permutation(40)]))) == 1
    turned = np.column_stack([np.zeros(3), np.zeros(3), np.radians([5, 25, 45])])
    assert len(np.unique(labels(turned))) == 3


def test_hypotheses():
    rng = np.random.default_rng(7)
    centres = [(1.0, 1.0, 3.1), (4.0, 1.0, 0.0), (1.0, 5.0, 1.0)]
    poses = np.concatenate([np.array(c) + 0.05 * rng.standard_normal((300, 3)) for c in centres])
    weights = np.repeat([0.2, 0.7, 0.1], 300) / 300
    found = cluster_hypotheses(poses, weights)
    assert [h.weight for h in found] == pytest.approx([0.7, 0.2, 0.1], abs=2e-3)
    for h, centre in zip(found, (centres[1], centres[0], centres[2]), strict=True):
        assert np.allclose(se2.between(np.array(centre), h.pose), 0, atol=0.015)
        assert np.allclose(h.covariance, 0.0025 * np.eye(3), atol=6e-4)
    one = cluster_hypotheses(np.array([[1.0, 2.0, 0.5]]), np.ones(1))[0]
    assert np.linalg.eigvalsh(one.covariance).min() > 0


def test_moments():
    mean, covariance = moments(np.array([[0, 0, np.pi - 0.1], [2.0, 0, -np.pi + 0.1]]), np.array([0.5, 0.5]))
    assert abs(mean[2]) == pytest.approx(np.pi)
    assert covariance[2, 2] == pytest.approx(0.01)
    assert covariance[0, 0] == pytest.approx(1.0)


def test_fit_averages():
    averages = FitAverages(0.01, 0.3)
    for _ in range(20):
        averages.add(0.9)
    assert averages.random_share == 0.0
    averages.add(0.1)
    assert averages.random_share == pytest.approx(1 - (0.9 - 0.24) / (0.9 - 0.008), abs=1e-6)
    averages.add(0.95)
    averages.add(0.95)
    assert averages.random_share < 0.12


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sigma_hit": 0.0}, "sigma_hit must be greater than 0"),
        ({"max_beams": 0}, "max_beams must be greater than 0"),
        ({"alpha1": -1.0, "sigma_hit": -0.1}, "alpha1, sigma_hit must not be negative"),
        ({"walk_share": 1.5}, "walk_share must be 1 at most"),
        ({"z_rand": 0.0}, "z_hit and z_rand must be greater than 0"),
        ({"min_particles": 9000}, "max_particles 2000 < min_particles 9000"),
    ],
)
def test_wrong_settings(wrong, message):
    with pytest.raises(UserError, match=f"particle filter: {message}"):
        dataclasses.replace(ParticleFilterSettings(), **wrong)


def test_overlapping_obstacles():
    """Of two boxes that overlap, the edge of one inside the other is no surface."""
    boxes = [{"box": {"center": (c, 5), "size": (2, 2)}} for c in (4.5, 5.5)]
    world = World(name="pair", boundary=HALL.boundary, obstacles=boxes)
    assert SurfaceDistances(world)(np.array([5.5]), np.array([5.0]))[0] == pytest.approx(-1.0, abs=1e-3)
    assert shapely.area(world.free_space) == pytest.approx(94)
