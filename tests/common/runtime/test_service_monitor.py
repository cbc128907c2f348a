"""Which services are alive, late or absent, and what is wrong with them."""

from __future__ import annotations

import pytest

from common.messages.definitions import Health, TopicHealth
from common.runtime.service_monitor import (
    FORGET_AFTER_S,
    INPUT_TIMEOUT_S,
    MAX_SERVICES,
    REPORT_TIMEOUT_S,
    REQUIRED_SERVICES,
    RESULT_TIMEOUT_S,
    Report,
    ServiceMonitor,
    find_problem,
)

NOW = 1000.0


def health(service, uptime=9.0, note="", idle=False, instance="", **counts) -> Health:
    """``scan__received=3``: three scans were received."""
    rows = [
        TopicHealth(key=f"presage/robot/{topic}", **{kind: count})
        for topic, kind, count in ((*name.split("__"), count) for name, count in counts.items())
    ]
    return Health(stamp_ns=0, service=service, uptime=uptime, note=note, idle=idle, instance=instance, topics=rows)


def states(monitor, now) -> dict[str, str]:
    return {each.name: each.state for each in monitor.services(now) if each.since is not None}


def service(monitor, name, now):
    return next(each for each in monitor.services(now) if each.name == name)


def report(age=0.5, *, linked=True, idle=False, **ages) -> Report:
    """``scan__published=3``: the count last increased 3 s ago."""
    last = {}
    for name, ago in ages.items():
        topic, kind = name.split("__")
        last.setdefault(f"presage/robot/{topic}", {})[kind] = NOW - ago
    return Report(NOW - age, linked, "", idle, last)


@pytest.mark.parametrize(
    ("name", "reported", "problem"),
    [
        ("simulator", report(scan__published=0.5), ""),
        ("simulator", report(), "no scan was published so far"),
        ("simulator", report(scan__published=30), "no scan was published for 30 s"),
        ("simulator", report(scan__published=30, idle=True), ""),
        ("simulator", report(9, scan__published=0.5), "no report for 9 s"),
        ("simulator", report(scan__published=0.5, linked=False), "not connected to any session"),
        ("simulator", report(idle=True, linked=False), "not connected to any session"),
        ("remote", report(scan__received=0.5), ""),
        ("remote", report(scan__received=7), "no scan was received for 7 s"),
        ("estimator", report(scan__received=0.5, belief__published=0.5), ""),
        ("estimator", report(), ""),  # without input
        ("estimator", report(scan__received=60, belief__published=60), ""),
        ("estimator", report(scan__received=0.5, belief__published=60), "no belief was published for 60 s"),
        ("estimator", report(scan__received=0.5), "no belief was published so far"),
        ("controller", report(belief__received=0.5, status__published=8), "no status was published for 8 s"),
        ("recorder", report(odom__received=0.5, scan__written=0.5), ""),
        ("recorder", report(odom__received=0.5, scan__written=9), "no message was written for 9 s"),
        ("recorder", report(odom__received=0.5, idle=True), ""),
        ("viewer", report(), ""),
    ],
)
def test_problems(name, reported, problem):
    found = find_problem(name, "robot", reported, NOW)
    assert found.startswith(problem)
    assert bool(found) == bool(problem)


def test_states_over_time():
    monitor = ServiceMonitor("robot")
    monitor.set_alive({"controller"}, 10.0)
    assert states(monitor, 10.0 + REPORT_TIMEOUT_S) == {"controller": "alive"}
    assert states(monitor, 10.1 + REPORT_TIMEOUT_S) == {"controller": "silent"}
    monitor.add_health(health("controller", note="n"), 20.0)
    found = service(monitor, "controller", 20.4)
    assert (found.state, found.since, found.text, found.has_started) == ("alive", 10.0, "n", True)
    assert found.age == pytest.approx(0.4)
    silent = service(monitor, "controller", 21.0 + REPORT_TIMEOUT_S)
    assert (silent.state, silent.since) == ("silent", 20.0 + REPORT_TIMEOUT_S)
    assert silent.text == f"{silent.problem} (n)"
    monitor.set_alive(set(), 21.0)
    assert states(monitor, 21.0) == {"controller": "alive"}  # its token may be missing for a moment
    gone = service(monitor, "controller", 30.0)
    assert (gone.state, gone.since, gone.problem) == ("absent", 20.0, "gone for 10 s")
    monitor.add_health(health("controller"), 31.0)
    assert service(monitor, "controller", 31.0).since == 31.0  # a new life
    monitor.set_alive(set(), 31.1 + FORGET_AFTER_S)
    assert states(monitor, 31.1 + FORGET_AFTER_S) == {}


@pytest.mark.parametrize(
    ("alive", "scans", "missing"),
    [
        ([], False, ["simulator", "estimator", "controller"]),
        (["simulator", "controller"], False, ["estimator"]),
        (["estimator", "controller"], True, []),  # a real robot's driver publishes them
        (["bridge_ros2"], False, ["estimator", "controller"]),
        (["replay"], False, []),
    ],
)
def test_missing_services(alive, scans, missing):
    monitor = ServiceMonitor("robot")
    if scans:
        monitor.add_scan(NOW)
    monitor.set_alive(alive, NOW)
    assert monitor.missing(NOW + INPUT_TIMEOUT_S) == missing
    monitor.set_alive(alive, NOW + 9)
    absent = {each.name for each in monitor.services(NOW + 9) if each.problem and each.state == "absent"}
    assert absent == {*missing, *(["simulator"] if scans else [])}
    if "replay" in alive:  # it sends no health messages
        assert service(monitor, "replay", NOW + 9).state == "alive"
        assert service(monitor, "replay", NOW + 9).has_started


def test_results_that_stop():
    monitor = ServiceMonitor("robot")
    for second in range(20):  # beliefs end after 10 s
        counts = {"scan__received": 15 * second + 1, "belief__published": min(15 * second, 150)}
        monitor.add_health(health("estimator", 9.0 + second, **counts), NOW + second)
        expected = "" if second <= 10 + RESULT_TIMEOUT_S else f"no belief was published for {second - 10} s"
        assert service(monitor, "estimator", NOW + second).problem == expected
    monitor.add_health(health("estimator", 1.0, scan__received=15), NOW + 20)  # restarted: has time to begin
    assert service(monitor, "estimator", NOW + 20).problem == ""
    monitor.add_health(health("simulator", idle=True), NOW)
    assert service(monitor, "simulator", NOW + 1).problem == ""


def test_invented_services_are_limited():
    monitor = ServiceMonitor("robot")
    for number in range(1000):
        monitor.add_health(health(f"s{number}"), NOW)
    monitor.set_alive(REQUIRED_SERVICES, NOW)
    assert len(states(monitor, NOW)) <= MAX_SERVICES + len(REQUIRED_SERVICES)
    assert set(REQUIRED_SERVICES) <= states(monitor, NOW).keys()


def test_working_instance_hides_an_idle_one():
    """`presage record` starts a second recorder beside the one that waits for a request."""
    monitor = ServiceMonitor("robot")
    ready = {"idle": True, "note": "not recording", "instance": "ready"}
    monitor.add_health(health("recorder", uptime=9.0, **ready), NOW)
    monitor.add_health(health("recorder", uptime=1.0, instance="records"), NOW + 0.5)
    monitor.add_health(health("recorder", uptime=10.0, **ready), NOW + 1)
    assert service(monitor, "recorder", NOW + 1).health.instance == "records"
    monitor.add_health(health("recorder", uptime=13.0, **ready), NOW + 4)
    assert service(monitor, "recorder", NOW + 4).health.instance == "ready"
