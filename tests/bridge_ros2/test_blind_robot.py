"""Bridge and controller mask beams that hit the robot: NaN for their own use, not measured on the bus."""

from __future__ import annotations

import numpy as np
import pytest

from common.bus.inbox import Inbox
from common.messages.definitions import Scan
from common.messages.topics import SCAN
from common.robot.ranges import is_surface
from common.runtime import safety
from common.runtime.service_loop import ServiceLoop
from services.bridge_ros2.ros_types import LASER_SCAN, decode
from services.bridge_ros2.service import BridgeRos2Service
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from tests.bridge_ros2 import cdr
from tests.process_replay.harness import FakeBus

SELF_FILTER = {"ignore_angles": "-5:5", "blind_radius": 0.3}


# At -1, -0.5, 0, 0.5, 1 rad; the last two nearer than 0.3 m, one of them below range_min.
RANGES = [1.0, 2.0, 3.0, 0.25, 0.05]


@pytest.mark.parametrize(("settings", "visible"), [({}, 5), (SELF_FILTER, 2)])
def test_the_bridge(monkeypatch, settings, visible):
    service = BridgeRos2Service(BridgeRos2Settings(mount="0,0,0", **settings))
    published, used = [], []
    monkeypatch.setattr(service, "publish", lambda topic, message: published.append((topic, message)))
    monkeypatch.setattr(safety, "scan_points", used.append)
    service._on_scan(decode(LASER_SCAN, cdr.laser_scan(10**9, RANGES)))
    ((topic, scan),) = published
    assert topic is SCAN
    assert not np.isnan(Scan.decode(scan.encode()).ranges).any()
    assert is_surface(scan.ranges).sum() == (2 if settings else 4)
    assert (~np.isnan(used[0].ranges)).sum() == visible


@pytest.mark.parametrize(("settings", "visible"), [({}, 3), (SELF_FILTER, 2)])
def test_the_controller(monkeypatch, settings, visible):
    service = ControllerService(ControllerSettings(world="", preset="paper", **settings))
    ServiceLoop(service, FakeBus(), Inbox())
    service.open()
    used = []
    monkeypatch.setattr(service.navigator.policy, "prepare", used.append)
    monkeypatch.setattr(service.navigator, "step_without_belief", lambda stamp_ns: None)  # no manual driving
    scan = Scan(stamp_ns=0, angle_min=-1.0, angle_increment=0.5, range_min=0.1, range_max=10.0, ranges=[1, 2, -np.inf])
    service.on_message(SCAN, scan)
    assert (~np.isnan(used[0].ranges)).sum() == visible
