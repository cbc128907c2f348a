"""People around the scanner: beams that they block do not contradict the pose, a wrong pose does."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import World, load_world
from services.estimator.precise import obstruction
from services.estimator.precise.gauss_newton import View
from services.estimator.precise.likelihood import Likelihood
from services.estimator.shared.generative_models import Expected, RayCaster
from tests.estimator.precise.test_estimator import ROOM, estimator

RNG = np.random.default_rng(5)


def crowd(clean, share, first=0):
    """Ranges (B,) of which ``share``, from beam ``first`` on, is blocked at a distance of at most a metre."""
    ranges = clean.copy()
    hidden = (first + np.arange(int(share * len(clean)))) % len(clean)
    ranges[hidden] = np.minimum(ranges[hidden], RNG.uniform(0.5, 1.0, len(hidden)))
    return ranges


def view_of(made, scene, ranges):
    return View(made.model, Likelihood(), made.mount, scene.scanner.angles(), ranges, scene.scanner.range_max)


def expected_at(view, pose):
    return view.model.expect(np.array([[*pose]]), view.angles)


def test_contradicting_beams():
    made, scene = estimator(ROOM)
    made.mount = np.zeros(3)
    here, there = np.array([2.5, 2.0, 0.3]), np.array([5.0, 3.0, -1.0])
    clean = RayCaster(ROOM).expect(here[None], scene.scanner.angles()).ranges[0]
    view = view_of(made, scene, crowd(clean, 0.7) + RNG.normal(0, 0.02, len(clean)))
    assert obstruction.contradicting_ratio(view, expected_at(view, here)) < 0.01
    whole = view_of(made, scene, clean)
    assert obstruction.contradicting_ratio(whole, expected_at(whole, there)) > 0.2


def test_no_return_expected():
    made, scene = estimator(ROOM)
    count = len(scene.scanner.angles())
    nothing = Expected(np.full((1, count), np.inf), np.full((1, count), 0.01), np.zeros((1, count, 3)))
    for measured in (np.inf, 2.0, -np.inf):
        view = view_of(made, scene, np.full(count, measured))
        assert obstruction.is_only_blocked(view, nothing, 0.02)
        assert obstruction.behind_ratio(view, nothing) == obstruction.contradicting_ratio(view, nothing) == 0
    unknown = Expected(nothing.ranges, np.full((1, count), np.inf), nothing.jacobian)
    assert not obstruction.is_only_blocked(view_of(made, scene, np.full(count, np.inf)), unknown, 0.02)


def test_constraining_beams():
    hall = World(name="hall", boundary=[(0, 0), (20, 0), (20, 2), (0, 2)])
    made, scene = estimator(hall, 361)
    made.mount = np.zeros(3)
    pose = np.array([10.0, 1.0, 0.0])
    clean = RayCaster(hall).expect(pose[None], scene.scanner.angles()).ranges[0]
    along, across = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    ends = np.flatnonzero(np.abs(np.sin(scene.scanner.angles())) * clean < 0.99)  # beams that reach the wall at x = 20
    view = view_of(made, scene, clean)
    assert obstruction.constraining_beams(view, pose, along) == pytest.approx(len(ends), rel=0.1)
    assert obstruction.constraining_beams(view, pose, across) > 10 * len(ends)
    hidden = clean.copy()
    hidden[ends] = 0.8
    assert obstruction.constraining_beams(view_of(made, scene, hidden), pose, along) < 0.1


def test_crowd_and_kidnapping():
    made, scene = estimator(load_world("maze"))
    here, there = scene.poses(2)
    made.restart(here, np.diag([1e-4, 1e-4, 1e-4]))
    searches = []
    search = made._search
    made._search = lambda view: searches.append(1) or search(view)
    clean = scene.clean(here[None])[0]
    for k in range(45):
        share = min(0.75, 0.05 * k)
        posterior = made.update(scene.observe(crowd(clean, share, 3 * k), k / 15))
        assert posterior.state == "tracking", k
        assert np.hypot(*(posterior.pose - here)[:2]) < 0.03, k
    assert len(searches) < 20
    posterior = made.update(scene.observe(scene.clean(there[None])[0], 3.0))
    assert np.hypot(*(posterior.pose - there)[:2]) < 0.02
