"""The command line: invalid input gives one clear line with advice and a non-zero status, without a traceback."""

from __future__ import annotations

import socket

import pytest

from common.bus.bus import wait_until
from tests.conftest import Processes
from tests.recorder import sessions as made

MAX_PARALLEL = 4
NO_SESSION = ("--connect", "tcp/127.0.0.1:9")  # the discard port, on which nothing listens


INVALID_COMMANDS = [
    (("up", "--world", "nowhere"), "give a file or one of corridor, maze, office"),
    (("up", "--model", "exakt", "--port", "0"), "presage: no model 'exakt': give learned, exact"),
    (("up", "--drive", "sideways", "--port", "0"), "presage: drive: Input should be 'holonomic' or 'differential'"),
    (("up", "--config", "{tmp}/wrong.yaml", "--port", "0"), "presage: speed: Extra inputs are not permitted"),
    (("demo", "--world", "{tmp}/no.yaml"), "give a file or one of"),
    (("demo", "--goal", "6.8", "3.95"), "goal (6.80, 3.95) is inside a wall or outside 'corridor'"),
    (("up", "--world", "maze", "--estimator", "paper", "--port", "0"), "presage train --world maze"),
    (("goal", "1", "1", *NO_SESSION), "start a session with `presage up`"),
    (("goal",), "X Y in m"),
    (("goal", "-1", "2", *NO_SESSION), "start a session"),
    (("goal", "nan", "1"), "nan 1: a place is finite numbers"),
    (("goal", "1", "1", "--tolerance", "inf"), "--tolerance inf"),
    (("goal", "1", "2", "--wiat"), "--wiat"),
    (("goal", "1e300", "1"), "1e+300 1: X and Y must be within 10000 m of the origin"),
    (("teleport", "inf", "1"), "inf 1 90: a place is finite numbers"),
    (("teleport", "-1", "-1.5", "-90", *NO_SESSION), "start a session"),
    (("obstacle", "add", "crate", "-1", "2", "--radius", "-1"), "the obstacle: circle.radius"),
    (("obstacle", "add", "crate", "1", "2", *NO_SESSION), "start a session"),
    (("relocalise", "nan", "1"), "a place is finite numbers"),
    (("relocalise", "-1", "-.5", *NO_SESSION), "start a session"),
    (("relocalise", "1"), "a position is two numbers"),
    (("demo", "--goal", "nan", "1"), "two finite numbers"),
    (("demo", "--out", "/dev/null/x"), "/dev/null/x: cannot be written to"),
    (("demo", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to"),
    (("demo", "--seed", "99999999999999999999"), "--seed"),
    (("demo", "--world", "{tmp}/bad.yaml"), "bad.yaml: not valid YAML"),
    (("plot", "{tmp}/run.mcap", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to"),
    (("plot", "{tmp}/run.mcap", "--out", "/proc/no.png"), "/proc/no.png: cannot be written to"),
    (("train", "--out", "/dev/null/m"), "/dev/null/m: cannot be written to"),
    (("record", "--out", "/dev/null"), "/dev/null: cannot be written to"),
    (("teleport", "1", "1", *NO_SESSION), "start a session"),
    (("echo", "nothing"), "no topic 'nothing': choose one of scan"),
    (("hz", *NO_SESSION), "start a session"),
    (("replay", "{tmp}/no.mcap"), "no.mcap"),
    (("replay", "{tmp}/run.mcap", *NO_SESSION), "start a session"),
    (("plot", "{tmp}/foreign.mcap"), "foreign.mcap"),
    (("train", "--preset", "better"), "no preset 'better'"),
    (("train", "--scanner", "sonar", "--out", "{tmp}/m"), "no scanner 'sonar': choose one of tim571"),
    (("doctor", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to"),
    (("record", "--topics", "smell", "--out", "{tmp}/r"), "smell"),
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory, router):
    """All `INVALID_COMMANDS`, run to their end; several in parallel, because most wait for a missing session."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "foreign.mcap").write_bytes(b"no recording at all, but long enough to be looked at twice")
    (folder / "wrong.yaml").write_text("controller: {speed: 1}")
    (folder / "bad.yaml").write_text("since: 2020-13-45")
    made.write(folder / "run.mcap")
    children = Processes(folder)
    environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{router}", "PRESAGE_ROBOT": "wrong"}
    try:
        for number, (args, _) in enumerate(INVALID_COMMANDS):
            if number >= MAX_PARALLEL:
                children.started[number - MAX_PARALLEL].wait(90)
            children.start("presage.__main__", *[a.format(tmp=folder) for a in args], env=environment)
        yield children.started
    finally:
        children.close()


@pytest.mark.parametrize(
    "number", range(len(INVALID_COMMANDS)), ids=lambda number: " ".join(INVALID_COMMANDS[number][0])[:40]
)
def test_bad_input_is_one_line(finished, number):
    running, says = finished[number], INVALID_COMMANDS[number][1]
    assert running.wait(90) not in {0, None}
    assert "Traceback" not in running.output, running.output
    messages = [line for line in running.output.splitlines() if says in line]
    assert messages, running.output


def test_port_in_use_is_reported(process):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        running = process("presage.__main__", "up", "--port", str(taken.getsockname()[1]))
        assert running.wait(60) == 2
    assert "cannot be used" in running.output
    assert "--port" in running.output
    assert "Traceback" not in running.output


def test_tools_on_a_running_session(process, bus, link):
    process("simulator")
    process("estimator")
    process("controller")
    assert wait_until(lambda: {"simulator", "estimator", "controller"} <= bus.alive(), 60)

    def run(*args):
        running = process("presage.__main__", *args)
        return running.wait(60), running.output

    assert run("echo", "belief", "-n", "2")[1].count('"estimator": "') == 2
    status, text = run("hz", "scan", "--seconds", "2")
    assert status == 0
    assert "presage/" in text
    assert run("teleport", "3.5", "1.5")[0] == 0
    status, text = run("teleport", "0.1", "0.1")
    assert status == 2
    assert "from a wall of 'corridor'" in text
    assert run("obstacle", "add", "crate", "12", "1.5", "--yaw", "30")[0] == 0
    assert run("obstacle", "move", "crate", "13", "1.5")[0] == 0
    assert 'crate: {"box":{"center":[13.0,1.5],"size":[0.5,0.5],"yaw_deg":30.0}}' in run("obstacle", "list")[1]
    status, text = run("obstacle", "add", "crate", "13", "1.5")
    assert status == 2
    assert "already an obstacle 'crate'" in text
    assert run("obstacle", "remove", "crate")[0] == 0
    status, text = run("goal", "0.1", "0.1")
    assert status == 2
    assert "the nearest place that can be reached is" in text
    assert run("relocalise", "3.5", "1.5")[0] == 0
    assert run("goal", "4", "1.5", "90", "--wait")[0] == 0
    assert run("goal", "--cancel")[0] == 0
    status, text = run("doctor")
    faults = [line for line in text.splitlines() if line.split()[:1] == ["no"]]
    assert all(" Hz" in line for line in faults), text  # a machine under load may be slow
    assert status == (1 if faults else 0)
    for there in ("simulator", "estimator", "controller"):
        assert f"{there} of '{link.robot}': alive" in text
    assert f"recorder of '{link.robot}': not running" in text
    assert "python -m services.recorder" in text
    assert "presage/ROBOT/scan" in run("topics")[1]
