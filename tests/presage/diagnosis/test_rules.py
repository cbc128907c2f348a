"""What the doctor makes of what it saw: nothing where all is well, a fault just past each limit."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from common.messages.definitions import Health, Pose, Scan, TopicHealth
from common.messages.topics import BELIEF, CMD_VEL, SCAN, TOPICS, TRUTH
from common.runtime.protocol_check import build_config_reply
from presage.diagnosis.bus_observation import BusObservation, check_endpoint
from presage.diagnosis.health_board import HEALTH_TIMEOUT_S
from presage.diagnosis.rules import MAX_CLOCK_DIFFERENCE_S, evaluate
from services.recorder.files.message_counts import Sequence

SECOND = 1_000_000_000
NAMES = ("simulator", "estimator", "controller")


def pulse(service: str, at: int, *, late: float = 0.001, note: str = "", counters=None, **row) -> tuple[int, Health]:
    rows = [TopicHealth(key=SCAN.key("robot"), **row)]
    health = Health(stamp_ns=at, service=service, uptime=9, topics=rows, note=note, counters=counters or {})
    return at + int(late * 1e9), health


def well() -> BusObservation:
    seen = BusObservation("robot", 3.0, alive={*NAMES}, robots={"robot"})
    seen.arrivals = Counter({t.key("robot"): int(t.rate * 3) for t in TOPICS if t.rate and not t.per_service})
    for name in NAMES:
        seen.replies[name] = [build_config_reply(name, "{}", 5.0)]
        seen.health[name] = [pulse(name, n * SECOND, received=100 + 15 * n) for n in (1, 2, 3)]
    numbers = seen.sequences[SCAN.key("robot")] = Sequence()
    for number in (7, 8, 9, 0, 1, 2):  # it began anew
        numbers.see(number)
    return seen


def a_scan(**changes) -> Scan:
    fields = {"angle_min": -1.5, "angle_increment": 0.01, "range_min": 0.1, "range_max": 9.0, "ranges": np.ones(301)}
    return Scan(stamp_ns=1, **{**fields, **changes})


def test_a_slow_scanner_is_no_fault_and_one_slower_than_it_says_is():
    seen = well()
    for key in seen.arrivals:
        seen.arrivals[key] = 17  # 5.7 Hz
    assert faults(seen) == {"rate"}
    seen.scan = a_scan(scan_time=1 / 5.5)
    assert faults(seen) == set()
    seen.scan = a_scan(scan_time=1 / 40)
    assert faults(seen) == {"rate"}


@pytest.mark.parametrize(
    ("changes", "ok", "words"),
    [
        ({}, True, "301 beams from -85.94 deg on, 0.573 deg apart, mounted at (0, 0) m, 0 deg"),
        ({"angle_min": 1.5, "angle_increment": -0.01}, True, "clockwise as if upside down"),
        ({"mount": Pose(x=-0.2, y=0.0, yaw=3.0)}, None, "mounted at (-0.2, 0) m, 171.9 deg"),
        ({"angle_increment": 0.0}, False, "0 deg apart"),
        ({"angle_increment": 0.05}, False, "2.86 deg apart"),
    ],
)
def test_the_scanner_is_described_and_judged(changes, ok, words):
    seen = well()
    seen.scan = a_scan(**changes)
    (finding,) = [f for f in evaluate(seen, build_config_reply("doctor", "{}")) if f.code == "scanner"]
    assert finding.ok is ok
    assert words in finding.what
    assert bool(finding.advice) == (ok is not True)


def faults(seen: BusObservation) -> set[str]:
    return {finding.code for finding in evaluate(seen, build_config_reply("doctor", "{}")) if finding.ok is False}


def test_where_all_is_well_nothing_is_found():
    assert not faults(well())


@pytest.mark.parametrize(
    ("late", "wrong"),
    [
        (MAX_CLOCK_DIFFERENCE_S * 0.9, False),
        (MAX_CLOCK_DIFFERENCE_S * 1.1, True),
        (-MAX_CLOCK_DIFFERENCE_S * 1.1, True),
    ],
)
def test_clocks_may_differ_so_much(late, wrong):
    seen = well()
    seen.health["estimator"] = [pulse("estimator", n * SECOND, late=late + slow) for n, slow in ((1, 9.0), (2, 0.0))]
    assert faults(seen) == ({"clocks"} if wrong else set())


def test_a_short_look_finds_nobody_frozen():
    seen = well()
    del seen.health["controller"]
    assert faults(seen) == {"frozen"}
    seen.seconds = HEALTH_TIMEOUT_S - 0.1
    assert "frozen" not in faults(seen)


def test_few_drops_are_worth_knowing_many_are_a_fault_a_viewer_s_are_none():
    for dropped, wrong in ((1, False), (9, True)):
        seen = well()
        rows = [pulse("estimator", n * SECOND, received=30 * n, dropped=dropped * n) for n in (1, 2)]
        seen.health["estimator"] = rows
        assert faults(seen) == ({"dropped_rising"} if wrong else set())
    viewer = well()
    viewer.health["viewer"] = [pulse("viewer", n * SECOND, received=30 * n, dropped=9 * n) for n in (1, 2)]
    assert not faults(viewer)


def test_counts_of_long_ago_do_not_rise():
    seen = well()
    seen.health["estimator"] = [pulse("estimator", n * SECOND, undecodable=50, counters={"failed": 3}) for n in (1, 2)]
    assert not faults(seen)


def test_twice_as_many_commands_are_two_drivers_and_few_are_too_few():
    for factor in (0.5, 2.0):
        seen = well()
        seen.arrivals[CMD_VEL.key("robot")] = int(45 * factor)
        assert faults(seen) == {"rate"}


def test_a_replay_stands_for_the_others():
    seen = well()
    seen.alive, seen.health = {"replay"}, {}
    assert not faults(seen)


def test_another_robot_s_name_is_said():
    seen = BusObservation("robot", 3.0, robots={"two"})
    found = [
        finding for finding in evaluate(seen, build_config_reply("doctor", "{}")) if finding.code == "no_such_robot"
    ]
    assert "two" in found[0].what


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "serial//dev/ttyS0"])
def test_what_is_no_tcp_port_is_left_to_zenoh(endpoint):
    assert check_endpoint(endpoint) is None


def test_a_robot_in_ros_stands_for_the_simulator_with_a_rate_of_its_own_and_no_truth():
    seen = well()
    seen.alive = {*NAMES, "bridge_ros2"} - {"simulator"}
    for store in (seen.replies, seen.health):
        store["bridge_ros2"] = store.pop("simulator")
    seen.arrivals = Counter({key: int(number / 3) for key, number in seen.arrivals.items()})  # 5 Hz
    seen.arrivals[TRUTH.key("robot")] = 0
    assert "missing" not in faults(seen)
    assert "rate" not in faults(seen)
    seen.arrivals[BELIEF.key("robot")] = 3
    assert "rate" in faults(seen)
