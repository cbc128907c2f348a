"""`presage top`: the table of a real session, once and live."""

from __future__ import annotations

import re
import signal

import pytest

from common.bus.bus import wait_until

NAMES = ("simulator", "estimator", "controller")


def words(text: str) -> str:
    """The text without the table's lines, so that wrapped words are joined."""
    return " ".join("".join(" " if c in "│┃─━┏┓┗┛└┘├┤┡┩╇╋┳┬┴┻┼" else c for c in text).split())


def row_of(output: str, service: str) -> str:
    return next(words(line) for line in output.splitlines() if words(line).startswith(service))


def test_healthy_session(process, bus):
    for name in NAMES:
        process(name, *(("--initial-pose", "3,1.5") if name == "estimator" else ()))
    assert wait_until(lambda: set(NAMES) <= bus.alive(), 60)

    tables = []

    def well():
        top = process("presage.__main__", "top", "--once")
        status = top.wait(60)
        tables.append(top.output)
        return status == 0 and "ms" in row_of(top.output, "controller")

    assert wait_until(well, 60), tables[-1]  # the first scans take longer
    output = tables[-1]
    assert f"robot {bus.robot}" in output
    for name, sends in zip(NAMES, ("scan", "belief", "cmd_vel"), strict=True):
        row = row_of(output, name)
        assert row.startswith(f"{name} alive"), output
        assert re.search(rf"{sends} [0-9.]*[1-9]", row), output
    assert "ms" in row_of(output, "estimator")
    assert "not running" in row_of(output, "recorder")
    assert "Traceback" not in output


def test_missing_services_are_listed_with_their_start_commands(process, bus, link):
    controller = process("controller")
    assert wait_until(lambda: "controller" in bus.alive(), 60)
    top = process("presage.__main__", "top", "--once")
    assert top.wait(60) == 1
    assert row_of(top.output, "controller").startswith("controller alive")
    assert row_of(top.output, "estimator").startswith("estimator missing")
    start = f"python -m services.simulator --robot {bus.robot} --connect {link.connect[0]}"
    assert start.replace(" ", "") in words(top.output).replace(" ", "")
    assert controller.running


def test_each_robot_has_its_own_table(process, bus):
    process("controller")
    assert wait_until(lambda: "controller" in bus.alive(), 60)
    top = process("presage.__main__", "top", "--once", "--robot", bus.robot, "--robot", "nobody")
    assert top.wait(60) == 1
    assert row_of(top.output, "controller").startswith("controller alive")
    assert "robot nobody" in top.output
    assert words(top.output).count("controller missing") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_live_table_updates_and_ends_cleanly(process, bus, number):
    top = process("presage.__main__", "top", env={"FORCE_COLOR": "1", "COLUMNS": "160", "LINES": "40"})
    top.wait_for("missing")
    controller = process("controller")
    top.wait_for("alive")
    controller.kill()
    top.wait_for("gone")
    status, seconds = top.stop(number)
    assert status == 0
    assert seconds < 5
    assert "\x1b[?1049h" in top.output
    assert top.output.rstrip().endswith(("\x1b[?25h", "\x1b[?1049l"))  # the terminal is restored
    assert "Traceback" not in top.output


def test_missing_session_is_reported_in_one_line(process):
    top = process("presage.__main__", "top", "--connect", "tcp/127.0.0.1:9")
    assert top.wait(60) == 2
    assert "start a session with `presage up`" in top.output
    assert "Traceback" not in top.output
