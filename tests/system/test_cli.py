"""The command line: one clear line and status 2 for invalid input, and the tools beside a running session."""

from __future__ import annotations

import re
import socket

import pytest
import typer

from common.bus.bus import wait_until
from presage.cli.main import app
from tests.conftest import WAIT_TIMEOUT_S
from tests.recorder import sessions as made
from tests.system.test_diagnosis import row_of

NO_SESSION = ("--connect", "tcp/127.0.0.1:9")  # the discard port, on which nothing listens


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("up", "--world", "nowhere"), "give a file or one of corridor, maze, office"),
        (("up", "--model", "exakt", "--port", "0"), "no model 'exakt': give learned, exact"),
        (("up", "--drive", "sideways", "--port", "0"), "drive: expected 'holonomic' or 'differential', not 'sideways'"),
        (("up", "--config", "{tmp}/wrong.yaml", "--port", "0"), "speed: unknown key"),
        (("up", "--world", "maze", "--estimator", "paper", "--port", "0"), "presage train --world maze"),
        (("demo", "--world", "{tmp}/bad.yaml"), "bad.yaml: not valid YAML"),
        (("demo", "--goal", "6.8", "3.95"), "goal (6.80, 3.95) in corridor is inside something, or off the map"),
        (("demo", "--goal", "nan", "1"), "two finite numbers"),
        (("demo", "--unknown", "--goal", "1", "1"), "leave out --goal and --estimator"),
        (("demo", "--out", "/dev/null/x"), "/dev/null/x: cannot be written to"),
        (("demo", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to"),
        (("demo", "--seed", "99999999999999999999"), "--seed"),
        (("goal",), "X Y in m"),
        ((*NO_SESSION, "goal", "-1", "2"), "start a session with `presage up`"),
        (("goal", "nan", "1"), "nan 1: a place is finite numbers"),
        (("goal", "1", "1", "--tolerance", "inf"), "--tolerance inf"),
        (("goal", "1", "1", "--approach", "nan"), "--approach nan"),
        (("goal", "1", "2", "900"), "1 2 900: YAW must be from -360 to 360 deg"),
        (("goal", "1", "2", "--approach", "-900"), "--approach -900: give a direction from -360 to 360 deg"),
        (("goal", "1", "2", "--wiat"), "--wiat"),
        (("goal", "1e300", "1"), "1e+300 1: X and Y must be within 10000 m of the origin"),
        (("obstacle", "add", "crate", "-1", "2", "--radius", "-1"), "the obstacle: circle.radius"),
        (("relocalise", "1"), "a position is two numbers"),
        (("plot", "{tmp}/run.mcap", "--out", "/proc/no.png"), "/proc/no.png: cannot be written to"),
        (("plot", "{tmp}/bad.yaml"), "bad.yaml"),
        (("bench", "latency", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to (No such file or directory)"),
        (("train", "--preset", "better"), "no preset 'better'"),
        (("train", "--scanner", "sonar", "--out", "{tmp}/m"), "no scanner 'sonar': choose one of tim571"),
        (("record", "--topics", "smell", "--out", "{tmp}/r"), "smell"),
        (("echo", "nothing"), "no topic 'nothing': choose one of scan"),
        (("doctor", "--json", "{tmp}/no/x.json"), "x.json: cannot be written to"),
        (("replay", "{tmp}/no.mcap"), "no.mcap"),
        (("replay", "{tmp}/run.mcap", "--robot", "a/b"), "robot 'a/b'"),
        (("replay", "{tmp}/run.mcap", "--every-scan"), "go with --with"),
        (("replay", "{tmp}/run.mcap", "--with", "simulator"), "give estimator, or estimator,controller"),
        (("replay", "{tmp}/run.mcap", "--with", "estimator"), "the estimator's configuration was not recorded"),
        (
            ("replay", "{tmp}/run.mcap", "--with", "estimator", "--loop"),
            "leave out the options that choose what to replay",
        ),
        (("experiment", "--out", "{tmp}/e", "e1", "--alpha", "nan"), "--alpha"),
        (("experiment", "--out", "{tmp}/e", "e1", "--trials", "0"), "--trials"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, tuple) else "",
)
def test_invalid_input(presage, tmp_path, args, says):
    (tmp_path / "bad.yaml").write_text("since: 2020-13-45")
    (tmp_path / "wrong.yaml").write_text("controller: {speed: 1}")
    if "{tmp}/run.mcap" in args:
        made.write(tmp_path / "run.mcap")
    status, output = presage(*[arg.format(tmp=tmp_path) for arg in args])
    assert status == 2
    assert [line for line in output.splitlines() if says in line], output
    assert "Usage" in output or len(output.splitlines()) == 1


def test_port_in_use(presage):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        status, output = presage("up", "--port", str(taken.getsockname()[1]))
    assert (status, "cannot be used" in output, "--port" in output) == (2, True, True)


@pytest.mark.parametrize(
    "name", [name for name, c in typer.main.get_command(app).commands.items() if not hasattr(c, "commands")]
)
def test_help_with_an_example(presage, name):
    status, output = presage(name, "--help")
    assert (status, "Example" in output, f"presage {name}" in output) == (0, True, True), output


def test_tools_beside_a_session(presage, process, bus, link, monkeypatch):
    monkeypatch.setenv("PRESAGE_CONNECT", link.connect[0])
    monkeypatch.setenv("PRESAGE_ROBOT", link.robot)
    names = ("simulator", "estimator", "controller")
    for name in names:
        process(name)
    assert wait_until(lambda: set(names) <= bus.alive(), 60)
    for command, status, says in (
        ("echo belief -n 2", 0, '"estimator": "'),
        ("hz scan --seconds 1", 0, "presage/"),
        ("hz goal --seconds 0.1", 2, "goal within 0.1 s: `presage top` shows which services run"),
        ("--robot other hz --seconds 0.1", 2, "no robot 'other' is running: choose one of"),
        ("teleport 3.5 1.5 -90", 0, ""),
        ("teleport 0.1 0.1", 2, "from a wall, and the robot needs"),
        ("obstacle add crate 12 1.5 --yaw 30", 0, ""),
        ("obstacle move crate 13 1.5", 0, ""),
        ("obstacle list", 0, 'crate: {"box":{"center":[13.0,1.5],"size":[0.5,0.5],"yaw_deg":30.0}}'),
        ("obstacle add crate 13 1.5", 2, "already an obstacle 'crate'"),
        ("obstacle remove crate", 0, ""),
        ("goal 0.1 0.1", 2, "the nearest place that can be reached is"),
        ("relocalise 3.5 1.5", 0, "\ntracking at (3."),
        ("goal 4 1.5 90 --wait", 0, "reached"),
        ("goal --cancel", 0, ""),
        ("save-map here", 2, "no mapper is running"),
        ("topics", 0, "presage/ROBOT/scan"),
    ):
        found, output = presage(*command.split())
        assert (found, says in output) == (status, True), (command, output)
    outputs = []

    def healthy():
        status, output = presage("top", "--once")
        outputs.append(output)
        rates = zip(names, ("scan", "belief", "cmd_vel"), strict=True)
        return (
            status == 0
            and all(re.search(rf"^{name} alive.* {topic} [0-9.]*[1-9]", row_of(output, name)) for name, topic in rates)
            and all("ms" in row_of(output, name) for name in names[1:])
        )

    assert wait_until(healthy, WAIT_TIMEOUT_S), outputs[-1]  # the first scans take longer
    assert f"robot {link.robot}" in outputs[-1]
    assert "not running" in row_of(outputs[-1], "recorder")

    def sound():
        status, output = presage("doctor")
        outputs.append(output)
        faults = [line for line in output.splitlines() if line.split()[:1] == ["no"]]
        assert status == (1 if faults else 0)
        # This machine may be slow, and another test that runs at the same time may have stopped a process.
        slow = re.compile(r" *no +\w+: (?!0\.0 )[\d.]+ of [\d.]+ Hz +published by ")
        return all(slow.match(line) or "of this machine is stopped" in line for line in faults)

    assert wait_until(sound, WAIT_TIMEOUT_S), outputs[-1]  # while the machine is busy, scans may be dropped
    output = outputs[-1]
    for name in names:
        assert f"{name} of '{link.robot}': alive" in output
    assert f"recorder of '{link.robot}': not running" in output
    assert "python -m services.recorder" in output
