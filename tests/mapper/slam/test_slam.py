"""Mapping without reference poses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from lab.accuracy.motion_distortion import observations
from lab.accuracy.scenes import TWIN_OFFSET, TWINS, Scene
from lab.integrity.buildings import make_building
from services.mapper.slam import back_end as back_end_module
from services.mapper.slam import correlative_search as correlative
from services.mapper.slam.back_end import BackEnd
from services.mapper.slam.correlative_search import correlative_search
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.elements import Elements, concatenate
from services.mapper.slam.front_end import NO_PIECE, FrontEnd, track_drive
from services.mapper.slam.loop_closure import LoopClosure, find_closures
from services.mapper.slam.pose_graph import ANCHOR, LinkTable, PoseLink, Uncertainty, optimise
from services.mapper.slam.trajectory import build_trajectory
from tests.mapper.drives import driven, odometry


def test_jacobians_of_links():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(3, 3))
    table = LinkTable([PoseLink(0, 1, rng.normal(size=3), np.eye(3)), PoseLink(2, 1, rng.normal(size=3), np.eye(3))])
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
    links = [PoseLink(i, j, se2.between(truth[i], truth[j]), np.eye(3)) for i, j in pairs]
    start = truth + 0.05 * rng.normal(size=truth.shape)
    start[0] = truth[0]
    assert optimise(start, links) == pytest.approx(truth, abs=1e-6)


def test_uncertainty_is_that_of_the_dense_inverse():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(30, 3))
    pairs = [(k, k + 1) for k in range(29) if k != 19] + [(2, 9), (4, 15), (21, 28)]  # two components
    roots = rng.normal(size=(len(pairs), 3, 3))
    links = [
        PoseLink(i, j, se2.between(poses[i], poses[j]), root @ root.T + np.eye(3))
        for (i, j), root in zip(pairs, roots, strict=True)
    ]
    chosen = np.array([1, 17, 24, 29])
    uncertainty = Uncertainty(poses, links, chosen)
    held = np.zeros((30, 3))
    held[[0, 20]] = ANCHOR
    dense = LinkTable(links).normal_equations(poses)[0].toarray() + np.diag(held.ravel())
    covariance = np.linalg.inv(dense)
    for first, second in ((0, 1), (2, 3)):
        assert uncertainty.linked(first, second)
        rows = (3 * chosen[[first, second], None] + np.arange(3)).ravel()
        table = LinkTable([PoseLink(*chosen[[first, second]], np.zeros(3), np.eye(3))])
        J = np.concatenate([each[0] for each in table.jacobians(poses)], axis=1)
        expected = J @ covariance[np.ix_(rows, rows)] @ J.T
        assert uncertainty.of_pair(first, second) == pytest.approx(expected, rel=1e-6)
    assert not uncertainty.linked(1, 2)


def error_of(drive, truth):
    """Largest error of the position in m."""
    error = se2.compose(truth[0], build_trajectory(drive).poses)[:, :2] - truth[:, :2]
    return np.hypot(*error.T).max()


def test_simulated_drive():
    world = load_world("office")
    truth = Scene.of(world, 300, 5).path(20)
    assert error_of(driven(world, truth), truth) < 0.1


def test_swept_scans():
    scene = Scene.of(load_world("office"), 300, 5)
    path, scanner = scene.path(20, at_full_speed=True), scene.scanner
    scans = observations(scene, path, "corrected", "laser only")
    ranges, stamps = np.array([scan.ranges for scan in scans]), np.arange(len(scans)) / scanner.rate
    mount, increment = np.array(scanner.mount), scans[0].time_increment
    laser = Laser(scanner.angles(), mount, scanner.range_max, increment)
    drive = RawDrive(stamps, ranges, laser)
    corrected, uncorrected = (
        error_of(each, path[:-1]) for each in (drive, replace(drive, laser=replace(laser, time_increment=0.0)))
    )
    assert 3 * corrected < uncorrected


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_swept_scans_do_not_alternate(seed):
    """The motion for which a sweep is corrected comes from poses; an error of one pose must not reverse in the next."""
    scene = Scene.of(load_world("office"), 300, seed)
    path, scanner = scene.path(6, at_full_speed=True), scene.scanner
    scans = observations(scene, path, "corrected", "laser only")
    laser = Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max, scans[0].time_increment)
    stamps = np.arange(len(scans)) / scanner.rate
    tracked = track_drive(RawDrive(stamps, np.array([scan.ranges for scan in scans]), laser))
    error = se2.compose(path[0], tracked.poses)[:, :2] - path[:-1, :2]
    alternating = (error[2:] - 2 * error[1:-1] + error[:-2]) / 4
    assert np.sqrt((alternating**2).sum(axis=1).mean()) < 0.0017


def turning_unseen(seed):
    """A robot that stands, turns by 1.2 rad in a second, and stands: its drive, true poses, mask of the turn."""
    world, turn = load_world("office"), 1.2 * np.clip((np.arange(34) - 9) / 15, 0, 1)
    x, y, yaw = Scene.of(world, 300, seed).poses(1)[0]
    truth = np.column_stack([np.full(34, x), np.full(34, y), yaw + turn])
    return driven(world, truth, seed), truth, (turn > 0) & (turn < 1.2)


def is_tracked(drive, truth):
    """Which scans are at their places relative to the first."""
    tracked = track_drive(drive)
    off = np.abs(se2.between(se2.compose(truth[0], tracked.poses), truth))
    return (off < 0.1).all(axis=1) & (tracked.pieces != NO_PIECE)


@pytest.mark.parametrize("seed", range(1, 6))
def test_turn_in_a_gap_of_the_scans(seed):
    """Scans for which the mapper has no time are left out, also while the robot begins to turn."""
    drive, truth, turning = turning_unseen(seed)
    kept = replace(drive, stamps=drive.stamps[~turning], ranges=drive.ranges[~turning])
    assert is_tracked(kept, truth[~turning]).all()


def test_turn_to_where_two_places_fit():
    """A view that half matches at two headings is left out, although the better match is right here."""
    drive, _, turning = turning_unseen(0)
    kept = replace(drive, stamps=drive.stamps[~turning], ranges=drive.ranges[~turning])
    after = track_drive(kept).pieces[int(np.argmax(turning)) :]
    assert (after[:9] == NO_PIECE).all()


@pytest.mark.parametrize("place", [100, 250, 400])
def test_kidnapping_does_not_distort_swept_scans(place):
    """The robot stands, is carried, and stands again."""
    world = load_world("office")
    path = Scene.of(world, 300, 1).path(30)
    drive = driven(world, np.concatenate([np.repeat(path[:1], 15, axis=0), np.repeat(path[place, None], 25, axis=0)]))
    laser = replace(drive.laser, time_increment=1 / 15 / 300)
    tracked = track_drive(replace(drive, laser=laser))
    assert tracked.keys[-1] >= 15
    for key, ranges in zip(tracked.keys, tracked.key_scans.ranges, strict=True):
        assert (np.abs(ranges - drive.ranges[key]) > 0.1).mean() < 0.05


@pytest.mark.parametrize("seed", range(1, 6))
def test_turn_while_the_view_is_hidden(seed):
    """The longer scans do not match, the less is known about the pose."""
    drive, truth, turning = turning_unseen(seed)
    kept = np.flatnonzero(~turning | (np.arange(len(truth)) % 2 == 0))  # fewer than begin another piece
    hidden = drive.ranges[turning]
    hidden[:], hidden[:, ::3] = np.inf, np.random.default_rng(seed).uniform(1, 8, hidden[:, ::3].shape)
    drive.ranges[turning] = hidden
    tracked = is_tracked(replace(drive, stamps=drive.stamps[kept], ranges=drive.ranges[kept]), truth[kept])
    assert tracked[~turning[kept]].all()


def test_pausing_odometry():
    world = load_world("office")
    truth = Scene.of(world, 300, 5).path(20)
    number = np.arange(len(truth))
    odom = truth[np.where(number % 40 < 4, number // 40 * 40, number)]
    built = build_trajectory(replace(driven(world, truth), odom=odom))
    error = se2.compose(truth[0], built.poses)[:, :2] - truth[:, :2]
    assert np.hypot(*error.T).max() < 0.1


@pytest.mark.parametrize("pause", [4, 5])
def test_pausing_odometry_is_no_kidnapping(pause):
    """After a pause, odometry reports the motion of several scans at once, here along a corridor with few features."""
    x = np.arange(2.0, 12.0, 0.21)
    truth = np.column_stack([x, np.full(len(x), 1.5), np.zeros(len(x))])
    number = np.arange(len(truth))
    since = number % 24 - 10
    odom = truth[np.where((since >= 0) & (since < pause), number - since, number)]
    drive = driven(load_world("corridor"), truth)
    tracked = track_drive(replace(drive, odom=odom, stamps=3.2 * drive.stamps))
    assert (tracked.pieces != NO_PIECE).all()


@pytest.mark.parametrize("seed", [1, 4])
def test_few_beams_correct_odometry(seed):
    """Odometry keeps its weight: scans that hardly observe the motion say little about its error."""
    world = make_building(88045, "office").world
    truth = Scene.of(world, 30, seed).path(40)
    odom = odometry(truth, seed)
    tracked = track_drive(replace(driven(world, truth, beams=30), odom=odom))
    by_odometry, by_scans = (
        np.hypot(*(se2.compose(truth[0], poses) - truth)[:, :2].T).max() for poses in (odom, tracked.poses)
    )
    assert 5 * by_scans < by_odometry


def test_frozen_odometry_is_no_slip():
    truth = Scene.of(load_world("office"), 300, 6).path(20)
    tracked = track_drive(replace(driven(load_world("office"), truth), odom=np.zeros_like(truth)))
    assert (tracked.pieces == 0).all()


@pytest.mark.parametrize("odometry", [False, True])
def test_empty_scans(odometry):
    """A driver that is just starting may send scans without any return."""
    world = load_world("office")
    truth = Scene.of(world, 300, 5).path(4)
    drive = driven(world, truth)
    drive.ranges[:3] = np.inf
    built = build_trajectory(replace(drive, odom=truth if odometry else None))
    known = np.isfinite(built.poses).all(axis=1)
    assert known[3:].all()
    error = se2.between(built.poses[-1], built.poses[3]) - se2.between(truth[-1], truth[3])
    assert np.hypot(*error[:2]) < 0.02


def test_search_for_nothing():
    seen = track_drive(driven(load_world("office"), np.array([[3.0, 1.5, 0.0]]))).key_scans.elements[0]
    assert not len(correlative_search(seen, seen.part(np.zeros(0, int)), np.zeros(3), np.ones(3)))


@pytest.mark.parametrize("seed", range(6))
def test_search_finds_the_best_of_all_poses(seed):
    rng = np.random.default_rng(seed)

    def random_elements(count):
        yaw = rng.uniform(-np.pi, np.pi, count)
        normals = np.column_stack([np.cos(yaw), np.sin(yaw)])
        return Elements(rng.uniform(-3, 3, (count, 2)), normals, np.full(count, 0.1), np.zeros(count))

    target, source = random_elements(60), random_elements(30)
    around, window, turn_step = rng.normal(size=3), np.array([0.5, 0.8, 0.4]), 0.1
    cell = correlative.CELL_M
    corner = around[:2] - np.hypot(*source.points.T).max() - np.hypot(*window[:2]) - 2 * cell  # of cell (0, 0)

    def cells_and_sectors(elements):
        angle = np.arctan2(*elements.normals.T[::-1])
        return np.floor((elements.points - corner) / cell), np.floor(angle / (np.pi / 4))

    target_cells, target_sectors = cells_and_sectors(target)

    def score(turn, shift):
        cells, sectors = cells_and_sectors(source.transformed(np.array([*around[:2], turn])))
        near = (np.abs(cells[:, None] + shift - target_cells) <= 1).all(axis=-1)
        alike = np.isin((sectors[:, None] - target_sectors) % 8, [0, 1, 7])
        return int((near & alike).any(axis=1).sum())

    turns = around[2] + turn_step * np.arange(-4, 5)
    everywhere = [score(turn, (x, y)) for turn in turns for x in range(-4, 5) for y in range(-6, 7)]
    found = correlative_search(target, source, around, window, turn_step)
    scores = [score(pose[2], np.round((pose[:2] - around[:2]) / cell)) for pose in found]
    assert scores[0] == max(everywhere)
    assert scores == sorted(scores, reverse=True)


def test_search_finds_all_headings():
    """In a square room, four headings fit alike."""
    along = np.arange(-1.95, 2.0, 0.1)
    points, normals = np.column_stack([along, np.full(40, 2.0)]), np.tile([0.0, -1.0], (40, 1))
    wall = Elements(points, normals, np.full(40, 0.1), np.zeros(40))
    room = concatenate([wall.transformed(np.array([0.0, 0.0, turn])) for turn in np.pi / 2 * np.arange(4)])
    found = correlative_search(room, room, np.zeros(3), np.array([0.3, 0.3, np.pi]))
    quarters = found[:, 2] / (np.pi / 2)
    assert quarters == pytest.approx(np.round(quarters), abs=0.1)
    assert set(np.round(quarters) % 4) == {0, 1, 2, 3}


def test_closures_that_support_one_another():
    """Two wide matches of the way back with the way there confirm one another if they agree."""
    x = np.concatenate([np.arange(10.0), np.arange(9.0, -1.0, -1.0)])
    truth = np.column_stack([x, np.zeros(20), np.where(np.arange(20) < 10, 0.0, np.pi)])
    steps = se2.between(truth[:-1], truth[1:])
    poses = truth[:1]
    for step in steps + np.array([0.0, 0.0, 0.02]):  # drift of the front end
        poses = np.vstack([poses, se2.compose(poses[-1], step)])
    chain = [PoseLink(k, k + 1, step, np.diag([1e4, 1e4, 1e3])) for k, step in enumerate(steps)]
    uncertainty = Uncertainty(poses, chain, np.arange(20))

    def closure(first, second, error=0.0):
        pose = se2.between(truth[first], truth[second]) + np.array([error, 0.0, 0.0])
        return LoopClosure(first, second, PoseLink(first, second, pose, np.diag([1e4, 1e4, 1e5])), wide=True)

    def confirmed(*closures):
        found, unconfirmed = find_closures([], poses, uncertainty, set(), closures, 0.0)
        assert len(found) + len(unconfirmed) == len(closures)
        return found

    right, other, wrong = closure(1, 18), closure(4, 15), closure(4, 15, 1.5)
    assert confirmed(right) == []
    assert confirmed(right, wrong) == []
    assert confirmed(right, other) == [right, other]
    assert confirmed(right, wrong, other) == [right, other]


def test_without_a_closure_nothing_is_optimised(monkeypatch):
    office = load_world("office")
    drive = driven(office, Scene.of(office, 300, 5).path(8))
    scans = track_drive(drive).key_scans
    back_end, calls = BackEnd(drive.laser), []
    monkeypatch.setattr(back_end_module, "optimise", lambda poses, _: (calls.append(1), poses)[1])
    back_end.extend(scans)
    back_end.close_loops(scans, 30.0)
    assert len(back_end.poses) > 8
    assert not back_end.closures
    assert not calls


def test_look_alike_rooms_stay_apart():
    corners = np.array([[2.95, 2.5], [2.95, 5.0], [2.95 + TWIN_OFFSET, 5.0], [2.95 + TWIN_OFFSET, 2.5]])
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / 0.05)) for a, b in pairwise(corners)]
    places = np.concatenate(legs)
    truth = np.column_stack([places, np.full(len(places), -np.pi / 2)])
    built = build_trajectory(driven(TWINS, truth))
    assert np.hypot(*(built.poses[-1] - built.poses[0])[:2]) == pytest.approx(TWIN_OFFSET, abs=0.3)


@pytest.mark.parametrize("period", [1 / 15, 2.5])
def test_a_slow_scanner_makes_one_piece(period):
    """In a log of a slow scanner, or one with a scan every metre, the usual time between scans is no pause."""
    scene = Scene.of(load_world("office"), 300, 5)
    truth = scene.path(8)
    laser = Laser(scene.scanner.angles(), np.array(scene.scanner.mount), scene.scanner.range_max)
    front_end = FrontEnd(laser)
    for k, pose in enumerate(truth):
        front_end.add(k * period, scene.observe(scene.clean(pose[None])[0], k * period).ranges, pose)
    assert set(front_end.key_scans().pieces.tolist()) == {0}
