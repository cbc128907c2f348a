"""Scan matching along a corridor: what is information about the place along it, and what is not."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import World
from lab.accuracy.scenes import Scene
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.surface_points import SurfacePoints, place_points
from services.estimator.shared.generative_models import RayCaster

CORRIDOR = [(0, 0), (60, 0), (60, 2), (0, 2)]  # longer than the scanner sees
HERE = np.array([30.0, 1.0, 0.3])
PRIOR = MotionCandidate(HERE, np.diag([0.2, 0.2, 0.3]) ** 2, 1.0)
UNKNOWN = np.diag([1.0, 1.0, 0.1])  # covariance of the pose without a match


def view(*obstacles, seed=1):
    """A scan of the corridor at HERE."""
    scene = Scene.of(World(name="corridor", boundary=CORRIDOR, obstacles=list(obstacles)), 622, seed)
    seen = scene.observe(scene.clean(HERE[None])[0], 0.0)
    mount = np.array(scene.scanner.mount)
    return ScanLikelihood(RayCaster(scene.world), Likelihood(), mount, seen.angles, seen.ranges, seen.range_max)


def person(x, y=1.0):
    return {"circle": {"center": (x, y), "radius": 0.25}}


def covariance(match):
    """The covariance of a match, if each surface which the map lacks moves with probability 0.2."""
    return match.covariance(UNKNOWN, match.moved_probability(0.2, 0.0))


def points_of(scan):
    points = place_points(scan, HERE)
    on_wall = (points[:, 1] < 0.1) | (points[:, 1] > 1.9)
    return SurfacePoints.of(points, on_wall)


@pytest.mark.parametrize(("count", "from_wall"), [(4, 0.3), (8, 0.2)])
def test_tilted_lines_are_no_information(count, from_wall):
    """Lines through points of a wall and of people beside it are tilted, as if the wall showed the place along it."""
    people = [person(28.6 + 0.7 * k, (from_wall, 2 - from_wall)[k % 2]) for k in range(count)]
    match = points_of(view(*people)).match(HERE, view(seed=2), PRIOR)  # the people have gone
    assert np.sqrt(match.information[0, 0]) > 50  # a deviation of 2 cm at most, if the lines were exact
    deviation = np.sqrt(np.diag(covariance(match)))
    assert deviation[0] > 0.5
    assert deviation[1] < 0.05


def test_column_of_the_map_shows_the_place():
    before = view(person(31.5))
    everything = SurfacePoints.of(place_points(before, HERE), np.ones(len(before.points), np.bool_))
    match = everything.match(HERE, view(person(31.5), seed=2), PRIOR)
    assert not match.degenerate
    assert match.movable_surfaces == 0
    assert np.sqrt(np.diag(covariance(match)))[0] < 0.02


@pytest.mark.parametrize("step", [-0.15, 0.1, 0.2])
def test_person_who_walks_along_a_corridor(step):
    """The match follows the person, but the covariance allows for it."""
    match = points_of(view(person(31.5))).match(HERE, view(person(31.5 + step), seed=2), PRIOR)
    error = match.pose[0] - HERE[0]
    assert abs(error) > 0.7 * abs(step)
    assert match.movable_surfaces == 1
    deviation = np.sqrt(np.diag(covariance(match)))
    assert 2 * deviation[0] > abs(error)
    assert deviation[1] < 0.02
    assert deviation[2] < 0.02


def test_two_people_move_alike_less_often_than_one():
    one, two = (
        points_of(view(*people)).match(HERE, view(*people, seed=2), PRIOR)
        for people in ([person(31.5)], [person(31.5, 0.6), person(32.6, 1.4)])
    )
    assert (one.movable_surfaces, two.movable_surfaces) == (1, 2)
    assert covariance(two)[0, 0] < 0.3 * covariance(one)[0, 0]
    moved = 0.2**2
    assert two.moved_probability(0.2, 0.0) == pytest.approx(moved)
    assert two.moved_probability(0.2, -1000.0) == 0
    # A motion of the robot that is as improbable as that makes both equally probable.
    assert two.moved_probability(0.2, np.log(1 / moved - 1)) == pytest.approx(0.5)
    assert covariance(two) - (1 - moved) * np.linalg.inv(two.information) == pytest.approx(
        moved
        * (np.linalg.inv(two.fixed_information + np.linalg.inv(UNKNOWN)) + np.outer(two.fixed_step, two.fixed_step)),
        rel=1e-3,
        abs=1e-7,
    )


def test_fixed_surfaces_that_contradict_widen_the_covariance():
    """A column of the map shows that the robot stands; the person beside it walks."""
    before, after = view(person(31.5, 0.6), person(28.6, 1.4)), view(person(31.65, 0.6), person(28.6, 1.4), seed=2)
    points = place_points(before, HERE)
    is_person = np.hypot(*(points - (31.5, 0.6)).T) < 0.3
    match = SurfacePoints.of(points, ~is_person).match(HERE, after, PRIOR)
    error = match.pose[0] - HERE[0]
    assert 3 * np.sqrt(covariance(match)[0, 0]) > abs(error)
