"""One process for each robot, with real child processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import psutil
import pytest

from common.bus.bus import wait_until
from common.containers.run_per_robot import main, robot_names
from tests.conftest import WAIT_TIMEOUT_S

CHILD = """
import os, signal, sys, time
from pathlib import Path
signal.signal(signal.SIGTERM, lambda *_: (print("bye", flush=True), os._exit(0)))
robot, folder = os.environ["PRESAGE_ROBOT"], Path(sys.argv[1])
with (folder / robot).open("a") as file:
    file.write(f"{os.getpid()}\\n")
if sys.argv[2:]:
    sys.exit(int(sys.argv[2]) if robot.endswith("-2") else 0)
print("here", os.environ.get("PRESAGE_ROBOTS"), flush=True)
time.sleep(600)
"""


@pytest.fixture
def fleet(process, tmp_path):
    """Starts the launcher with the child program above."""
    (tmp_path / "child.py").write_text(CHILD)

    def start(mode, count, *args):
        path = os.pathsep.join([str(tmp_path), str(Path(__file__).resolve().parents[3])])
        environment = {"PRESAGE_FLEET": count, "PRESAGE_ROBOT": "robot", "PYTHONPATH": path}
        return process("common.containers.run_per_robot", mode, "child", str(tmp_path), *args, env=environment)

    return start


def started(folder, robot):
    """Process ids, one for each start."""
    path = folder / robot
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def test_robot_names():
    assert robot_names({}) == robot_names({"PRESAGE_FLEET": "1"}) == robot_names({"PRESAGE_FLEET": ""}) == ["robot"]
    assert robot_names({"PRESAGE_FLEET": "3"}) == ["robot-1", "robot-2", "robot-3"]
    assert robot_names({"PRESAGE_FLEET": "2", "PRESAGE_ROBOT": "truck"}) == ["truck-1", "truck-2"]
    assert robot_names({"PRESAGE_ROBOT": "truck"}) == ["truck"]


@pytest.mark.parametrize("text", ["0", "-1", "three", "1000", "101", "1.5"])
def test_invalid_numbers_of_robots(text):
    with pytest.raises(ValueError, match="expected the number of robots, 1 to 100"):
        robot_names({"PRESAGE_FLEET": text})


@pytest.mark.parametrize("argv", [["every", "child"], ["each"]])
def test_invalid_arguments_are_refused(argv, capsys):
    assert main(argv) == 2
    assert "give each, together or once" in capsys.readouterr().err


def test_restarted_process(fleet, tmp_path):
    running = fleet("each", "3")
    robots = ["robot-1", "robot-2", "robot-3"]
    assert wait_until(lambda: all(started(tmp_path, robot) for robot in robots), WAIT_TIMEOUT_S), running.output
    running.wait_for("robot-3 | here None")
    os.kill(started(tmp_path, "robot-2")[0], signal.SIGKILL)
    assert wait_until(lambda: len(started(tmp_path, "robot-2")) == 2, WAIT_TIMEOUT_S), running.output
    assert "robot-2 | ended with status -9; started again in 1 s" in running.output
    assert len(started(tmp_path, "robot-1")) == len(started(tmp_path, "robot-3")) == 1
    assert running.stop() == 0
    assert running.output.count("bye") >= 2  # the one just started may not have come to its handler
    assert not [pid for robot in robots for pid in started(tmp_path, robot) if psutil.pid_exists(pid)]


def test_killed_launcher(fleet, tmp_path):
    running = fleet("each", "2")
    running.wait_for("robot-1 | here")
    running.wait_for("robot-2 | here")
    children = started(tmp_path, "robot-1") + started(tmp_path, "robot-2")
    running.kill()
    assert wait_until(lambda: not any(psutil.pid_exists(pid) for pid in children), WAIT_TIMEOUT_S)


def test_once_ends_with_the_worst_status(fleet, tmp_path):
    running = fleet("once", "3", "7")
    assert running.wait() == 7
    assert [len(started(tmp_path, f"robot-{number}")) for number in (1, 2, 3)] == [1, 1, 1]


@pytest.mark.parametrize(
    ("mode", "count", "expected"), [("together", "2", "here robot-1,robot-2"), ("each", "1", "here None")]
)
def test_single_process(fleet, tmp_path, mode, count, expected):
    running = fleet(mode, count)
    running.wait_for(expected)
    assert started(tmp_path, "robot-1" if count == "2" else "robot") == [running.child.pid]
    assert running.stop() == 0
