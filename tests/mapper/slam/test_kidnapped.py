"""A robot that is kidnapped while it maps."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from lab.accuracy.scenes import TWIN_OFFSET, TWINS, Scene
from lab.benchmarks.mapping_faults import false_walls
from services.mapper.slam.back_end import BackEnd
from services.mapper.slam.front_end import MAX_SUSPECT_SCANS, NO_PIECE, track_drive
from services.mapper.slam.loop_closure import LoopClosure
from services.mapper.slam.pose_graph import PoseLink
from services.mapper.slam.trajectory import build_trajectory
from tests.mapper.drives import driven
from tests.mapper.slam.test_mapper import mapped

OFFICE = load_world("office")


def carried(place, first=20, second=20):
    """A drive, after which the robot is carried to a place of the path or, if None, far from it, and drives on."""
    scene = Scene.of(OFFICE, 300, 5)
    before = scene.path(first)
    poses = scene.poses(200)
    away = np.hypot(*(poses[:, None] - before[::10])[..., :2].transpose(2, 0, 1)).min(axis=1)
    there = poses[np.argmax(away)] if place is None else np.array([*before[place][:2], before[place][2] + 2])
    return np.concatenate([before, scene.path(second, start=there)]), len(before)


def error(truth, poses):
    """Largest error of the known positions in m."""
    return np.nanmax(np.hypot(*(se2.compose(truth[0], poses) - truth)[:, :2].T))


@pytest.mark.parametrize("place", [40, None])
def test_scans_elsewhere_do_not_change_the_map(place):
    truth, count = carried(place, second=4)
    drive = driven(OFFICE, truth)
    mapper, places = mapped(drive)
    assert all(each.matched for each in places[:count])
    assert not any(each.matched for each in places[count + 1 :])
    first_elsewhere = places[count + 1 : count + 1 + MAX_SUSPECT_SCANS // 2]
    assert {each.piece for each in first_elsewhere} == {NO_PIECE}
    stamps, poses = mapper.trajectory()
    assert len(stamps) <= count + 1
    assert error(truth[: len(poses)], poses) < 0.1


def test_place_is_found_again():
    truth, _ = carried(40)
    drive = driven(OFFICE, truth)
    poses = build_trajectory(drive).poses
    known = np.isfinite(poses).all(axis=1)
    assert known.mean() > 0.95
    assert error(truth, poses) < 0.1
    assert false_walls(se2.compose(truth[0], poses[known]), drive.ranges[known], drive.laser, OFFICE) < 0.01
    mapper, places = mapped(drive)
    assert places[-1].matched
    last = se2.compose(truth[0], mapper.trajectory()[1][-1])
    assert np.hypot(*(last - truth[-1])[:2]) < 0.1


def test_wrong_closures_are_refused():
    truth = Scene.of(OFFICE, 300, 5).path(20)
    drive = driven(OFFICE, truth)
    scans = track_drive(drive).key_scans
    back_end = BackEnd(drive.laser)
    back_end.extend(scans)
    before = back_end.poses.copy()
    last = len(before) - 1
    wrong = PoseLink(2, last, np.array([1.0, 0.5, 1.0]), np.diag([1e4, 1e4, 1e5]), robust=True)
    back_end.closures = [LoopClosure(0, 3, wrong, wide=False)]
    back_end.close_loops(scans, 1.0)
    assert all(each.link is not wrong for each in back_end.closures)
    assert np.abs(back_end.poses - before)[:, :2].max() < 0.1


def test_small_jump_keeps_the_map_whole():
    path = Scene.of(OFFICE, 300, 5).path(20)
    step = np.argmax(np.hypot(*(path[103:-100] - path[100:-103])[:, :2].T)) + 100
    truth = np.delete(path, np.arange(step + 1, step + 3), axis=0)
    drive = driven(OFFICE, truth)
    assert track_drive(drive).pieces.max() >= 1
    built = build_trajectory(drive)
    assert np.isfinite(built.poses).all()
    assert error(truth, built.poses) < 0.1


def along(*corners):
    """Places (N, 2), 10 cm apart, along lines."""
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / 0.1)) for a, b in pairwise(np.array(corners))]
    return np.concatenate(legs)


def wheels(truth, carried):
    """Exact odometry; the wheels do not turn while the robot is carried, before scan number ``carried``."""
    steps = se2.between(truth[:-1], truth[1:])
    steps[carried - 1] = 0
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def test_wrong_place_is_given_up():
    """A room that looks like a mapped one is taken for it until the robot leaves it."""
    west = along([2.95, 5], [2.95, 2.5], [5, 0.8], [2.5, 0.6], [2, 3.2], [2.95, 3.2], [2.95, 5], [5, 5], [1.5, 5])
    inside = along([5, 0.8], [2.5, 0.6], [2, 3.2], [4, 1], [2.5, 0.6], [2, 3.2], [2.95, 3.2])
    outside = along([2.95, 3.2], [2.95, 5], [2, 5], [4, 5], [2.95, 5], [2, 5])
    places = np.concatenate([west, np.concatenate([inside, outside]) + np.array([TWIN_OFFSET, 0])])
    truth = np.column_stack([places, np.where(np.arange(len(places)) < len(west), -1.6, -0.8)])
    _, found = mapped(replace(driven(TWINS, truth), odom=wheels(truth, len(west))))
    poses = se2.compose(truth[0], np.array([place.pose for place in found]))
    correct = np.hypot(*(poses - truth)[:, :2].T) < 0.2
    believed = np.array([place.matched for place in found])
    leaving = len(truth) - len(outside)
    assert believed[leaving]
    assert not correct[leaving]
    assert correct[-1] or not believed[-1]
