"""The particle filter as a whole: global localisation, tracking, kidnapping, repeatability."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from services.estimator.particle_filter import ParticleFilter, Settings
from services.estimator.shared.interface import Observation, Posterior
from tests.estimator.models import ROOM, SCANNER

ANGLES = SCANNER.angles()
SMALL = dataclasses.replace(Settings.tuned(), max_particles=5000)
CERTAIN = np.diag([0.01, 0.01, 0.0025])


def make(seed: int, settings: Settings = SMALL, world: World = ROOM) -> ParticleFilter:
    return ParticleFilter(world, settings, SCANNER.mount, seed)


def scan(pose, rng, world: World = ROOM) -> np.ndarray:
    exact = world.ray_distances(se2.compose(pose, SCANNER.mount), ANGLES)[0]
    return SCANNER.limit(exact + 0.02 * rng.standard_normal(len(exact)))


def observe(pose, rng, world: World = ROOM, **known) -> Observation:
    return Observation(scan(pose, rng, world), ANGLES, SCANNER.range_max, **known)


def errors(posterior: Posterior, pose) -> tuple[float, float]:
    off = se2.between(np.asarray(pose, float), posterior.pose)
    return float(np.hypot(off[0], off[1])), float(abs(np.degrees(off[2])))


def drive(steps: int) -> np.ndarray:
    """Poses (steps, 3) at 15 Hz on a curve through the south of the room, at up to 1 m/s and 1 rad/s."""
    t = np.arange(steps) / 15
    return np.column_stack([3 + 2.2 * np.sin(0.45 * t), 1.4 + 0.4 * np.sin(0.9 * t), se2.wrap(np.sin(t) * 1.0)])


def follow(found: ParticleFilter, path: np.ndarray, rng, known) -> tuple[np.ndarray, list[Posterior]]:
    found.restart(path[0], CERTAIN)
    posteriors = [found.update(observe(p, rng, stamp=i / 15, **known(i))) for i, p in enumerate(path)]
    return np.array([errors(q, p) for q, p in zip(posteriors, path, strict=True)]), posteriors


def test_found_from_nothing_known_and_the_posterior_is_whole():
    rng, right = np.random.default_rng(0), 0
    found = make(0)
    for x, y in ROOM.sample_free(8, rng, 0.3):
        truth = np.array([x, y, rng.uniform(-np.pi, np.pi)])
        found.restart()
        for _ in range(12):
            posterior = found.update(observe(truth, rng))
        position, heading = errors(posterior, truth)
        right += position < 0.2 and heading < 5 and posterior.state == "tracking"
    assert right >= 7
    assert sum(h.weight for h in posterior.hypotheses) == pytest.approx(1.0)
    assert np.linalg.eigvalsh(posterior.covariance).min() > 0
    assert np.allclose(posterior.predicted, ROOM.ray_distances(se2.compose(posterior.pose, SCANNER.mount), ANGLES)[0])
    assert posterior.free_energy == posterior.accuracy < 0  # the density of narrow beams exceeds 1/m


@pytest.mark.parametrize(
    ("known", "limit"),
    [("nothing", 0.020), ("odometry", 0.008), ("command", 0.012)],
)
def test_a_moving_robot_is_tracked(known, limit):
    rng, path = np.random.default_rng(1), drive(150)
    # Odometry has its own frame; commands are those between two poses.
    odom = se2.compose(np.array([5.0, -2.0, 1.0]), path)
    twist = se2.between(path[:-1], path[1:]) * 15
    given = {
        "nothing": lambda i: {},
        "odometry": lambda i: {"odom": odom[i]},
        "command": lambda i: {"command": twist[max(i - 1, 0)]},
    }[known]
    off, posteriors = follow(make(2), path, rng, given)
    assert np.median(off[15:, 0]) < limit
    assert off[15:, 0].max() < 0.15
    assert {p.state for p in posteriors[15:]} == {"tracking"}


def test_differential_odometry_tracks_a_differential_robot():
    path = np.zeros((120, 3))
    path[0] = [3.0, 0.8, 0.0]
    for i in range(1, len(path)):
        forward = 0.05 if i < 60 else -0.004  # ahead, then slowly back
        path[i] = se2.compose(path[i - 1], np.array([forward, 0.0, 0.05 if i < 60 else 0.0]))
    settings = dataclasses.replace(SMALL, robot_model_type="differential")
    off, _ = follow(make(3, settings), path, np.random.default_rng(3), lambda i: {"odom": path[i]})
    assert np.median(off[15:, 0]) < 0.008
    assert off[15:, 0].max() < 0.1


def test_standing_still_is_millimetres():
    rng, truth = np.random.default_rng(4), np.array([3.0, 1.5, 0.4])
    found = make(4)
    found.restart(truth + np.array([0.1, -0.1, 0.05]), CERTAIN)
    posteriors = [found.update(observe(truth, rng, odom=np.zeros(3))) for _ in range(40)]
    assert np.median([errors(p, truth)[0] for p in posteriors[20:]]) < 0.004


def test_kidnapped_is_noticed_and_recovered():
    rng, first, second = np.random.default_rng(5), np.array([1.0, 1.0, 0.3]), np.array([5.0, 1.2, 2.0])
    found = make(5, dataclasses.replace(SMALL, keep_initial_pose=False))
    found.restart(first, CERTAIN)
    assert [found.update(observe(first, rng)).state for _ in range(15)][-1] == "tracking"
    after = [found.update(observe(second, rng)) for _ in range(40)]
    assert "lost" in {p.state for p in after[:5]}
    assert after[-1].state == "tracking"
    assert errors(after[-1], second)[0] < 0.1


def test_without_recovery_a_kidnapped_filter_stays_lost():
    """Shows that the random particles find the robot in the test above."""
    settings = dataclasses.replace(SMALL, recovery_alpha_slow=0.0, recovery_alpha_fast=0.0, keep_initial_pose=False)
    rng, first, second = np.random.default_rng(5), np.array([1.0, 1.0, 0.3]), np.array([5.0, 1.2, 2.0])
    found = make(5, settings)
    found.restart(first, CERTAIN)
    for _ in range(15):
        found.update(observe(first, rng, odom=np.zeros(3)))
    after = [found.update(observe(second, rng, odom=np.zeros(3))) for _ in range(40)]
    assert after[-1].state == "lost"
    assert errors(after[-1], second)[0] > 0.5


def test_initial_pose_is_kept_in_an_unmapped_room():
    """With odometry, scans that fit nowhere must not start a search."""
    unmapped = World(name="unmapped", boundary=[(0, 0), (6, 0), (6, 2.4), (0, 2.4)])
    odom, path = np.random.default_rng(12), drive(60)
    found = make(12)
    found.restart(path[0], CERTAIN)
    worst = 0.0
    for i, pose in enumerate(path):
        seen = observe(pose, odom, ROOM if i < 20 else unmapped, stamp=i / 15, odom=pose)
        worst = max(worst, errors(found.update(seen), pose)[0])
    assert worst < 0.5


@pytest.mark.parametrize("period", [1 / 15, 1.0])
def test_scanner_rate_does_not_spread_the_particles(period):
    """The belief about a standing robot with odometry does not move, however low the scan rate."""
    rng, truth = np.random.default_rng(13), np.array([3.0, 1.5, 0.4])
    found = make(13)
    found.restart(truth, CERTAIN)
    seen = [found.update(observe(truth, rng, stamp=i * period, odom=np.zeros(3))) for i in range(15)]
    assert max(errors(p, truth)[0] for p in seen) < 0.1
    assert {p.state for p in seen[10:]} == {"tracking"}


def test_two_identical_places_are_both_kept():
    """An empty rectangle looks the same when turned by pi."""
    bare = World(name="bare", boundary=[(0, 0), (6, 0), (6, 4), (0, 4)])
    rng, truth = np.random.default_rng(6), np.array([2.0, 1.2, 0.5])
    found = make(6, dataclasses.replace(SMALL, min_particles=2000), bare)
    posteriors = [found.update(observe(truth, rng, bare)) for _ in range(8)]
    twin = np.array([4.0, 2.8, 0.5 - np.pi])
    best = posteriors[-1].hypotheses[:2]
    assert posteriors[-1].state == "ambiguous"
    for place in (truth, twin):
        assert min(np.hypot(*(h.pose - place)[:2]) for h in best) < 0.1


@pytest.mark.parametrize("settings", [SMALL, Settings()], ids=["tuned", "nav2"])
def test_same_seed_same_bytes(settings):
    def run(seed):
        rng, found = np.random.default_rng(7), make(seed, settings)
        seen = [found.update(observe((3.0, 1.5, 0.4), rng)) for _ in range(4)]
        return b"".join(p.pose.tobytes() + p.covariance.tobytes() for p in seen) + found.particles.tobytes()

    assert run(1) == run(1) != run(2)


def test_the_beam_model_tracks_too():
    settings = dataclasses.replace(
        SMALL,
        laser_model_type="beam",
        max_beams=30,
        z_hit=0.85,
        z_short=0.05,
        z_max=0.05,
        z_rand=0.05,
        min_particles=200,
        max_particles=500,
    )
    off, _ = follow(make(8, settings), drive(30), np.random.default_rng(8), lambda i: {})
    assert np.median(off[5:, 0]) < 0.05


def test_xi_is_minus_the_gradient_of_accuracy():
    rng, truth = np.random.default_rng(9), np.array([3.0, 1.5, 0.4])
    found = make(9)
    observation = observe(truth, rng)
    pose = truth + np.array([0.03, -0.02, 0.01])
    _, xi, curvature, fit = found.sensor.explain(pose, found.mount, observation)
    assert 0.8 < fit < 1
    for axis, h in enumerate((0.01, 0.01, 0.002)):
        step = h * np.eye(3)[axis]
        high, low = (found.sensor.explain(pose + s * step, found.mount, observation)[0] for s in (1, -1))
        assert xi[axis] == pytest.approx(-(high - low) / (2 * h), rel=0.05, abs=5)
    assert np.linalg.eigvalsh(curvature).min() > 0
    assert np.linalg.norm(xi) > 50  # else the comparison would prove nothing


def test_scans_that_say_nothing_change_nothing_but_the_spread():
    found = make(10)
    found.restart(np.array([3.0, 1.5, 0.4]), CERTAIN)
    blind = Observation(np.full(len(ANGLES), np.inf), ANGLES, SCANNER.range_max)
    spread = [np.trace(found.update(blind).covariance) for _ in range(5)]
    assert np.all(np.isfinite(spread))
    assert spread[-1] > spread[0]


def test_restart_forgets():
    rng, truth = np.random.default_rng(11), np.array([3.0, 1.5, 0.4])
    found = make(11)
    found.restart(truth, CERTAIN)
    for _ in range(15):
        state = found.update(observe(truth, rng)).state
    assert state == "tracking"
    found.restart()
    assert len(found.particles) == SMALL.max_particles
    assert found.update(observe(truth, rng)).state != "tracking"
