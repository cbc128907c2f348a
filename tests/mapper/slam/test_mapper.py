"""Mapping while driving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED
from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from services.mapper.slam.mapper import Mapper
from services.mapper.slam.submaps import KEY_SCANS_PER_SUBMAP
from services.mapper.slam.trajectory import build_trajectory
from tests.mapper.drives import driven, odometry

OFFICE = load_world("office")


def mapped(drive):
    """A mapper after a drive, updated after every submap, and the places of the scans when they came."""
    mapper, places = Mapper(drive.laser, 0.05), []
    for k, (stamp, ranges) in enumerate(zip(drive.stamps, drive.ranges, strict=True)):
        places.append(mapper.add(stamp, ranges, None if drive.odom is None else drive.odom[k]))
        scans = mapper.key_scans()
        if mapper.outdated and len(scans.poses) % KEY_SCANS_PER_SUBMAP == 0:
            mapper.use(mapper.update(scans))
    mapper.use(mapper.update(mapper.key_scans()))
    return mapper, places


@pytest.mark.parametrize("with_odometry", [True, False])
def test_live_map_is_that_of_the_log(with_odometry):
    truth = Scene.of(OFFICE, 300, 5).path(30)
    drive = driven(OFFICE, truth)
    if with_odometry:
        drive = replace(drive, odom=odometry(truth))
    mapper, places = mapped(drive)
    assert len(mapper.map.closures)
    assert all(place.matched for place in places)
    _, poses = mapper.trajectory()
    batch = build_trajectory(drive)
    assert np.abs(poses - batch.poses)[:, :2].max() < 0.005
    error = se2.compose(truth[0], poses)[:, :2] - truth[:, :2]
    assert np.hypot(*error.T).max() < 0.1


def test_gap_in_the_scans():
    truth = Scene.of(OFFICE, 300, 5).path(20)
    drive = driven(OFFICE, truth)
    kept = np.r_[0:100, 105 : len(truth)]
    _, places = mapped(replace(drive, stamps=drive.stamps[kept], ranges=drive.ranges[kept]))
    error = se2.compose(truth[0], np.array([place.pose for place in places]))[:, :2] - truth[kept, :2]
    assert np.hypot(*error.T).max() < 0.1


@pytest.mark.parametrize("with_odometry", [True, False])
@pytest.mark.parametrize("step_s", [-1000.0, 1000.0])
def test_step_of_the_clock(with_odometry, step_s):
    truth = Scene.of(OFFICE, 300, 5).path(10)
    drive = driven(OFFICE, truth)
    drive.stamps[70:] += step_s
    odom = None
    if with_odometry:  # a reset also resets the odometry
        odom = odometry(truth)
        odom[70:] = se2.between(odom[70], odom[70:])
    mapper, places = mapped(replace(drive, odom=odom))
    assert all(place.matched for place in places)
    _, poses = mapper.trajectory()
    assert np.hypot(*(se2.compose(truth[0], poses) - truth)[:, :2].T).max() < 0.1


@pytest.mark.parametrize("with_odometry", [True, False])
@pytest.mark.parametrize("first_step", [0.0, 0.2])
def test_first_scans_without_return(with_odometry, first_step):
    """A robot that stands is localised, and gets a map, as soon as its scanner sees something."""
    x = 3 + first_step * np.minimum(np.arange(12), 5)  # m; while the scanner sees nothing, the robot may drive
    truth = np.column_stack([x, np.full(12, 1.5), np.zeros(12)])
    drive = driven(OFFICE, truth)
    drive.ranges[:6] = np.inf
    odom = truth if with_odometry else [None] * len(truth)
    mapper, places = Mapper(drive.laser, 0.05), []
    for stamp, ranges, pose in zip(drive.stamps, drive.ranges, odom, strict=True):
        places.append(mapper.add(stamp, ranges, pose))
        if mapper.outdated:
            mapper.use(mapper.update(mapper.key_scans()))
    assert all(place.matched for place in places[7:])
    assert (mapper.map.grid.values == FREE).any()
    assert mapper.trajectory()[1][-1] == pytest.approx(places[-1].pose)
    if with_odometry:
        error = se2.between(places[0].pose, places[-1].pose) - se2.between(truth[0], truth[-1])
        assert np.abs(error).max() < 0.01


def test_a_drawn_map_has_fewer_gaps_than_that_of_the_key_scans():
    truth = Scene.of(OFFICE, 300, 5).path(5)
    mapper, _ = mapped(driven(OFFICE, truth))
    drawn, of_key_scans = mapper.drawing()(), mapper.map.grid
    occupied = np.argwhere(drawn.values == OCCUPIED)[:, ::-1]
    assert len(occupied) > 1.3 * (of_key_scans.values == OCCUPIED).sum()
    centres = drawn.to_map((occupied + 0.5) * drawn.resolution)
    distance = np.abs(OFFICE.surface_distance(se2.transform(truth[0], centres)))
    assert np.quantile(distance, 0.99) < 0.1
