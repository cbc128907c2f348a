"""Walking people without physics: distances, waiting, and progress."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry.world import Obstacle, World, load_world
from common.robot.base import Robot
from services.simulator.people import (
    LOOK_AHEAD_M,
    MIN_START_DISTANCE_M,
    PERSON_GAP_M,
    PERSON_RADIUS_M,
    ROBOT_GAP_M,
    People,
)
from services.simulator.walkable_grid import WalkableGrid

PERIOD = 1 / 15  # s
ROBOT = Robot().radius
STANDING = np.zeros(2)
HALL = World(name="hall", boundary=[(0, 0), (12, 0), (12, 8), (0, 8)])
# Too narrow for two people to pass each other.
ALLEY = World(name="alley", boundary=[(0, 0), (16, 0), (16, 0.9), (0, 0.9)])
CORNER = np.array([0.5, 0.5])  # of the hall


@cache
def shipped(name: str) -> World:
    return load_world(name)


def crowd(world: World, count: int, seed: int = 0, speed: float = 1.0, robot=None) -> People:
    where = np.asarray(robot if robot is not None else world.start_pose(ROBOT)[:2], float)
    return People(world, count, speed, np.random.default_rng(seed), where, ROBOT)


def walk(people: People, seconds: float, robot, velocity=STANDING):
    """Places (T, K, 2) m, including the first ones."""
    places = [people.places.copy()]
    for _ in range(int(seconds / PERIOD)):
        people.step(PERIOD, np.asarray(robot, float), velocity)
        places.append(people.places.copy())
    return np.array(places)


def apart(places):
    """Least distance (T,) m between the centres of two people."""
    gaps = np.hypot(*np.moveaxis(places[:, :, None] - places[:, None], -1, 0))
    gaps[:, np.arange(places.shape[1]), np.arange(places.shape[1])] = np.inf
    return gaps.min(axis=(1, 2))


def longest_stand(moving):
    """Longest run of False in ``moving`` (T,), in s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[1], moving.astype(int), [1]])))
    return float(np.diff(edges)[::2].max(initial=0)) * PERIOD


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), speed=st.sampled_from([0.3, 1.0, 3.0]))
def test_people_never_touch_walls_each_other_or_the_robot(name, seed, speed):
    world = shipped(name)
    robot = world.sample_free(1, np.random.default_rng(seed), ROBOT)[0]
    people = crowd(world, 8, seed, speed, robot)
    assert np.hypot(*(people.places - robot).T).min() >= MIN_START_DISTANCE_M
    places = walk(people, 20, robot)
    assert world.clearance(places.reshape(-1, 2)).min() >= PERSON_RADIUS_M
    assert apart(places).min() >= 2 * PERSON_RADIUS_M + PERSON_GAP_M - 1e-9
    assert np.hypot(*(places.reshape(-1, 2) - robot).T).min() >= PERSON_RADIUS_M + ROBOT + ROBOT_GAP_M - 1e-9
    steps = np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0))
    assert steps.max() <= speed * PERIOD + 1e-9


def test_steps_depend_on_the_seed():
    first, second, other = (walk(crowd(shipped("office"), 6, seed), 20, (1.5, 4.0)) for seed in (3, 3, 4))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_one_person_walks_at_the_given_speed():
    places = walk(crowd(HALL, 1, seed=1, speed=0.8, robot=CORNER), 200, CORNER)[:, 0]
    gone = np.hypot(*np.diff(places, axis=0).T).sum()
    # Slightly less, because corners are cut within a step, and the person stops for the robot.
    assert gone == pytest.approx(0.8 * 200, rel=0.05)
    assert np.ptp(places, axis=0).min() > 5


def test_people_stand_at_speed_zero():
    places = walk(crowd(shipped("office"), 5, speed=0.0), 10, (1.5, 4.0))
    assert np.ptp(places, axis=0).max() == 0


def test_people_pass_every_door_of_the_office():
    places = walk(crowd(shipped("office"), 10, seed=2), 180, (1.5, 4.0)).reshape(-1, 2)
    for x, y in ((2.2, 2.97), (7.6, 2.97), (13.35, 2.97), (4.4, 4.97), (11.45, 4.97)):
        assert np.hypot(*(places - [x, y]).T).min() < 0.5, (x, y)


def test_ten_people_in_the_office_keep_moving():
    people = crowd(shipped("office"), 10, seed=0)
    places = walk(people, 240, (1.5, 4.0))
    moving = np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0)) > 1e-9
    assert longest_stand(moving.any(axis=1)) < 1.0
    assert moving.mean() > 0.5
    assert max(longest_stand(person) for person in moving.T) < 20.0


def test_two_people_turn_back_in_a_narrow_alley():
    robot = np.array([0.45, 0.45])
    places = walk(crowd(ALLEY, 2, seed=0, robot=robot), 300, robot)
    order = np.sign(places[:, 0, 0] - places[:, 1, 0])
    assert (order == order[0]).all()
    assert apart(places).min() == pytest.approx(2 * PERSON_RADIUS_M + PERSON_GAP_M, abs=PERIOD)  # they did meet
    moving = np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0)) > 1e-9
    assert max(longest_stand(person) for person in moving.T) < 20.0


def test_person_stops_before_a_standing_robot_and_turns_back():
    robot = np.array([8.0, 0.45])
    places = walk(crowd(ALLEY, 1, seed=3, robot=robot), 300, robot)[:, 0]
    gap = np.abs(places[:, 0] - 8.0) - PERSON_RADIUS_M - ROBOT
    assert gap.min() == pytest.approx(LOOK_AHEAD_M + ROBOT_GAP_M, abs=PERIOD + 0.02)
    stands = np.hypot(*np.diff(places, axis=0).T) < 1e-9
    assert 1.0 < longest_stand(~stands) < 20.0
    assert (gap[:-1][stands] < 0.6).all()
    assert gap[int(np.argmin(gap)) :].max() > 2.0


def test_people_walk_around_a_standing_robot():
    robot = np.array([6.0, 4.0])
    places = walk(crowd(HALL, 6, seed=5, robot=robot), 200, robot)
    sides = np.sign(places[..., 0] - 6.0)
    assert (np.diff(sides, axis=0) != 0).any(axis=0).all()


def test_nobody_steps_in_front_of_a_robot_that_cannot_brake():
    """People within the braking distance of a robot at 1 m/s do not step into its way, or closer if they are in it.

    The simulated robot does not brake. People it would have run over are ignored from then on.
    """
    world, rng, brakes = shipped("office"), np.random.default_rng(0), PERSON_RADIUS_M + ROBOT + 0.65
    met = 0
    for seed in range(6):
        people = crowd(world, 10, seed, robot=(1.0, 4.0))
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
    people = crowd(HALL, 5, seed=1, robot=CORNER)
    walk(people, 5, CORNER)
    before = people.places.copy()
    people.make_room(before[2])
    assert np.hypot(*(people.places[2] - before[2])) >= MIN_START_DISTANCE_M
    assert np.array_equal(np.delete(people.places, 2, 0), np.delete(before, 2, 0))

    before = people.places.copy()
    box = Obstacle.model_validate({"name": "box", "box": {"center": tuple(before[4]), "size": (0.6, 0.6)}})
    world = World(name="hall", boundary=HALL.boundary, obstacles=[box])
    people.make_room(CORNER, world)
    assert world.clearance(people.places).min() >= PERSON_RADIUS_M
    assert not np.array_equal(people.places[4], before[4])
    assert world.clearance(walk(people, 60, CORNER).reshape(-1, 2)).min() >= PERSON_RADIUS_M


def test_without_room_an_error_is_raised_and_nothing_changes():
    with pytest.raises(UserError, match=r"world 'alley' has room for \d+ people, .* not for 60: ask for fewer"):
        crowd(ALLEY, 60, robot=(8.0, 0.45))
    people = crowd(ALLEY, 1, robot=(0.5, 0.45))
    before = people.places.copy()
    full = Obstacle.model_validate({"name": "full", "box": {"center": (9, 0.45), "size": (14, 0.6)}})
    with pytest.raises(UserError, match="ask for fewer"):
        people.make_room(np.array([0.5, 0.45]), World(name="alley", boundary=ALLEY.boundary, obstacles=[full]))
    assert np.array_equal(people.places, before)
    assert len(walk(people, 5, (0.5, 0.45))) > 0


def test_grid_is_empty_in_a_world_too_narrow_for_people():
    grid = WalkableGrid(World(name="slit", boundary=[(0, 0), (9, 0), (9, 0.5), (0, 0.5)]), PERSON_RADIUS_M)
    assert len(grid.nodes) == len(grid.start_nodes) == 0
    assert not grid.can_start(np.array([4.0, 0.25]))


def test_paths_keep_clear_of_walls_and_blocked_discs():
    world, rng = shipped("maze"), np.random.default_rng(0)
    grid = WalkableGrid(world, PERSON_RADIUS_M)
    blocked = np.array([[2.5, 3.5, 0.6], [7.5, 5.5, 0.6], [9.0, 2.5, 0.6]])
    count = 0
    for node in rng.permutation(grid.start_nodes)[:60]:
        place = grid.nodes[node]
        gaps = np.hypot(*(blocked[:, :2] - place).T)
        path = grid.random_path(place, rng, blocked)
        if path is None:
            continue
        count += 1
        assert np.array_equal(path[0], place)
        fine = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(path)])
        assert world.clearance(fine).min() >= PERSON_RADIUS_M + 0.04
        nearest = np.hypot(fine[:, None, 0] - blocked[:, 0], fine[:, None, 1] - blocked[:, 1]).min(axis=0)
        assert (nearest >= np.minimum(blocked[:, 2], gaps) - 0.03).all()
    assert count > 40
