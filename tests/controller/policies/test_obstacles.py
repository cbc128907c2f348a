"""Unmapped obstacles: detection, ageing, and removal when a beam passes through."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World, load_world
from common.messages.definitions import Pose, Scan
from common.robot.scanner import SCANNERS
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.obstacles import STATIC_AFTER_NS, TemporaryObstacles

SCANNER = SCANNERS["tim571"].with_beams(271)
SECOND = 1_000_000_000


def scan_of(world, pose, stamp_ns, rng=None):
    laser = se2.compose(pose, np.array(SCANNER.mount))
    ranges = world.ray_distances(laser[None], SCANNER.angles())[0]
    if rng is not None:
        ranges = ranges + 0.02 * rng.standard_normal(len(ranges))
    return Scan(
        stamp_ns=stamp_ns,
        angle_min=SCANNER.angle_min,
        angle_increment=SCANNER.angle_increment,
        range_min=SCANNER.range_min,
        range_max=SCANNER.range_max,
        ranges=SCANNER.limit(ranges).astype(np.float32),
        mount=Pose.of(SCANNER.mount),
    )


def with_box(world, x, y, size=0.4):
    more = {"name": "new", "box": {"center": (x, y), "size": (size, size)}}
    return World(name=world.name, boundary=world.boundary, obstacles=[*world.obstacles, more])


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
def test_nothing_is_found_in_the_mapped_world(name):
    world, rng = load_world(name), np.random.default_rng(0)
    free = FreeSpace.of(world)
    for x, y in world.sample_free(15, rng, 0.4):
        obstacles, pose = TemporaryObstacles(free), np.array([x, y, rng.uniform(-np.pi, np.pi)])
        believed = pose + rng.normal(0, [0.01, 0.01, 0.004])
        obstacles.update(scan_of(world, pose, 0, rng), believed)
        assert len(obstacles.points()) == 0


def test_new_box_is_found_and_becomes_static():
    world = load_world("maze")
    changed, pose = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    for number in range(20):
        stamp = number * SECOND // 15
        obstacles.update(scan_of(changed, pose, stamp), pose)
        points = obstacles.points()
        assert len(points) >= 4
        assert np.abs(points - [3.0, 3.0]).max() < 0.3  # its near face
        assert obstacles.moving(stamp).all() == (stamp < STATIC_AFTER_NS)


def test_unmeasured_beams_change_nothing():
    world = load_world("maze")
    changed, pose = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    obstacles.update(scan_of(changed, pose, 0), pose)
    before = obstacles.points()
    scan = scan_of(world, pose, SECOND // 15)
    obstacles.update(scan.model_copy(update={"ranges": np.zeros_like(scan.ranges)}), pose)
    np.testing.assert_array_equal(obstacles.points(), before)
    assert len(before)


def test_removed_obstacle_is_forgotten_when_a_beam_passes():
    world = load_world("maze")
    changed, pose = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    obstacles.update(scan_of(changed, pose, 0), pose)
    before = obstacles.points()
    away = np.array([1.5, 3.0, np.pi])  # the box is out of the scanner's view
    obstacles.update(scan_of(world, away, SECOND), away)
    np.testing.assert_array_equal(obstacles.points(), before)
    obstacles.update(scan_of(world, pose, 2 * SECOND), pose)
    assert len(obstacles.points()) == 0


def test_walking_person_stays_moving_and_leaves_no_trail():
    world, pose = load_world("maze"), np.array([1.5, 3.0, 0.0])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    for number in range(30):
        stamp, y = number * SECOND // 15, 2.0 + number / 15
        obstacles.update(scan_of(with_box(world, 3.2, y), pose, stamp), pose)
        assert np.abs(obstacles.points() - [3.2, y]).max() < 0.45
        assert obstacles.moving(stamp).any()


def test_unseen_obstacle_is_forgotten_after_a_time_or_a_reset():
    world = load_world("maze")
    pose, away = np.array([1.5, 3.0, 0.0]), np.array([1.5, 3.0, np.pi])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    obstacles.update(scan_of(with_box(world, 3.2, 3.0), pose, 5 * SECOND), pose)
    obstacles.update(scan_of(world, away, 30 * SECOND), away)
    assert len(obstacles.points()) == 0
    obstacles.update(scan_of(with_box(world, 3.2, 3.0), pose, 31 * SECOND), pose)
    obstacles.update(scan_of(world, away, 0), away)
    assert len(obstacles.points()) == 0


def test_unseen_furniture_is_kept_for_a_limited_time():
    world = load_world("maze")
    pose, away = np.array([1.5, 3.0, 0.0]), np.array([1.5, 3.0, np.pi])
    obstacles = TemporaryObstacles(FreeSpace.of(world))
    for half in range(9):
        obstacles.update(scan_of(with_box(world, 3.2, 3.0), pose, half * SECOND // 2), pose)
    obstacles.update(scan_of(world, away, 14 * SECOND), away)
    assert len(obstacles.points()) >= 4
    obstacles.update(scan_of(world, away, 29 * SECOND), away)
    assert len(obstacles.points()) == 0
