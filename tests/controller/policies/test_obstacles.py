"""Unmapped obstacles: detection, ageing, and removal when a beam passes through."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import World
from services.controller.policies.obstacles import STATIC_AFTER_NS, TemporaryObstacles
from tests.controller.driving import box, free_space, scan, shipped

SECOND = 1_000_000_000
MAZE = shipped("maze")
HERE, AWAY = np.array([1.5, 3.0, 0.0]), np.array([1.5, 3.0, np.pi])  # from AWAY the box is out of the scanner's view


def with_box(y=3.0) -> World:
    return MAZE.with_obstacles([*MAZE.obstacles, box(3.2, y, 0.4, 0.4)])


BOX = with_box()


@pytest.fixture
def obstacles():
    return TemporaryObstacles(free_space("maze"))


@pytest.mark.parametrize("name", ["corridor", "maze", "office"])
def test_nothing_is_found_in_the_mapped_world(name):
    world, rng = shipped(name), np.random.default_rng(0)
    for x, y in world.sample_free(15, rng, 0.4):
        obstacles, pose = TemporaryObstacles(free_space(name)), np.array([x, y, rng.uniform(-np.pi, np.pi)])
        believed = pose + rng.normal(0, [0.01, 0.01, 0.004])
        obstacles.update(scan(0, pose, world, rng=rng), believed)
        assert len(obstacles.points()) == 0


def test_new_box_is_found_and_becomes_static(obstacles):
    for stamp in range(0, 4 * SECOND // 3, SECOND // 15):
        obstacles.update(scan(stamp, HERE, BOX), HERE)
        points = obstacles.points()
        assert len(points) >= 4
        assert np.abs(points - [3.0, 3.0]).max() < 0.3  # its near face
        assert obstacles.moving(stamp).all() == (stamp < STATIC_AFTER_NS)


def test_leg_that_every_other_scan_hits(obstacles):
    """It is kept, and becomes static."""
    for number in range(30):
        stamp = number * SECOND // 15
        obstacles.update(scan(stamp, HERE, MAZE if number % 2 else BOX), HERE)
        assert len(obstacles.points()) >= 4
    assert not obstacles.moving(stamp - SECOND // 15).any()


def test_walking_person(obstacles):
    for number in range(30):
        stamp, y = number * SECOND // 15, 2.0 + number / 15
        obstacles.update(scan(stamp, HERE, with_box(y)), HERE)
        assert np.abs(obstacles.points() - [3.2, y]).max() < 0.45
        assert obstacles.moving(stamp).any()


@pytest.mark.parametrize(
    ("seen_s", "scans", "kept"),
    [
        (0.0, [(1.0, AWAY, MAZE)], True),
        (0.0, [(1.0, AWAY, MAZE), (1.5, HERE, MAZE)], True),  # a beam passes, perhaps because of noise
        (0.0, [(1.0, AWAY, MAZE), (1.5, HERE, MAZE), (1.6, HERE, MAZE)], False),  # two
        (0.0, [(3.0, AWAY, MAZE)], False),
        (4.0, [(14.0, AWAY, MAZE)], True),
        (4.0, [(14.0, AWAY, MAZE), (29.0, AWAY, MAZE)], False),
        (1.0, [(0.0, AWAY, MAZE)], False),  # time went back: a reset
        (0.0, [(0.1, HERE, None)], True),  # all beams unmeasured
    ],
)
def test_memory(obstacles, seen_s, scans, kept):
    """The box is seen for ``seen_s``, followed by other scans."""
    for stamp_s in np.arange(0, seen_s + 0.1, 0.5):
        obstacles.update(scan(round(stamp_s * SECOND), HERE, BOX), HERE)
    before = obstacles.points()
    assert len(before) >= 4
    for stamp_s, pose, world in scans:
        observed = scan(round(stamp_s * SECOND), pose, world or MAZE)
        if world is None:
            observed = observed.model_copy(update={"ranges": np.zeros_like(observed.ranges)})
        obstacles.update(observed, pose)
    np.testing.assert_array_equal(obstacles.points(), before if kept else np.zeros((0, 2)))
