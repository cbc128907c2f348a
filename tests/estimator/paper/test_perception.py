"""The descent of preset `paper`, on the exact ray caster and on the shipped weights."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from services.estimator.paper import weights
from services.estimator.paper.perception import Descent, PaperPerception
from services.estimator.shared.model_folder import SHIPPED
from tests.estimator.models import HEADING, ROOM, ExactModel


def estimator(pose, **settings) -> PaperPerception:
    return PaperPerception(ExactModel(ROOM), 0.02, ROOM.bounds, np.array([*pose, HEADING]), Descent(**settings))


def scan(pose, rng) -> np.ndarray:
    exact = ExactModel(ROOM).ranges(np.array([[*pose, HEADING]]))[0]
    return exact + 0.02 * rng.standard_normal(len(exact))


def test_descent_and_state():
    rng, truth = np.random.default_rng(0), (3.0, 1.5)
    found = estimator((3.15, 1.4), alpha=2e-3, iterations=1)
    estimates = [found.update(scan(truth, rng)) for _ in range(60)]
    assert np.hypot(*(estimates[-1].pose[:2] - truth)) < 0.01
    assert estimates[-1].free_energy.accuracy < estimates[0].free_energy.accuracy
    assert [e.state for e in estimates[:3]] == ["localising"] * 3
    assert estimates[-1].state == "tracking"


def test_lost():
    rng = np.random.default_rng(1)
    found = estimator((3.0, 1.5), alpha=2e-3, iterations=1)
    for _ in range(30):
        state = found.update(scan((3.0, 1.5), rng)).state
    assert state == "tracking"
    found.settings = Descent(alpha=1e-9)  # too slow to follow
    states = [found.update(scan((5.0, 0.8), rng)).state for _ in range(20)]
    assert "lost" in states


def test_bounds_and_steps():
    rng = np.random.default_rng(2)
    found = estimator((3.0, 1.5), alpha=0.5, max_step=0.3, iterations=1)
    before = found.pose.copy()
    for _ in range(20):
        pose = found.update(scan((5.2, 0.6), rng)).pose
        assert np.hypot(*(pose - before)[:2]) <= 0.3 + 1e-9
        assert 0 <= pose[0] <= 6
        assert 0 <= pose[1] <= 4
        before = pose


def test_goal_and_beta():
    rng, truth, goal = np.random.default_rng(3), (3.0, 1.5), np.array([3.4, 1.5, HEADING])
    plain, drawn = estimator(truth, alpha=1e-3, iterations=1), estimator(truth, alpha=1e-3, iterations=1, beta=0.5)
    for _ in range(40):
        o = scan(truth, rng)
        a, b = plain.update(o, goal), drawn.update(o, goal)
    assert np.hypot(*(a.pose[:2] - truth)) < 0.02
    assert np.hypot(*(b.pose - goal)[:2]) < np.hypot(*(a.pose - goal)[:2]) - 0.05
    assert b.free_energy.attraction > 0 == a.free_energy.attraction


def test_unmeasured_beams():
    rng, truth = np.random.default_rng(6), (3.0, 1.5)
    plain, masked, blind = (estimator((3.15, 1.4), alpha=2e-3, iterations=1) for _ in range(3))
    measured = rng.random(len(scan(truth, rng))) < 0.7
    for _ in range(60):
        o = scan(truth, rng)
        plain.update(np.where(measured, o, 0.0))
        found = masked.update(np.where(measured, o, 0.0), measured=measured)
        stays = blind.update(o * 0, measured=np.zeros(len(o), bool))
    assert found.state == "tracking"
    assert np.hypot(*(found.pose[:2] - truth)) < 0.01 < np.hypot(*(plain.pose[:2] - truth))
    assert stays.pose.tolist() == [3.15, 1.4, HEADING]
    assert (stays.state, stays.free_energy.accuracy) == ("localising", 0.0)


def test_known_start():
    rng = np.random.default_rng(5)
    found = estimator((1.0, 1.0), alpha=2e-3, iterations=1)
    found.restart(np.array([3.0, 1.5, HEADING]), known=True)
    assert found.update(scan((3.0, 1.5), rng)).state == "tracking"
    found.restart(np.array([1.0, 1.0, HEADING]), known=True)
    assert found.update(scan((5.0, 3.0), rng)).state == "lost"


@pytest.mark.parametrize("beams", [622, 811])
def test_shipped_weights(beams):
    """From the map's centre, 25 scans: most beliefs end within 1 m, the median within 0.25 m."""
    model, card = weights.load(weights.find(SHIPPED, "corridor", beams))
    world, rng = load_world("corridor"), np.random.default_rng(5)
    assert card.world == world, "the corridor changed after the weights were trained: train them again"
    errors = []
    for truth in world.sample_free(8, rng, 0.3):
        pose = np.array([*truth, card.heading])
        exact = world.ray_distances(se2.compose(pose, card.scanner.mount)[None], card.scanner.angles())[0]
        start = np.array([*world.center(), card.heading])
        found = PaperPerception(model, card.test_l1_mean, world.bounds, start, metric=model.norm.metric)
        for _ in range(25):
            found.update(exact + 0.02 * rng.standard_normal(beams))
        errors.append(np.hypot(*(found.pose - pose)[:2]))
    assert np.mean(np.array(errors) < 1.0) >= 0.7, errors
    assert np.median(errors) < 0.25, errors
