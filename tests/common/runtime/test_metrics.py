"""Prometheus metrics of real processes, and of a loop that serves several robots."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.definitions import Belief, Health, Pose, Scan, Status, TopicHealth
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, SCAN, STATUS
from common.runtime.metrics import METRICS, LoopCounts, ServiceMetrics
from common.runtime.metrics_server import split_address
from tests.conftest import ROOT, WAIT_TIMEOUT_S

SMALL = Path(__file__).parents[1] / "small_service.py"
SAMPLES = {row.sample: row for row in METRICS}


def read(text: str) -> dict[tuple[str, frozenset], float]:
    """Values of a scrape by sample name and labels; checks help texts and labels against the table of metrics."""
    found = {}
    for metric in text_string_to_metric_families(text):
        if metric.name.startswith(("process_", "python_")):
            continue
        for sample in metric.samples:
            row = SAMPLES.get(sample.name) or next(
                m for m in METRICS if m.kind == "histogram" and m.name == metric.name
            )
            assert metric.documentation == row.about
            assert set(sample.labels) - {"le"} == set(row.labels), sample
            found[sample.name, frozenset(sample.labels.items())] = sample.value
    return found


def value(found, name: str, **labels) -> float | None:
    """Value of the only sample that has these labels, perhaps among others, or None."""
    matches = [number for (n, own), number in found.items() if n == name and labels.items() <= dict(own).items()]
    assert len(matches) <= 1
    return matches[0] if matches else None


def address_of(running) -> str:
    running.wait_for("/metrics")
    return "http://" + running.output.split("http://", 1)[1].split()[0].strip("\x1b[0m'\"")


def scrape(address: str) -> str:
    with urllib.request.urlopen(address, timeout=WAIT_TIMEOUT_S) as answer:
        return answer.read().decode()


def scan(stamp: int) -> bytes:
    ranges = np.ones(5)
    return Scan(stamp_ns=stamp, angle_min=0, angle_increment=0.1, range_min=0, range_max=9, ranges=ranges).encode()


def test_metrics_of_a_real_service(bus, process):
    running = process(SMALL, "--metrics", "0")
    address = address_of(running)
    assert address.startswith("http://127.0.0.1:")
    assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), running.output
    commands = Inbox()
    bus.subscribe(CMD_VEL, commands, keep_all=True)
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    assert bus.wait_matching(HEALTH, WAIT_TIMEOUT_S, key=HEALTH.key(bus.robot, "intruder"))
    for number in range(5):
        bus.put(SCAN, scan(number))
        assert wait_until(lambda n=number: commands.received.total() == n + 1, WAIT_TIMEOUT_S)
    bus.put(HEALTH, b"\xc1", key=HEALTH.key(bus.robot, "intruder"))
    found = {}

    def up_to_date() -> bool:
        found.update(read(scrape(address)))
        undecodable = value(found, "presage_messages_undecodable_total", topic="health/intruder")
        rate = value(found, "presage_message_rate_hertz", topic="health/small")
        return undecodable == 1 and bool(rate)

    assert wait_until(up_to_date, WAIT_TIMEOUT_S), found
    assert value(found, "presage_message_latency_seconds_bucket", topic="scan", le="+Inf") == 5
    labels = {"robot": bus.robot, "service": "small"}
    for name, topic, expected in (
        ("presage_messages_received_total", "scan", 5),
        ("presage_messages_published_total", "cmd_vel", 5),
        ("presage_messages_dropped_total", "scan", 0),
        ("presage_step_duration_seconds_count", "scan", 5),
        ("presage_message_latency_seconds_count", "scan", 5),
    ):
        assert value(found, name, **labels, topic=topic) == expected, name
    assert value(found, "presage_events_total", **labels, event="scans") == 5
    assert value(found, "presage_steps_failed_total", **labels) == 0
    assert value(found, "presage_build_info", **labels) == 1
    assert value(found, "presage_uptime_seconds", **labels) > 0
    assert "process_cpu_seconds_total" in scrape(address)
    assert running.stop() == 0
    assert "Traceback" not in running.output


def test_lazy_import_of_prometheus():
    program = "import sys, common.runtime.service, common.router; print('prometheus_client' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_port_in_use_is_explained(process):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        running = process(SMALL, env={"PRESAGE_METRICS": str(taken.getsockname()[1])})
        assert running.wait() == 2
    (line,) = running.output.splitlines()
    assert line.startswith("small: --metrics")
    assert "choose another port" in line


def test_metrics_of_the_router(processes, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    running = processes.start("common.router", "--listen", endpoint, "--metrics", "127.0.0.1:0")
    address = address_of(running)
    with open_bus(Link(connect=(endpoint,))) as bus:
        assert wait_until(bus.linked, WAIT_TIMEOUT_S)
        assert wait_until(lambda: value(read(scrape(address)), "presage_router_sessions") == 1, WAIT_TIMEOUT_S)
    assert value(read(scrape(address)), "presage_build_info", service="router") == 1
    assert running.stop() == 0


def metrics_of(service: str, **counts) -> ServiceMetrics:
    none = LoopCounts(published={}, undecodable={}, failed=0, events={}, began=time.monotonic())
    return ServiceMetrics("robot", service, Inbox(), lambda: replace(none, **counts))


def belief(state: str, energy: float) -> Belief:
    pose = Pose(x=0.0, y=0.0)
    return Belief(stamp_ns=0, state=state, pose=pose, xi=np.zeros(3), free_energy=energy, probability=0.25)


def values_of(metrics) -> dict:
    return read(generate_latest(metrics.registry).decode())


def test_several_robots_in_one_process():
    metrics = metrics_of("estimator", published={BELIEF.key("two"): 7})
    for robot, state, energy in (("one", "lost", 1.0), ("one", "tracking", 5.5), ("two", "lost", -2.0)):
        metrics.published(BELIEF.key(robot), belief(state, energy))
        with metrics.step(Sample(SCAN, SCAN.key(robot), b"", time.time_ns(), 0)):
            pass
    found = values_of(metrics)
    assert value(found, "presage_free_energy_nats", robot="one") == 5.5
    assert value(found, "presage_free_energy_nats", robot="two") == -2.0
    assert value(found, "presage_pose_probability", robot="two") == 0.25
    assert value(found, "presage_estimator_state", robot="one", state="tracking") == 1
    assert value(found, "presage_estimator_state", robot="one", state="lost") == 0
    assert value(found, "presage_estimator_state", robot="two", state="lost") == 1
    assert value(found, "presage_messages_published_total", robot="two", topic="belief") == 7
    assert value(found, "presage_step_duration_seconds_count", robot="two", topic="scan") == 1


def test_controller_and_recorder():
    controller, recorder = metrics_of("controller"), metrics_of("recorder", events={"written": 9, "written_bytes": 900})
    controller.published(STATUS.key("robot"), Status(stamp_ns=0, state="blocked"))
    rows = [TopicHealth(key=SCAN.key("robot"), written=9, missing=2, rate=15.0)]
    recorder.published(HEALTH.key("robot", "recorder"), Health(stamp_ns=0, service="recorder", uptime=1, topics=rows))
    found = {**values_of(controller), **values_of(recorder)}
    assert value(found, "presage_controller_state", state="blocked") == 1
    assert value(found, "presage_controller_state", state="navigating") == 0
    assert value(found, "presage_recorder_messages_written_total", topic="scan") == 9
    assert value(found, "presage_recorder_messages_missing_total", topic="scan") == 2
    assert value(found, "presage_recorder_written_bytes_total") == 900
    assert value(found, "presage_message_rate_hertz", topic="scan") == 15
    assert value(found, "presage_events_total", event="written_bytes") is None


def test_timing_of_steps():
    metrics = metrics_of("estimator")
    with pytest.raises(ValueError, match="bug"), metrics.step(Sample(GOAL, "odd", b"", 0, 0)):
        raise ValueError("bug")
    with metrics.step(Sample(SCAN, SCAN.key("robot"), b"", time.time_ns() + 10**10, 0)):  # the clocks differ
        pass
    found = values_of(metrics)
    assert value(found, "presage_step_duration_seconds_count", robot="", topic="odd") == 1
    assert value(found, "presage_message_latency_seconds_count", topic="odd") == 0  # its time of publication is unknown
    assert value(found, "presage_message_latency_seconds_sum", topic="scan") == 0


@pytest.mark.parametrize(
    ("setting", "address"),
    [("9100", ("127.0.0.1", 9100)), ("0.0.0.0:0", ("0.0.0.0", 0)), ("[::1]:9", ("::1", 9)), ("box:80", ("box", 80))],
)
def test_addresses(setting, address):
    assert split_address(setting) == address


@pytest.mark.parametrize("setting", ["70000", "box", "", "-1"])
def test_invalid_addresses_are_refused(setting):
    with pytest.raises(UserError, match="PORT or HOST:PORT"):
        split_address(setting)
