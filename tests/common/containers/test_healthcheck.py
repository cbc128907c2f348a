"""Health of containers, from given heartbeats and from those of a real service."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.containers.healthcheck import fault_of
from common.messages.definitions import Scan
from common.messages.topics import SCAN
from common.runtime.heartbeat import Beat, Heartbeat, read_beats

ROOT = Path(__file__).resolve().parents[3]
SMALL = Path(__file__).parents[1] / "small_service.py"
NOW = 1000.0


def beat(age=0.5, *, linked=True, note="", **ages):
    """``scan__published=3`` means that the count last increased 3 s ago."""
    last = {}
    for name, ago in ages.items():
        topic, kind = name.split("__")
        last.setdefault(f"presage/robot/{topic}", {})[kind] = NOW - ago
    return {"robot": Beat(NOW - age, linked, note, last)}


@pytest.mark.parametrize(
    ("service", "beats", "fault"),
    [
        ("simulator", beat(scan__published=0.5), ""),
        ("simulator", beat(), "robot: no scan was published so far"),
        ("simulator", beat(scan__published=30, note="x"), "robot: scan was not published for 30 s (x)"),
        ("simulator", beat(scan__published=30, note="paused"), ""),
        ("simulator", beat(scan__published=30, note="waits for estimator"), ""),
        ("simulator", {}, "robot: no heartbeat"),
        ("simulator", beat(9, scan__published=0.5), "robot: no heartbeat for 9 s"),
        (
            "simulator",
            beat(scan__published=0.5, linked=False),
            "robot: not connected to any session; is the router running?",
        ),
        ("remote", beat(scan__received=0.5), ""),
        ("remote", beat(scan__received=7), "robot: scan was not received for 7 s"),
        ("estimator", beat(scan__received=0.5, belief__published=0.5), ""),
        ("estimator", beat(), ""),  # nothing to do
        ("estimator", beat(scan__received=60, belief__published=60), ""),
        ("estimator", beat(scan__received=0.5, belief__published=60), "robot: belief was not published for 60 s"),
        ("estimator", beat(scan__received=0.5), "robot: no belief was published so far"),
        ("controller", beat(belief__received=0.5, status__published=8), "robot: status was not published for 8 s"),
        ("controller", beat(belief__received=8, status__published=8), ""),
        ("recorder", beat(odom__received=0.5, scan__written=0.5), ""),
        ("recorder", beat(odom__received=0.5, scan__written=9), "robot: * was not written for 9 s"),
        ("recorder", beat(odom__received=0.5, note="records nothing until told"), ""),
        ("viewer", beat(), ""),
    ],
)
def test_health_follows_from_inputs_and_results(service, beats, fault):
    assert fault_of(service, beats, ["robot"], NOW) == fault


def test_every_robot_of_a_container_must_be_healthy():
    both = {"robot-1": Beat(NOW, linked=True), "robot-2": Beat(NOW - 9, linked=True)}
    assert fault_of("estimator", both, list(both), NOW) == "robot-2: no heartbeat for 9 s"
    assert fault_of("estimator", {"robot-1": both["robot-1"]}, list(both), NOW) == "robot-2: no heartbeat"
    assert fault_of("viewer", {"robot-1": both["robot-1"]}, list(both), NOW) == ""  # one process for both


def test_heartbeats_record_when_counts_increased(tmp_path):
    heart = Heartbeat(tmp_path, "small", "robot")
    heart.beat({"a": {"received": 1}, "b": {"published": 0}}, linked=True)
    first = read_beats(tmp_path, "small")["robot"]
    heart.beat({"a": {"received": 1}, "b": {"published": 2}}, linked=False, note="tired")
    second = read_beats(tmp_path, "small")["robot"]
    assert first.last == {"a": {"received": first.at}}
    assert second == Beat(second.at, linked=False, note="tired", last={**first.last, "b": {"published": second.at}})
    assert second.at >= first.at
    assert read_beats(tmp_path, "other") == {}


def test_invalid_heartbeat_files_are_ignored(tmp_path):
    for number, text in enumerate(("", "{", "[1]", '{"when": 3}')):
        (tmp_path / f"small@{number}.beat").write_text(text)
    assert read_beats(tmp_path, "small") == {}


def check(service, folder=None, **environment):
    """Exit status and message of the command."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")}
    said = {"PYTHONPATH": str(ROOT), **({"PRESAGE_HEARTBEAT": str(folder)} if folder else {})}
    done = subprocess.run(
        [sys.executable, "-m", "common.containers.healthcheck", service],
        env={**clean, **said, **environment}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return done.returncode, done.stderr.strip()


def test_a_frozen_service_is_unhealthy_until_it_continues(bus, process, link, tmp_path):
    running = process(SMALL, "--heartbeat", str(tmp_path))
    beats = lambda: read_beats(tmp_path, "small").get(bus.robot)  # noqa: E731
    assert wait_until(lambda: beats() is not None and beats().linked, 30), running.output
    assert bus.wait_matching(SCAN, 30)
    before = beats().at
    assert check("small", tmp_path, PRESAGE_ROBOT=bus.robot) == (0, "")
    sent = Scan(
        stamp_ns=1, ranges=np.ones(5, np.float32), angle_min=-1.0, angle_increment=0.5, range_min=0.05, range_max=25.0
    )
    assert wait_until(lambda: bus.put(SCAN, sent.encode()) or SCAN.key(bus.robot) in beats().last, 30)
    assert beats().at > before
    running.send(signal.SIGSTOP)
    try:
        frozen = lambda: check("small", tmp_path, PRESAGE_ROBOT=bus.robot)  # noqa: E731
        assert wait_until(lambda: frozen()[0] == 1, 30, period=0.5)
        assert "no heartbeat for" in frozen()[1]
    finally:
        running.send(signal.SIGCONT)
    assert wait_until(lambda: check("small", tmp_path, PRESAGE_ROBOT=bus.robot)[0] == 0, 30, period=0.5)


def test_a_router_is_healthy_if_a_session_opens(router, free_port):
    assert check("router", PRESAGE_CONNECT=f"tcp/127.0.0.1:{router}") == (0, "")
    status, said = check("router", PRESAGE_CONNECT=f"tcp/127.0.0.1:{free_port()}")
    assert status == 1
    assert said.startswith("unhealthy: no session through tcp/127.0.0.1:")


def test_a_service_without_a_heartbeat_is_unhealthy(tmp_path):
    assert check("estimator", tmp_path) == (1, "unhealthy: robot: no heartbeat")
    assert check("estimator", tmp_path, PRESAGE_FLEET="many")[1].startswith("unhealthy: PRESAGE_FLEET='many'")
