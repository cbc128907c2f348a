"""Health table of the page, missing services, and the list of robots."""

from __future__ import annotations

from common.messages.definitions import Health, TopicHealth
from services.viewer.state.health_rows import MAX_SERVICES, HealthHistory, how_to_start, missing
from services.viewer.state.roster import Roster

SCAN = "presage/robot/scan"


def health(uptime, **row):
    return Health(stamp_ns=1, service="estimator", uptime=uptime, note="hm", topics=[TopicHealth(key=SCAN, **row)])


def test_rates_are_counted_between_two_pulses():
    history = HealthHistory()
    history.add(health(1.0, received=10, rate=9.0), 100.0)
    (row,) = history.rows({"estimator"}, 100.5)
    assert row == {
        "name": "estimator", "alive": True, "age_s": 0.5, "note": "hm", "uptime_s": 1.0,
        "rates": [{"topic": "scan", "published_hz": 0.0, "received_hz": 9.0, "dropped": 0, "undecodable": 0}],
    }  # fmt: skip
    history.add(health(3.0, received=40, dropped=2, undecodable=1), 102.0)
    (row,) = history.rows({"estimator"}, 102.0)
    assert row["rates"] == [{"topic": "scan", "published_hz": 0, "received_hz": 15, "dropped": 2, "undecodable": 1}]


def test_a_service_that_was_started_anew_counts_from_nothing():
    history = HealthHistory()
    history.add(health(50.0, published=700), 100.0)
    history.add(health(1.0, published=15, rate=15.0), 101.0)
    assert history.rows({"estimator"}, 101.0)[0]["rates"][0]["published_hz"] == 15.0


def test_who_is_there_without_a_pulse_and_who_was_there():
    history = HealthHistory()
    history.add(health(1.0), 100.0)
    rows = history.rows({"simulator"}, 110.0)
    assert [(row["name"], row["alive"], row["age_s"]) for row in rows] == [
        ("estimator", False, 10.0), ("simulator", True, None),
    ]  # fmt: skip
    assert [row["name"] for row in history.rows({"simulator"}, 200.0)] == ["simulator"]


def test_invented_services_do_not_fill_memory():
    history = HealthHistory()
    for i in range(1000):
        history.add(Health(stamp_ns=1, service=f"s{i}", uptime=1.0), 1.0)
    assert len(history.rows(set(), 1.0)) == MAX_SERVICES


def test_what_a_robot_lacks():
    assert missing([], linked=False, scans=False) == ["router", "simulator", "estimator", "controller"]
    assert missing(["simulator", "controller"], linked=True, scans=True) == ["estimator"]
    assert missing(["estimator", "controller"], linked=True, scans=True) == []  # a real robot sends them
    assert missing(["replay"], linked=True, scans=False) == []


def test_how_it_is_started():
    assert how_to_start("estimator", "robot") == "python -m services.estimator"
    assert how_to_start("router", "robot", "tcp/10.0.0.1:7447") == "python -m common.router"
    assert how_to_start("estimator", "two", "tcp/10.0.0.1:7447") == (
        "python -m services.estimator --robot two --connect tcp/10.0.0.1:7447"
    )


def test_robots_are_those_with_something_to_see():
    roster = Roster("robot")
    assert roster.robots() == ["robot"]
    roster.change("b", "simulator", True)
    roster.change("a", "replay", True)
    roster.change("c", "viewer", True)
    assert roster.robots() == ["robot", "a", "b"]
    roster.change("b", "estimator", True)
    roster.change("b", "simulator", False)
    assert roster.services("b") == {"estimator"}
    roster.change("b", "estimator", False)
    assert roster.robots() == ["robot", "a"]
    for i in range(1000):
        roster.change(f"r{i}", "simulator", True)
    assert len(roster.robots()) <= 202
