"""Bridge and controller mask beams that hit the robot: NaN for their own use, not measured on the bus."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages.definitions import Scan
from common.messages.topics import SCAN
from common.robot.ranges import is_surface
from services.bridge_ros2.ros_types import LASER_SCAN, decode
from services.bridge_ros2.service import BridgeRos2Service
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from tests.bridge_ros2 import independent as other

TOLD = {"ignore_angles": "-5:5", "blind_radius": 0.3}


def sweep(stamp_ns=10**9):
    """Beams at -1, -0.5, 0, 0.5, 1 rad; the last two nearer than 0.3 m, one of them nearer than the scanner can say."""
    return other.encode(LASER_SCAN, {
        "header": other.header(stamp_ns, "laser"), "angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.5,
        "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.1, "range_max": 10.0,
        "ranges": [1.0, 2.0, 3.0, 0.25, 0.05], "intensities": [],
    })  # fmt: skip


@pytest.mark.parametrize(("told", "near"), [({}, 5), (TOLD, 2)])
def test_the_bridge(monkeypatch, told, near):
    service = BridgeRos2Service(BridgeRos2Settings(mount="0,0,0", **told))
    said, shown = [], []
    monkeypatch.setattr(service, "publish", lambda topic, message: said.append((topic, message)))
    monkeypatch.setattr(service.gate, "add_scan", lambda scan, now: shown.append(scan))
    service._on_scan(decode(LASER_SCAN, sweep()))
    ((topic, scan),) = said
    assert topic is SCAN
    assert not np.isnan(Scan.decode(scan.encode()).ranges).any()
    assert is_surface(scan.ranges).sum() == (2 if told else 4)
    assert (~np.isnan(shown[0].ranges)).sum() == near


@pytest.mark.parametrize(("told", "near"), [({}, 3), (TOLD, 2)])
def test_the_controller(monkeypatch, told, near):
    service = ControllerService(ControllerSettings(**told))
    shown = []
    monkeypatch.setattr(service.navigator, "on_scan", shown.append)
    monkeypatch.setattr(service.navigator, "step_without_belief", lambda stamp_ns: None)  # no manual driving
    scan = Scan(stamp_ns=0, angle_min=-1.0, angle_increment=0.5, range_min=0.1, range_max=10.0, ranges=[1, 2, -np.inf])
    service.on_message(SCAN, scan)
    assert (~np.isnan(shown[0].ranges)).sum() == near
