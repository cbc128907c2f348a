"""Health table of the page, and the list of robots."""

from __future__ import annotations

from common.messages.definitions import Health, TopicHealth
from common.runtime.service_monitor import ServiceMonitor
from services.viewer.state.health_rows import rows_of
from services.viewer.state.roster import Roster


def test_rows():
    monitor = ServiceMonitor("robot")
    topics = [
        TopicHealth(key="presage/robot/scan", received=10, rate=9.0, dropped=2),
        TopicHealth(key="presage/robot/belief", published=10, rate=8.0, undecodable=1),
    ]
    monitor.add_health(Health(stamp_ns=1, service="estimator", uptime=1.0, note="n", topics=topics), 100.0)
    monitor.set_alive({"simulator"}, 100.4)
    simulator, estimator = rows_of(monitor, 100.5)
    assert estimator == {
        "name": "estimator", "state": "alive", "alive": True, "age_s": 0.5, "note": "n", "uptime_s": 1.0, "idle": False,
        "rates": [
            {"topic": "scan", "published_hz": 0.0, "received_hz": 9.0, "dropped": 2, "undecodable": 0},
            {"topic": "belief", "published_hz": 8.0, "received_hz": 0.0, "dropped": 0, "undecodable": 1},
        ],
    }  # fmt: skip
    assert simulator == {
        "name": "simulator", "state": "alive", "alive": True, "age_s": None, "note": "", "uptime_s": None,
        "idle": False, "rates": [],
    }  # fmt: skip
    simulator, estimator = rows_of(monitor, 110.0)
    assert (simulator["state"], estimator["state"], estimator["alive"]) == ("silent", "absent", False)


def test_roster():
    roster = Roster("robot")
    assert roster.robots() == ["robot"]
    for robot, service in (("b", "simulator"), ("a", "replay"), ("c", "viewer"), ("b", "estimator")):
        roster.change(robot, service, True)
    assert roster.robots() == ["robot", "a", "b"]
    roster.change("b", "simulator", False)
    assert roster.services("b") == {"estimator"}
    roster.change("b", "estimator", False)
    assert roster.robots() == ["robot", "a"]
    for i in range(1000):
        roster.change(f"r{i}", "simulator", True)
    assert len(roster.robots()) <= 202
