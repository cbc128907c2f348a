"""Findings of `presage doctor`: none in a healthy session, a problem just beyond each limit."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from common.bus.bus import DEFAULT_ENDPOINT
from common.messages.definitions import Health, Pose, Scan, TopicHealth
from common.messages.topics import BELIEF, CMD_VEL, PREDICTION, SCAN, TOPICS, TRUTH
from common.runtime.protocol_check import build_config_reply
from common.runtime.service_monitor import REPORT_TIMEOUT_S, RESULT_TIMEOUT_S, ServiceMonitor
from common.runtime.session_files import session_file
from presage.diagnosis.bus_observation import BusObservation, check_endpoint
from presage.diagnosis.rules import MAX_CLOCK_DIFFERENCE_S, evaluate_observation
from services.recorder.files.message_counts import SequenceNumbers

SECOND = 1_000_000_000
NAMES = ("simulator", "estimator", "controller")


def health(service: str, at: int, *, delay: float = 0.001, note: str = "", counters=None, **row) -> tuple[int, Health]:
    rows = [TopicHealth(key=SCAN.key("robot"), **row)]
    message = Health(stamp_ns=at, service=service, uptime=9, topics=rows, note=note, counters=counters or {})
    return at + int(delay * 1e9), message


def observed(alive=NAMES, *, seconds=3.0, reporting=NAMES) -> BusObservation:
    """A session in which nothing is wrong besides the services that are not alive or not reporting."""
    seen = BusObservation("robot", seconds, ServiceMonitor("robot"), robots={"robot"})
    seen.monitor.set_alive(alive, 0.0)
    seen.arrivals = Counter({t.key("robot"): int(t.rate * seconds) for t in TOPICS if t.rate and not t.per_service})
    for name in {*alive} & {*reporting}:
        seen.replies[name] = [build_config_reply(name, "{}", 5.0)]
        seen.health[name] = [health(name, n * SECOND, received=100 + 15 * n) for n in (1, 2, 3)]
        seen.monitor.add_health(seen.health[name][0][1], seconds)
    numbers = seen.sequences[SCAN.key("robot")] = SequenceNumbers()
    for number in (7, 8, 9, 0, 1, 2):  # its publisher was restarted
        numbers.add(number)
    return seen


def scan_message(**changes) -> Scan:
    fields = {"angle_min": -1.5, "angle_increment": 0.01, "range_min": 0.1, "range_max": 9.0, "ranges": np.ones(301)}
    return Scan(stamp_ns=1, **{**fields, **changes})


def findings(seen: BusObservation, code: str):
    return [
        finding for finding in evaluate_observation(seen, build_config_reply("doctor", "{}")) if finding.code == code
    ]


def problems(seen: BusObservation) -> set[str]:
    return {
        finding.code
        for finding in evaluate_observation(seen, build_config_reply("doctor", "{}"))
        if finding.ok is False
    }


@pytest.mark.parametrize(
    ("seen", "codes"),
    [
        (observed(), set()),
        (observed(["replay"], reporting=[]), set()),
        (observed(["simulator", "controller"]), {"missing"}),
        (observed(reporting=NAMES[:2]), {"frozen"}),
        (observed(reporting=NAMES[:2], seconds=REPORT_TIMEOUT_S - 0.1), set()),
    ],
)
def test_presence(seen, codes):
    assert problems(seen) == codes


def test_services_of_a_known_session():
    """Its own commands start the missing ones; those that it was started without are not missing."""
    seen = observed(["simulator", "controller"])
    assert {finding.where for finding in findings(seen, "missing")} == {*NAMES, "recorder", "viewer"}
    commands = {"estimator": "python -m services.estimator --world=office"}
    with session_file(DEFAULT_ENDPOINT, ["robot"], None, commands):
        missing = {finding.where: finding.advice for finding in findings(seen, "missing")}
    assert missing.keys() == set(NAMES)
    assert missing["estimator"] == "start it with: python -m services.estimator --world=office"


@pytest.mark.parametrize(
    ("estimator", "controller", "codes"),
    [
        ("office", "worlds/office.yaml", set()),
        ("office", "", set()),  # while mapping
        ("corridor", "office", {"worlds"}),
    ],
)
def test_worlds(estimator, controller, codes):
    seen = observed()
    for name, world in {"simulator": "office", "estimator": estimator, "controller": controller}.items():
        seen.replies[name] = [build_config_reply(name, json.dumps({"world": world}), 5.0)]
    assert problems(seen) == codes
    for finding in findings(seen, "worlds"):
        assert "(office: simulator, controller; corridor: estimator)" in finding.what


def test_missing_results():
    seen, later = observed(), RESULT_TIMEOUT_S + 4
    for name in NAMES:
        seen.monitor.add_health(seen.health[name][-1][1], later)
    seen.seconds, seen.arrivals = later, Counter({key: 3 * count for key, count in seen.arrivals.items()})
    simulator, estimator = findings(seen, "no_result")
    assert "simulator of 'robot': no scan was published for" in simulator.what
    assert "estimator of 'robot': no belief was published for" in estimator.what


def test_other_robots_are_named():
    seen = BusObservation("robot", 3.0, ServiceMonitor("robot"), robots={"two"})
    (finding,) = findings(seen, "no_such_robot")
    assert "two" in finding.what


def test_slow_scanner():
    seen = observed()
    for key in seen.arrivals:
        seen.arrivals[key] = 17  # 5.7 Hz
    for stated, codes in ((None, {"rate"}), (1 / 5.5, set()), (1 / 40, {"rate"})):
        seen.scan = stated and scan_message(scan_time=stated)
        assert problems(seen) == codes


@pytest.mark.parametrize("factor", [0.5, 2.0])  # 2: two controllers
def test_rate_of_commands(factor):
    seen = observed()
    seen.arrivals[CMD_VEL.key("robot")] = int(45 * factor)
    assert problems(seen) == {"rate"}


def test_real_robot():
    """A ROS robot takes the simulator's place, has a scan rate of its own, and no ground truth."""
    seen = observed(["bridge_ros2", "estimator", "controller"], reporting=["bridge_ros2", *NAMES])
    seen.arrivals = Counter({key: int(number / 3) for key, number in seen.arrivals.items()})  # 5 Hz
    seen.arrivals[TRUTH.key("robot")] = 0
    assert not problems(seen)
    seen.arrivals[BELIEF.key("robot")] = 3
    assert problems(seen) == {"rate"}
    seen.arrivals[SCAN.key("robot")] = 0
    advice = {finding.advice for finding in findings(seen, "rate") if finding.ok is False}
    assert any("published by the bridge_ros2" in each for each in advice)
    assert not any("simulator" in finding.what for finding in findings(seen, "missing"))


def test_mapping():
    """A mapper takes the estimator's place, and predicts no scans."""
    seen = observed(["simulator", "mapper", "controller"], reporting=["mapper", *NAMES])
    seen.arrivals[PREDICTION.key("robot")] = 0
    assert not problems(seen)
    assert not any("estimator" in finding.what for finding in findings(seen, "missing"))


def test_estimator_without_predictions():
    """They are optional for an estimator of one's own; without beliefs, their lack is a problem."""
    seen = observed()
    seen.arrivals[PREDICTION.key("robot")] = 0
    assert not problems(seen)
    assert any("prediction: none" in finding.what for finding in findings(seen, "rate"))
    seen.arrivals[BELIEF.key("robot")] = 0
    assert [each.what.split(":")[0] for each in findings(seen, "rate") if each.ok is False] == ["belief", "prediction"]


def test_recorder_beside_an_idle_one():
    """`presage record` runs beside the idle recorder of `presage up`."""
    seen = observed()
    idle = Health(stamp_ns=0, service="recorder", uptime=9, instance="a", idle=True, note="not recording")
    busy = Health(stamp_ns=0, service="recorder", uptime=2, instance="b", counters={"failed": 3})
    seen.health["recorder"] = [(0, idle), (0, busy), (0, idle)]
    assert not findings(seen, "note")
    assert not problems(seen)
    seen.health["recorder"] = [(0, idle), (0, idle)]
    assert findings(seen, "note")[0].what == "recorder reports: not recording"


def test_doubled_services():
    for name, codes in (("controller", {"doubled"}), ("recorder", set())):
        seen = observed([*NAMES, name], reporting=[*NAMES, name])
        seen.replies[name] = 2 * seen.replies[name]
        assert problems(seen) == codes


@pytest.mark.parametrize(
    ("changes", "ok", "words"),
    [
        ({}, True, "301 beams from -85.94 deg on, 0.573 deg apart, mounted at (0, 0) m, 0 deg"),
        ({"angle_min": 1.5, "angle_increment": -0.01}, True, "clockwise as if upside down"),
        ({"mount": Pose(x=-0.2, y=0.0, yaw=3.0)}, None, "mounted at (-0.2, 0) m, 171.9 deg"),
        ({"angle_increment": 0.05}, False, "2.86 deg apart"),
    ],
)
def test_scanner(changes, ok, words):
    seen = observed()
    seen.scan = scan_message(**changes)
    (finding,) = findings(seen, "scanner")
    assert finding.ok is ok
    assert words in finding.what
    assert bool(finding.advice) == (ok is not True)


@pytest.mark.parametrize(("factor", "codes"), [(0.9, set()), (1.1, {"clocks"}), (-1.1, {"clocks"})])
def test_clocks(factor, codes):
    seen, delay = observed(), factor * MAX_CLOCK_DIFFERENCE_S
    # The difference is that of the fastest message.
    seen.health["estimator"] = [health("estimator", n * SECOND, delay=delay + slow) for n, slow in ((1, 9.0), (2, 0.0))]
    assert problems(seen) == codes


@pytest.mark.parametrize(
    ("service", "counts", "codes"),
    [
        ("estimator", {"dropped": (1, 2)}, set()),
        ("estimator", {"dropped": (9, 18)}, {"dropped_rising"}),
        ("viewer", {"dropped": (9, 18)}, set()),  # it only needs the newest messages
        ("estimator", {"undecodable": (50, 50)}, set()),
        ("estimator", {"undecodable": (50, 51)}, {"undecodable_rising"}),
    ],
)
def test_rising_counts(service, counts, codes):
    seen, ((name, values),) = observed(), counts.items()
    seen.health[service] = [
        health(service, n * SECOND, received=30 * n, counters={"failed": 3}, **{name: value})
        for n, value in zip((1, 2), values, strict=True)
    ]
    assert problems(seen) == codes


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "serial//dev/ttyS0"])
def test_only_tcp_endpoints_are_checked(endpoint):
    assert check_endpoint(endpoint) is None


@pytest.mark.parametrize(
    ("stamp_ns", "words"),
    [
        (lambda _: 0, "do not advance with time (0 s in 2.93 s)"),
        (lambda t: int(1e3 * t), "do not advance with time (2.93e-06 s in 2.93 s)"),  # milliseconds
        (lambda t: int(1e9 * (0.1 * t % 0.2)), ""),  # a slow simulation, which begins again
    ],
)
def test_stamps_of_scans(stamp_ns, words):
    seen = observed()
    seen.scan_stamps = [(int(n / 15 * SECOND), stamp_ns(n / 15)) for n in range(45)]
    (finding,) = findings(seen, "stamps")
    assert (finding.ok, words in finding.what) == (not words, True)
    for alive, config in (([*NAMES, "replay"], "{}"), (NAMES, '{"pace": "lockstep"}')):  # there, time may stand still
        seen.monitor.set_alive(alive, 0.0)
        seen.replies["simulator"] = [build_config_reply("simulator", config, 5.0)]
        assert not problems(seen)


@pytest.mark.parametrize(("delay_ns", "ok"), [(0, True), (1, False)])
def test_stamps_of_beliefs(delay_ns, ok):
    seen = observed()
    stamps = [n * SECOND // 15 for n in range(45)]
    seen.scan_stamps = list(zip(stamps, stamps, strict=True))
    seen.belief_stamps = [stamp + delay_ns for stamp in [-SECOND // 15, *stamps]]
    (_, finding) = findings(seen, "stamps")
    assert finding.ok is ok
    assert f"{45 if ok else 0} of 46" in finding.what
