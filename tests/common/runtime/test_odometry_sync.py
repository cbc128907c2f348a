"""Scans are paired with the odometry of their stamp."""

from __future__ import annotations

import numpy as np

from common.messages.definitions import Odom, Pose, Scan, Twist
from common.runtime.odometry_sync import MAX_SILENCE_NS, OdometrySync


def a_scan(stamp):
    return Scan(
        stamp_ns=stamp,
        angle_min=0.0,
        angle_increment=0.1,
        range_min=0.1,
        range_max=10.0,
        ranges=np.ones(2),
        mount=Pose(x=0.0, y=0.0),
    )


def an_odom(stamp):
    return Odom(stamp_ns=stamp, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=np.eye(3))


def stamps(pairs):
    return [(scan.stamp_ns, odom and odom.stamp_ns) for scan, odom in pairs]


def test_scan_waits_for_its_odometry():
    sync = OdometrySync()
    assert stamps(sync.add_odometry(an_odom(0))) == []
    assert stamps(sync.add_scan(a_scan(1))) == []
    assert stamps(sync.add_odometry(an_odom(1))) == [(1, 1)]
    assert stamps(sync.add_odometry(an_odom(2))) == []
    assert stamps(sync.add_scan(a_scan(2))) == [(2, 2)]


def test_scan_whose_odometry_never_comes():
    sync = OdometrySync()
    sync.add_odometry(an_odom(0))
    sync.add_scan(a_scan(1))
    assert stamps(sync.add_scan(a_scan(2))) == [(1, None)]
    assert stamps(sync.add_odometry(an_odom(3))) == [(2, None)]


def test_scans_do_not_wait_after_a_silence():
    sync, silence = OdometrySync(), MAX_SILENCE_NS
    assert stamps(sync.add_scan(a_scan(1))) == [(1, None)]
    sync.add_odometry(an_odom(2))
    assert stamps(sync.add_scan(a_scan(1 + silence))) == []
    assert stamps(sync.add_scan(a_scan(2 + silence))) == [(1 + silence, None), (2 + silence, None)]
