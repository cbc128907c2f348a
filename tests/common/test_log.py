"""JSON logging: every line of a real process is a JSON object."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from common.bus.bus import wait_until
from common.log_capture import CapturedLine, parse_line
from common.messages.definitions import Goal, Pose
from common.messages.topics import GOAL
from presage.session.stack import _log_text
from tests.conftest import ROOT, WAIT_TIMEOUT_S

HEAD = ["time", "level", "service", "robot", "event"]


def objects(text: str) -> list[dict]:
    found = [json.loads(line) for line in text.splitlines()]
    assert all(list(each)[:5] == HEAD for each in found), text
    return found


def test_lines_as_json():
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    noisy = Path(__file__).with_name("noisy_process.py")
    done = subprocess.run(
        [sys.executable, str(noisy)], env=environment, capture_output=True, text=True, timeout=WAIT_TIMEOUT_S
    )
    assert done.returncode == 1
    assert done.stdout == "printed text\n"
    found = {line["event"]: line for line in objects(done.stderr)}
    numbers = found["numbers"]
    assert (numbers["nan"], numbers["inf"], numbers["text"]) == ("NaN", ["Infinity"], 'two\nlines "quoted"')
    assert (numbers["service"], numbers["robot"], numbers["level"]) == ("noisy", "", "info")
    assert found["another's"]["robot"] == "r2"
    assert (found["native on stdout"]["logger"], found["native on stdout"]["level"]) == ("stdout", "info")
    assert (found["� native on stderr"]["logger"], found["from Python to stderr"]["level"]) == ("stderr", "warning")
    assert any("a warning" in event for event in found)
    assert "in thread" not in found
    thread, uncaught = found["ValueError: in a thread"], found["RuntimeError: uncaught"]
    assert uncaught["level"] == thread["level"] == "critical"
    assert "Traceback" in uncaught["exception"]
    assert "in fail" in thread["exception"]


def test_exceptions_and_zenohs_lines(process, bus):
    small = Path(__file__).with_name("small_service.py")
    running = process(small, "--log-json", env={"RUST_LOG": "info"})
    assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), running.output
    assert bus.wait_matching(GOAL, WAIT_TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=-1.0, y=0.0)).encode())
    running.wait_for("step failed")
    assert running.stop() == 0
    found = objects(running.output)
    assert {(line["service"], line["robot"]) for line in found} == {("small", bus.robot)}
    failed = next(line for line in found if line["event"] == "step failed")
    assert failed["level"] == "error"
    assert failed["so_far"] == 1
    assert "a bug in on_message" in failed["exception"]
    assert any(line.get("logger", "").startswith("zenoh::") for line in found)
    assert found[-1]["event"] == "ended"


def test_the_routers_lines_are_json_objects(processes, free_port):
    port = free_port()
    running = processes.start("common.router", "--listen", f"tcp/127.0.0.1:{port}", "--log-json")
    running.wait_for("router listens")
    assert running.stop() == 0
    assert {line["service"] for line in objects(running.output)} == {"router"}


@pytest.mark.parametrize(
    ("args", "says"),
    [(("--listen", "nonsense"), "no session with"), (("--log-level", "loud"), "log_level"), (("--bogus",), "--bogus")],
)
def test_user_errors_are_json_objects(processes, args, says):
    running = processes.start("common.router", *args, env={"PRESAGE_LOG_JSON": "true"})
    assert running.wait() == 2
    assert says in objects(running.output)[-1]["event"]


def test_zenohs_lines_are_parsed():
    zenoh = (
        "\x1b[2m2026-01-02T03:04:05.017181Z\x1b[0m \x1b[33m WARN\x1b[0m net-0 ThreadId(04) "
        "\x1b[2mzenoh::net::runtime\x1b[0m\x1b[2m:\x1b[0m Unable to connect: refused\n"
    )
    assert parse_line(zenoh, "stdout") == CapturedLine("warning", "zenoh::net::runtime", "Unable to connect: refused")
    assert parse_line("thread 'x' panicked", "stderr") == CapturedLine("warning", "stderr", "thread 'x' panicked")
    pybullet = "pybullet build time: Jan 29 2025 23:17:20"
    assert parse_line(pybullet, "stderr") == CapturedLine("info", "stderr", pybullet)
    assert parse_line("  \n", "stdout") is None


def test_text_output_is_still_readable():
    assert _log_text('{"event": "page: http://x/"}') == "page: http://x/"
    assert _log_text("page: http://x/") == "page: http://x/"
    assert _log_text("[1]") == "[1]"
