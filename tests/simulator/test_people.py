"""Walking people without physics: distances, waiting, and progress."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry.world import Obstacle, World
from common.robot.robot import Robot
from services.simulator.people import (
    LOOK_AHEAD_M,
    MIN_START_DISTANCE_M,
    PERSON_GAP_M,
    PERSON_RADIUS_M,
    ROBOT_GAP_M,
    People,
)
from services.simulator.walkable_grid import WalkableGrid
from tests.simulator.driving import ALLEY, shipped

PERIOD = 1 / 15  # s
ROBOT = Robot().radius
PERSON_DISTANCE, ROBOT_DISTANCE = 2 * PERSON_RADIUS_M + PERSON_GAP_M, PERSON_RADIUS_M + ROBOT + ROBOT_GAP_M
HALL = World(name="hall", boundary=[(0, 0), (12, 0), (12, 8), (0, 8)])
CORNER, OFFICE_START, ALLEY_START = np.array([0.5, 0.5]), np.array([1.5, 4.0]), np.array([0.45, 0.45])


def crowd(world: World, count: int, robot, seed: int = 0, speed: float = 1.0) -> People:
    return People(world, count, speed, np.random.default_rng(seed), np.asarray(robot, float), ROBOT)


def walk(people: People, seconds: float, robot):
    """Places (T, K, 2) m, including the first ones."""
    places = [people.places.copy()]
    for _ in range(int(seconds / PERIOD)):
        people.step(PERIOD, np.asarray(robot, float), np.zeros(2))
        places.append(people.places.copy())
    return np.array(places)


def moving(places):
    """Whether each person moves in each step (T - 1, K)."""
    return np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0)) > 1e-9


def least_gap(places):
    """Least distance in m between the centres of two people."""
    a, b = np.triu_indices(places.shape[1], 1)
    return np.hypot(*np.moveaxis(places[:, a] - places[:, b], -1, 0)).min()


def longest_stand(moves):
    """Longest run of False in ``moves`` (T,), in s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[1], moves.astype(int), [1]])))
    return float(np.diff(edges)[::2].max(initial=0)) * PERIOD


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1), speed=st.sampled_from([0.3, 1.0, 3.0]))
def test_people_touch_nothing(name, seed, speed):
    world = shipped(name)
    robot = world.sample_free(1, np.random.default_rng(seed), ROBOT)[0]
    places = walk(crowd(world, 8, robot, seed, speed), 15, robot)
    assert np.hypot(*(places[0] - robot).T).min() >= MIN_START_DISTANCE_M
    assert world.clearance(places.reshape(-1, 2)).min() >= PERSON_RADIUS_M
    assert least_gap(places) >= PERSON_DISTANCE - 1e-9
    assert np.hypot(*(places.reshape(-1, 2) - robot).T).min() >= ROBOT_DISTANCE - 1e-9
    steps = np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0))
    assert steps.max() <= speed * PERIOD + 1e-9


def test_one_person_walks_at_the_given_speed():
    places = walk(crowd(HALL, 1, CORNER, seed=1, speed=0.8), 120, CORNER)[:, 0]
    # Slightly less, because corners are cut within a step, and the person stops for the robot.
    assert np.hypot(*np.diff(places, axis=0).T).sum() == pytest.approx(0.8 * 120, rel=0.05)
    assert np.ptp(places, axis=0).min() > 4


def test_doors_of_the_office():
    people = crowd(shipped("office"), 10, OFFICE_START, seed=2)
    places = walk(people, 180, OFFICE_START)
    for door in ((2.2, 2.97), (7.6, 2.97), (13.35, 2.97), (4.4, 4.97), (11.45, 4.97)):
        assert np.hypot(*(places - np.array(door)).reshape(-1, 2).T).min() < 0.5, door
    moves = moving(places)
    assert longest_stand(moves.any(axis=1)) < 1.0
    assert moves.mean() > 0.5
    assert max(map(longest_stand, moves.T)) < 20.0


def test_people_in_an_alley():
    places = walk(crowd(ALLEY, 2, ALLEY_START), 150, ALLEY_START)
    assert len(np.unique(np.sign(places[:, 0, 0] - places[:, 1, 0]))) == 1
    assert least_gap(places) == pytest.approx(PERSON_DISTANCE, abs=PERIOD)  # they did meet
    assert max(map(longest_stand, moving(places).T)) < 20.0


def test_person_before_a_standing_robot():
    robot = np.array([8.0, 0.45])
    places = walk(crowd(ALLEY, 1, robot, seed=3), 150, robot)
    gap = np.abs(places[:, 0, 0] - 8.0) - PERSON_RADIUS_M - ROBOT
    assert gap.min() == pytest.approx(LOOK_AHEAD_M + ROBOT_GAP_M, abs=PERIOD + 0.02)
    moves = moving(places)[:, 0]
    assert 1.0 < longest_stand(moves) < 20.0
    assert (gap[:-1][~moves] < 0.6).all()
    assert gap[int(np.argmin(gap)) :].max() > 2.0


def test_people_walk_around_a_standing_robot():
    robot = np.array([6.0, 4.0])
    sides = np.sign(walk(crowd(HALL, 6, robot, seed=5), 120, robot)[..., 0] - 6.0)
    assert (np.diff(sides, axis=0) != 0).any(axis=0).all()


def test_people_keep_out_of_the_way():
    """People within the braking distance of a robot at 1 m/s do not step into its way, or closer if they are in it.

    The simulated robot does not brake. People it would have run over are ignored from then on.
    """
    rng, brakes, met = np.random.default_rng(0), PERSON_RADIUS_M + ROBOT + 0.65, 0
    for seed in range(5):
        people = crowd(shipped("office"), 10, (1.0, 4.0), seed)
        walk(people, rng.uniform(0, 10), (1.0, 4.0))
        for step in range(int(14 / PERIOD)):
            robot, before = np.array([1.0 + step * PERIOD, 4.0]), people.places.copy()
            people.step(PERIOD, robot, np.array([1.0, 0.0]))
            (was_along, was_aside), (along, aside) = (before - robot).T, (people.places - robot).T
            close = (along > 0) & (along < brakes)
            in_way = close & (np.abs(aside) < PERSON_RADIUS_M + ROBOT)
            came_in = in_way & (np.abs(was_aside) >= PERSON_RADIUS_M + ROBOT)
            came_near = in_way & (np.hypot(along, aside) < np.hypot(was_along, was_aside) - 1e-9)
            assert not (came_in | came_near).any(), (seed, step)
            met += int(close.sum())
    assert met > 50


def test_only_people_in_the_way_are_moved():
    people = crowd(HALL, 5, CORNER, seed=1)
    walk(people, 5, CORNER)
    before = people.places.copy()
    people.make_room(before[2])
    assert np.hypot(*(people.places[2] - before[2])) >= MIN_START_DISTANCE_M
    assert np.array_equal(np.delete(people.places, 2, 0), np.delete(before, 2, 0))

    before = people.places.copy()
    world = HALL.with_obstacles([Obstacle(name="box", box={"center": tuple(before[4]), "size": (0.6, 0.6)})])
    people.make_room(CORNER, world)
    assert not np.array_equal(people.places[4], before[4])
    assert world.clearance(walk(people, 30, CORNER).reshape(-1, 2)).min() >= PERSON_RADIUS_M


def test_no_room_for_people():
    with pytest.raises(UserError, match=r"world 'alley' has room for \d+ people, .* not for 60: ask for fewer"):
        crowd(ALLEY, 60, (8.0, 0.45))
    people = crowd(ALLEY, 1, ALLEY_START)
    before = people.places.copy()
    full = ALLEY.with_obstacles([Obstacle(name="full", box={"center": (9, 0.45), "size": (14, 0.6)})])
    with pytest.raises(UserError, match="ask for fewer"):
        people.make_room(ALLEY_START, full)
    assert np.array_equal(people.places, before)


def test_world_too_narrow_for_people():
    grid = WalkableGrid(World(name="slit", boundary=[(0, 0), (9, 0), (9, 0.5), (0, 0.5)]), PERSON_RADIUS_M)
    assert len(grid.nodes) == len(grid.start_nodes) == 0
    assert not grid.can_start(np.array([4.0, 0.25]))


def test_clearance_of_paths():
    world, rng, paths = shipped("maze"), np.random.default_rng(0), []
    grid, blocked = WalkableGrid(world, PERSON_RADIUS_M), np.array([[2.5, 3.5, 0.6], [7.5, 5.5, 0.6], [9.0, 2.5, 0.6]])
    for place in grid.nodes[rng.permutation(grid.start_nodes)[:40]]:
        if (path := grid.random_path(place, rng, blocked)) is None:
            continue
        paths.append(path)
        assert np.array_equal(path[0], place)
        fine = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(path)])
        assert world.clearance(fine).min() >= PERSON_RADIUS_M + 0.04
        nearest = np.hypot(*np.moveaxis(fine[:, None] - blocked[:, :2], -1, 0)).min(axis=0)
        gaps = np.hypot(*(blocked[:, :2] - place).T)
        assert (nearest >= np.minimum(blocked[:, 2], gaps) - 0.03).all()
    assert len(paths) > 25
