"""The particle filter as a whole: global localisation, tracking, kidnapping, repeatability."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from services.estimator.particle_filter import ParticleFilter, ParticleFilterSettings
from services.estimator.particle_filter.fit_averages import FitAverages
from services.estimator.shared.interface import Observation, Posterior
from tests.estimator.models import ROOM, SCANNER

ANGLES = SCANNER.angles()
SMALL = replace(ParticleFilterSettings.tuned(), max_particles=5000)
CERTAIN = np.diag([0.01, 0.01, 0.0025])
HERE = np.array([3.0, 1.5, 0.4])


def make(seed: int, settings: ParticleFilterSettings = SMALL, world: World = ROOM, start=None) -> ParticleFilter:
    found = ParticleFilter(world, settings, SCANNER.mount, seed)
    if start is not None:
        found.restart(start, CERTAIN)
    return found


def observe(pose, rng, world: World = ROOM, **known) -> Observation:
    exact = world.ray_distances(se2.compose(pose, SCANNER.mount), ANGLES)[0]
    return Observation(
        SCANNER.limit(exact + 0.02 * rng.standard_normal(len(exact))), ANGLES, SCANNER.range_max, **known
    )


def distance(posterior: Posterior, pose) -> float:
    return float(np.hypot(*(posterior.pose - pose)[:2]))


def drive(steps: int) -> np.ndarray:
    """Poses (steps, 3) at 15 Hz on a curve through the south of the room, at up to 1 m/s and 1 rad/s."""
    t = np.arange(steps) / 15
    return np.column_stack([3 + 2.2 * np.sin(0.45 * t), 1.4 + 0.4 * np.sin(0.9 * t), se2.wrap(np.sin(t) * 1.0)])


def follow(
    settings: ParticleFilterSettings, path: np.ndarray, seed: int, **known
) -> tuple[np.ndarray, list[Posterior]]:
    """Position errors and posteriors along a path from a known start; ``known`` are values by scan."""
    rng, found = np.random.default_rng(seed), make(seed, settings, start=path[0])
    posteriors = [
        found.update(observe(pose, rng, stamp=k / 15, **{name: values[k] for name, values in known.items()}))
        for k, pose in enumerate(path)
    ]
    return np.array([distance(a, b) for a, b in zip(posteriors, path, strict=True)]), posteriors


def test_global_localisation():
    rng, right, found = np.random.default_rng(0), 0, make(0)
    for x, y in ROOM.sample_free(5, rng, 0.3):
        truth = np.array([x, y, rng.uniform(-np.pi, np.pi)])
        found.restart()
        for _ in range(12):
            posterior = found.update(observe(truth, rng))
        turned = abs(np.degrees(se2.wrap(posterior.pose[2] - truth[2])))
        right += distance(posterior, truth) < 0.2 and turned < 5 and posterior.state == "tracking"
    assert right >= 4
    assert sum(h.weight for h in posterior.hypotheses) == pytest.approx(1.0)
    assert np.linalg.eigvalsh(posterior.covariance).min() > 0
    assert np.allclose(posterior.predicted, ROOM.ray_distances(se2.compose(posterior.pose, SCANNER.mount), ANGLES)[0])
    assert posterior.free_energy == posterior.accuracy < 0  # the density of narrow beams exceeds 1/m


PATH = drive(150)
TWIST = se2.between(PATH[:-1], PATH[1:]) * 15


@pytest.mark.parametrize(
    ("known", "limit"),
    [
        ({}, 0.020),
        ({"odom": se2.compose(np.array([5.0, -2.0, 1.0]), PATH)}, 0.008),  # odometry has its own frame
        ({"command": np.concatenate([TWIST[:1], TWIST])}, 0.012),
    ],
    ids=["nothing", "odometry", "command"],
)
def test_tracking(known, limit):
    errors, posteriors = follow(SMALL, PATH, 1, **known)
    assert np.median(errors[15:]) < limit
    assert errors[15:].max() < 0.15
    assert {p.state for p in posteriors[15:]} == {"tracking"}


def test_differential_odometry():
    path = np.zeros((120, 3))
    path[0] = [3.0, 0.8, 0.0]
    for k in range(1, len(path)):  # ahead on a curve, then slowly back
        path[k] = se2.compose(path[k - 1], np.array([0.05, 0.0, 0.05] if k < 60 else [-0.004, 0.0, 0.0]))
    errors, _ = follow(replace(SMALL, robot_model_type="differential"), path, 3, odom=path)
    assert np.median(errors[15:]) < 0.008
    assert errors[15:].max() < 0.1


def test_beam_model():
    shares = {"z_hit": 0.85, "z_short": 0.05, "z_max": 0.05, "z_rand": 0.05}
    settings = replace(SMALL, laser_model_type="beam", max_beams=30, min_particles=200, max_particles=500, **shares)
    errors, _ = follow(settings, drive(30), 8)
    assert np.median(errors[5:]) < 0.05


@pytest.mark.parametrize("recovers", [True, False])
def test_kidnapping(recovers):
    settings = replace(SMALL, keep_initial_pose=False)
    if not recovers:
        settings = replace(settings, recovery_alpha_slow=0.0, recovery_alpha_fast=0.0)
    rng, first, second = np.random.default_rng(5), np.array([1.0, 1.0, 0.3]), np.array([5.0, 1.2, 2.0])
    found, known = make(5, settings, start=first), {} if recovers else {"odom": np.zeros(3)}
    assert [found.update(observe(first, rng, **known)).state for _ in range(15)][-1] == "tracking"
    after = [found.update(observe(second, rng, **known)) for _ in range(40)]
    assert "lost" in {p.state for p in after[:5]}
    assert after[-1].state == ("tracking" if recovers else "lost")
    assert (distance(after[-1], second) < 0.1) == recovers


def test_unmapped_room():
    """With odometry and a given pose, scans that fit nowhere must not start a search."""
    unmapped = World(name="unmapped", boundary=[(0, 0), (6, 0), (6, 2.4), (0, 2.4)])
    rng, path = np.random.default_rng(12), drive(60)
    found = make(12, start=path[0])
    for k, pose in enumerate(path):
        posterior = found.update(observe(pose, rng, ROOM if k < 20 else unmapped, stamp=k / 15, odom=pose))
        assert distance(posterior, pose) < 0.5


@pytest.mark.parametrize("period", [1 / 15, 1.0])
def test_standing_still(period):
    """However low the scan rate is, the particles do not spread."""
    rng, found = np.random.default_rng(13), make(13, start=HERE)
    seen = [found.update(observe(HERE, rng, stamp=k * period, odom=np.zeros(3))) for k in range(40)]
    errors = [distance(p, HERE) for p in seen]
    assert max(errors) < 0.1
    assert np.median(errors[20:]) < 0.004
    assert {p.state for p in seen[10:]} == {"tracking"}


def test_two_identical_places():
    """An empty rectangle looks the same when turned by pi."""
    bare = World(name="bare", boundary=[(0, 0), (6, 0), (6, 4), (0, 4)])
    rng, truth = np.random.default_rng(6), np.array([2.0, 1.2, 0.5])
    found = make(6, replace(SMALL, min_particles=2000), bare)
    posterior = [found.update(observe(truth, rng, bare)) for _ in range(8)][-1]
    assert posterior.state == "ambiguous"
    for place in (truth, np.array([4.0, 2.8, 0.5 - np.pi])):
        assert min(np.hypot(*(h.pose - place)[:2]) for h in posterior.hypotheses[:2]) < 0.1


@pytest.mark.parametrize("settings", [SMALL, ParticleFilterSettings()], ids=["tuned", "nav2"])
def test_seed(settings):
    def run(seed):
        rng, found = np.random.default_rng(7), make(seed, settings)
        seen = [found.update(observe(HERE, rng)) for _ in range(2)]
        return b"".join(p.pose.tobytes() + p.covariance.tobytes() for p in seen) + found.particles.tobytes()

    assert run(1) == run(1) != run(2)


def test_gradient():
    found, observation = make(9), observe(HERE, np.random.default_rng(9))
    pose = HERE + np.array([0.03, -0.02, 0.01])
    _, xi, curvature, fit = found.sensor.explain(pose, found.mount, observation)
    assert 0.8 < fit < 1
    for axis, h in enumerate((0.01, 0.01, 0.002)):
        step = h * np.eye(3)[axis]
        high, low = (found.sensor.explain(pose + s * step, found.mount, observation)[0] for s in (1, -1))
        assert xi[axis] == pytest.approx(-(high - low) / (2 * h), rel=0.05, abs=5)
    assert np.linalg.eigvalsh(curvature).min() > 0
    assert np.linalg.norm(xi) > 50  # else the comparison would prove nothing


def test_scans_without_returns():
    found = make(10, start=HERE)
    empty = Observation(np.full(len(ANGLES), np.inf), ANGLES, SCANNER.range_max)
    spread = [np.trace(found.update(empty).covariance) for _ in range(5)]
    assert np.all(np.isfinite(spread))
    assert spread[-1] > spread[0]
    assert found._fit_for_state == FitAverages(0.01, 0.5)  # how well scans fit is not learned from them


def test_restart():
    rng, found = np.random.default_rng(11), make(11, start=HERE)
    assert [found.update(observe(HERE, rng)).state for _ in range(15)][-1] == "tracking"
    found.restart()
    assert len(found.particles) == SMALL.max_particles
    assert found.update(observe(HERE, rng)).state != "tracking"
