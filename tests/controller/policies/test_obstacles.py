"""What the map does not know: found, told from the map, aged, and forgotten when a beam passes where it was."""

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
        stamp_ns=stamp_ns, angle_min=SCANNER.angle_min, angle_increment=SCANNER.angle_increment,
        range_min=SCANNER.range_min, range_max=SCANNER.range_max, ranges=SCANNER.limit(ranges).astype(np.float32),
        mount=Pose.of(SCANNER.mount),
    )  # fmt: skip


def with_box(world, x, y, size=0.4):
    more = {"name": "new", "box": {"center": (x, y), "size": (size, size)}}
    return World(name=world.name, boundary=world.boundary, obstacles=[*world.obstacles, more])


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
def test_in_the_world_of_the_map_nothing_is_found(name):
    world, rng = load_world(name), np.random.default_rng(0)
    free = FreeSpace.of(world)
    for x, y in world.sample_free(15, rng, 0.4):
        layer, pose = TemporaryObstacles(free), np.array([x, y, rng.uniform(-np.pi, np.pi)])
        believed = pose + rng.normal(0, [0.01, 0.01, 0.004])
        layer.update(scan_of(world, pose, 0, rng), believed)
        assert len(layer.points()) == 0


def test_a_new_box_is_found_where_it_is_and_becomes_furniture():
    world = load_world("maze")
    changed, pose, layer = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0]), TemporaryObstacles(FreeSpace.of(world))
    for number in range(20):
        stamp = number * SECOND // 15
        layer.update(scan_of(changed, pose, stamp), pose)
        points = layer.points()
        assert len(points) >= 4
        assert np.abs(points - [3.0, 3.0]).max() < 0.3  # its near face
        assert layer.moving(stamp).all() == (stamp < STATIC_AFTER_NS)


def test_beams_that_measured_nothing_neither_find_nor_clear():
    world = load_world("maze")
    changed, pose, layer = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0]), TemporaryObstacles(FreeSpace.of(world))
    layer.update(scan_of(changed, pose, 0), pose)
    before = layer.points()
    scan = scan_of(world, pose, SECOND // 15)
    layer.update(scan.model_copy(update={"ranges": np.zeros_like(scan.ranges)}), pose)
    np.testing.assert_array_equal(layer.points(), before)
    assert len(before)


def test_what_went_away_is_forgotten_once_a_beam_passes_and_not_before():
    world = load_world("maze")
    changed, pose, layer = with_box(world, 3.2, 3.0), np.array([1.5, 3.0, 0.0]), TemporaryObstacles(FreeSpace.of(world))
    layer.update(scan_of(changed, pose, 0), pose)
    before = layer.points()
    away = np.array([1.5, 3.0, np.pi])  # the box lies where the scanner does not look
    layer.update(scan_of(world, away, SECOND), away)
    np.testing.assert_array_equal(layer.points(), before)
    layer.update(scan_of(world, pose, 2 * SECOND), pose)
    assert len(layer.points()) == 0


def test_who_walks_stays_moving_and_leaves_no_trail():
    world, layer, pose = load_world("maze"), None, np.array([1.5, 3.0, 0.0])
    layer = TemporaryObstacles(FreeSpace.of(world))
    for number in range(30):
        stamp, y = number * SECOND // 15, 2.0 + number / 15
        layer.update(scan_of(with_box(world, 3.2, y), pose, stamp), pose)
        assert np.abs(layer.points() - [3.2, y]).max() < 0.45
        assert layer.moving(stamp).any()


def test_out_of_sight_it_is_forgotten_after_a_while_and_when_time_goes_back():
    world = load_world("maze")
    pose, away = np.array([1.5, 3.0, 0.0]), np.array([1.5, 3.0, np.pi])
    layer = TemporaryObstacles(FreeSpace.of(world))
    layer.update(scan_of(with_box(world, 3.2, 3.0), pose, 5 * SECOND), pose)
    layer.update(scan_of(world, away, 30 * SECOND), away)
    assert len(layer.points()) == 0
    layer.update(scan_of(with_box(world, 3.2, 3.0), pose, 31 * SECOND), pose)
    layer.update(scan_of(world, away, 0), away)
    assert len(layer.points()) == 0


def test_furniture_out_of_sight_is_kept_for_a_while_and_not_for_ever():
    world = load_world("maze")
    pose, away = np.array([1.5, 3.0, 0.0]), np.array([1.5, 3.0, np.pi])
    layer = TemporaryObstacles(FreeSpace.of(world))
    for half in range(9):
        layer.update(scan_of(with_box(world, 3.2, 3.0), pose, half * SECOND // 2), pose)
    layer.update(scan_of(world, away, 14 * SECOND), away)
    assert len(layer.points()) >= 4
    layer.update(scan_of(world, away, 29 * SECOND), away)
    assert len(layer.points()) == 0
