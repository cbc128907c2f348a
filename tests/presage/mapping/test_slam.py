"""Mapping without reference poses."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from lab.accuracy.scenes import TWIN_OFFSET, TWINS, Scene
from presage.mapping.drive import RawDrive
from presage.mapping.pose_graph import Link, LinkTable, optimise
from presage.mapping.slam import build_trajectory


def driven(world, truth, seed=1):
    scene = Scene.of(world, 300, seed)
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(truth)])
    scanner = scene.scanner
    stamps = np.arange(len(truth)) / scanner.rate
    return RawDrive(stamps, ranges, scanner.angles(), np.array(scanner.mount), scanner.range_max)


def test_jacobians_of_links():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(3, 3))
    table = LinkTable([Link(0, 1, rng.normal(size=3), np.eye(3)), Link(2, 1, rng.normal(size=3), np.eye(3))])
    for sides, jacobian in zip((table.first, table.second), table.jacobians(poses), strict=True):
        for link, pose in enumerate(sides):
            for axis in range(3):
                moved = poses.copy()
                moved[pose, axis] += 1e-6
                change = (table.errors(moved) - table.errors(poses))[link] / 1e-6
                assert jacobian[link, :, axis] == pytest.approx(change, abs=1e-5)


def test_consistent_graph_is_solved():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(20, 3))
    pairs = [(i, j) for i in range(20) for j in (i + 1, i + 5) if j < 20]
    links = [Link(i, j, se2.between(truth[i], truth[j]), np.eye(3)) for i, j in pairs]
    start = truth + 0.05 * rng.normal(size=truth.shape)
    start[0] = truth[0]
    assert optimise(start, links) == pytest.approx(truth, abs=1e-6)


def test_simulated_drive():
    world = load_world("office")
    truth = Scene.of(world, 300, 5).path(20)
    built = build_trajectory(driven(world, truth))
    error = se2.compose(truth[0], built.poses)[:, :2] - truth[:, :2]
    assert np.hypot(*error.T).max() < 0.1


def test_look_alike_rooms_stay_apart():
    corners = np.array([[2.95, 2.5], [2.95, 5.0], [2.95 + TWIN_OFFSET, 5.0], [2.95 + TWIN_OFFSET, 2.5]])
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / 0.05)) for a, b in pairwise(corners)]
    places = np.concatenate(legs)
    truth = np.column_stack([places, np.full(len(places), -np.pi / 2)])
    built = build_trajectory(driven(TWINS, truth))
    assert np.hypot(*(built.poses[-1] - built.poses[0])[:2]) == pytest.approx(TWIN_OFFSET, abs=0.3)
