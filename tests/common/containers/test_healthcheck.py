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
from common.containers import healthcheck
from common.containers.healthcheck import find_fault
from common.messages.definitions import Scan
from common.messages.topics import SCAN
from common.runtime.heartbeat import Heartbeat, read_beats
from common.runtime.service_monitor import Report
from tests.conftest import WAIT_TIMEOUT_S

ROOT = Path(__file__).resolve().parents[3]
SMALL = Path(__file__).parents[1] / "small_service.py"
NOW = 1000.0


@pytest.mark.parametrize(
    ("service", "beats", "fault"),
    [
        ("estimator", {"a": Report(NOW), "b": Report(NOW)}, ""),
        ("estimator", {"a": Report(NOW), "b": Report(NOW - 9)}, "b: no report for 9 s"),
        ("estimator", {"a": Report(NOW)}, "b: no heartbeat"),
        ("viewer", {"a": Report(NOW)}, ""),  # one process for all robots
        ("simulator", {"a": Report(NOW, note="n")}, "a: no scan was published so far (n)"),
    ],
)
def test_every_robot_must_be_healthy(service, beats, fault):
    assert find_fault(service, beats, ["a", "b"], NOW)[: len(fault) or None] == fault


def test_times_of_heartbeats(tmp_path):
    heart = Heartbeat(tmp_path, "small", "robot")
    heart.beat({"a": {"received": 1}, "b": {"published": 0}}, linked=True)
    first = read_beats(tmp_path, "small")["robot"]
    heart.beat({"a": {"received": 1}, "b": {"published": 2}}, linked=False, note="n", idle=True)
    second = read_beats(tmp_path, "small")["robot"]
    assert first.increased_at == {"a": {"received": first.time}}
    assert second == Report(second.time, False, "n", True, {**first.increased_at, "b": {"published": second.time}})
    assert second.time >= first.time
    assert read_beats(tmp_path, "other") == {}


def test_invalid_heartbeat_files_are_ignored(tmp_path):
    for number, text in enumerate(("", "{", "[1]", '{"when": 3}')):
        (tmp_path / f"small@{number}.beat").write_text(text)
    assert read_beats(tmp_path, "small") == {}


def check(service, folder=None, **environment):
    """Exit status and message of the command."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")}
    variables = {"PYTHONPATH": str(ROOT), **({"PRESAGE_HEARTBEAT": str(folder)} if folder else {})}
    done = subprocess.run(
        [sys.executable, "-m", "common.containers.healthcheck", service],
        env={**clean, **variables, **environment}, capture_output=True, text=True, timeout=WAIT_TIMEOUT_S,
    )  # fmt: skip
    return done.returncode, done.stderr.strip()


def test_frozen_service(bus, process, link, tmp_path):
    running = process(SMALL, "--heartbeat", str(tmp_path))
    beats = lambda: read_beats(tmp_path, "small").get(bus.robot)  # noqa: E731
    assert wait_until(lambda: beats() is not None and beats().linked, 30), running.output
    assert bus.wait_matching(SCAN, 30)
    before = beats().time
    assert check("small", tmp_path, PRESAGE_ROBOT=bus.robot) == (0, "")
    sent = Scan(
        stamp_ns=1, ranges=np.ones(5, np.float32), angle_min=-1.0, angle_increment=0.5, range_min=0.05, range_max=25.0
    )
    assert wait_until(lambda: bus.put(SCAN, sent.encode()) or SCAN.key(bus.robot) in beats().increased_at, 30)
    assert beats().time > before
    running.send(signal.SIGSTOP)
    try:
        frozen = lambda: check("small", tmp_path, PRESAGE_ROBOT=bus.robot)  # noqa: E731
        assert wait_until(lambda: frozen()[0] == 1, 30, period=0.5)
        assert "no report for" in frozen()[1]
    finally:
        running.send(signal.SIGCONT)
    assert wait_until(lambda: check("small", tmp_path, PRESAGE_ROBOT=bus.robot)[0] == 0, 30, period=0.5)


def test_healthy_router(router, free_port, monkeypatch):
    monkeypatch.setenv("PRESAGE_CONNECT", f"tcp/127.0.0.1:{router}")
    healthcheck.main("router")
    monkeypatch.setenv("PRESAGE_CONNECT", f"tcp/127.0.0.1:{free_port()}")
    monkeypatch.setattr(healthcheck, "CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises(ValueError, match="no session through tcp/127"):
        healthcheck.main("router")


def test_no_heartbeat(tmp_path):
    assert check("estimator", tmp_path) == (1, "unhealthy: robot: no heartbeat")
    assert check("estimator", tmp_path, PRESAGE_FLEET="many")[1].startswith("unhealthy: PRESAGE_FLEET='many'")
