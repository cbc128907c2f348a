"""Swept scans: each beam is measured from the robot's pose at its own time."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.messages.definitions import Twist
from common.robot.motion_distortion import correct_beams
from services.simulator.odometry import OdometryNoise
from tests.simulator.driving import HALL, SCANNER, measurements

EXACT = SCANNER.model_copy(update={"sigma": 0.0})
TURNING = Twist(vx=0.4, vy=0.2, wz=1.0)
NO_DRIFT = OdometryNoise(0, 0, 0, 0)


@pytest.mark.parametrize("engine", ["kinematic", "pybullet"])
def test_swept_scan_and_truth(make, engine):
    simulation = make(scanner=EXACT, sweep=True, engine=engine, drift=NO_DRIFT)
    start = simulation.observe()[1].pose.array()
    odom, truth, scan = measurements(simulation, 1.5, TURNING)[-1]
    assert scan.stamp_ns == truth.stamp_ns == odom.stamp_ns
    assert scan.sweep_time == pytest.approx(0.75 / 15)  # of 270 degrees at 15 Hz
    pose, twist = truth.pose.array(), truth.twist.array()
    np.testing.assert_allclose(se2.compose(start, odom.pose.array()), pose, atol=1e-6)
    # A constant twist turns the direction of travel.
    steps = scan.beam_times()[:, None] * twist
    steps[:, :2] = [se2.rotate(yaw / 2, xy) for yaw, xy in zip(steps[:, 2], steps[:, :2], strict=True)]
    ranges, angles = correct_beams(scan.ranges.astype(float), scan.angles(), steps, scan.mount.array())
    exact = HALL.ray_distances(se2.compose(pose, scan.mount.array())[None], angles)[0]
    np.testing.assert_allclose(ranges, exact, atol=2e-3)
    instantaneous = HALL.ray_distances(se2.compose(pose, scan.mount.array())[None], scan.angles())[0]
    assert np.abs(scan.ranges - instantaneous).max() > 0.05


def test_standing_robot(make):
    (swept, instantaneous) = (make(scanner=EXACT, sweep=sweep).observe()[2] for sweep in (True, False))
    np.testing.assert_allclose(swept.ranges, instantaneous.ranges, atol=1e-5)
    assert instantaneous.time_increment == 0


def test_teleport_is_no_motion(make):
    simulation = make(scanner=EXACT, sweep=True, drift=NO_DRIFT)
    before = measurements(simulation, 0.5, TURNING)[-1][0].pose
    simulation.teleport(np.array([5.0, 2.0, 1.0]))
    odom, truth, scan = measurements(simulation, 0.1)[-1]
    assert truth.pose.array() == pytest.approx([5.0, 2.0, 1.0])
    assert odom.pose == before
    exact = HALL.ray_distances(se2.compose([5.0, 2.0, 1.0], scan.mount.array())[None], scan.angles())[0]
    np.testing.assert_allclose(scan.ranges, exact, atol=1e-3)


def test_obstacle_stop_with_swept_scans(make):
    simulation = make(start=(4.0, 3.0, 0.0), sweep=True)
    truths = [truth for _, truth, _ in measurements(simulation, 6, Twist(vx=1.0, wz=0.1))]
    assert truths[-1].stopped
    assert not any(truth.contact for truth in truths)
