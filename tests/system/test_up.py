"""`presage demo` and `presage up`: the whole system from one command, and nothing left when it ends."""

from __future__ import annotations

import json
import signal

import psutil
import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.errors import UserError
from common.geometry.world import World, save_world
from common.messages.definitions import Belief, Health, Truth
from common.messages.topics import BELIEF, GOAL, HEALTH, SCAN, STATUS, TRUTH
from common.runtime.session_files import running_sessions, start_command
from presage.live.latest_messages import LatestMessages
from presage.session.demo import FIRST_BELIEF_TIMEOUT_S, _check_estimator
from services.recorder.reader import read_recording
from tests.conftest import WAIT_TIMEOUT_S, ended
from tests.recorder import sessions as made
from tests.viewer.client import Page

BACKGROUND = """
import runpy, signal
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a script's background commands
runpy.run_module("presage", run_name="__main__")
"""

# Three rooms, so large that not all is explored when the demo carries the robot off.
ROOMS = World(
    name="rooms",
    boundary=[(0, 0), (10, 0), (10, 5), (0, 5)],
    obstacles=[
        {"box": {"center": (4.0, 1.8), "size": (0.2, 3.6)}},
        {"box": {"center": (7.0, 3.2), "size": (0.2, 3.6)}},
        {"box": {"center": (1.2, 4.6), "size": (0.8, 0.5), "yaw_deg": 20}},
        {"circle": {"center": (9.2, 4.2), "radius": 0.3}},
    ],
    start={"x": 1.5, "y": 1.5, "yaw_deg": 0},
)


def test_demo_reaches_its_goal(process, tmp_path):
    out, file, config = tmp_path / "out", tmp_path / "demo.json", tmp_path / "lockstep.yaml"
    config.write_text("simulator: {pace: lockstep, beams: 311}")
    args = ("--config", str(config), "--out", str(out), "--json", str(file))
    running = process("presage.__main__", "demo", *args)
    assert wait_until(lambda: list(out.glob("*.mcap.active")) or not running.running, 60), running.output
    made.write(out / "another.mcap")  # a file of another program, written during the demo
    assert running.wait(170) == 0, running.output
    numbers = json.loads(file.read_text())
    assert numbers["goal_reached"]
    assert numbers["straight_line_m"] >= 12
    assert numbers["localised_after_scans"] >= 1
    assert numbers["localised_error_m"] < 0.5
    assert numbers["goal_distance_m"] < 0.02 + 0.3
    assert numbers["contacts"] == 0
    assert numbers["scans"] > 100
    (path,) = out.glob("presage*.mcap")
    assert {each.name for each in out.iterdir()} == {"another.mcap", path.name, path.with_suffix(".png").name}
    recording = read_recording(path)
    assert next(recording.messages(SCAN))[1].seq == 0  # the simulation waited for the other services
    # No scan is lost. On a slow machine a scan is sent again, and only such repetitions may be dropped.
    scans, beliefs = ({message.stamp_ns for _, message, _ in recording.messages(topic)} for topic in (SCAN, BELIEF))
    assert scans - beliefs <= {max(scans)}
    simulated = [health for _, health, _ in recording.messages(HEALTH) if health.service == "simulator"]
    assert numbers["dropped"] == 0 or simulated[-1].counters.get("scans_sent_again", 0) > 0, numbers["dropped_by_key"]
    (goal,) = [message for _, message, _ in recording.messages(GOAL)]
    assert {message.goal_seq for _, message, _ in recording.messages(STATUS) if message.goal} == {goal.seq} != {0}
    for word in (
        "page: http://127.0.0.1:",
        "distance to goal",
        "localisation error",
        "scans",
        "dropped",
        "goal reached",
    ):
        assert word in running.output


def test_demo_in_an_unknown_building(process, tmp_path):
    file, config, world = (tmp_path / name for name in ("demo.json", "lockstep.yaml", "rooms.yaml"))
    world.write_text(save_world(ROOMS))
    config.write_text(f"world: {world}\nsimulator: {{pace: lockstep, beams: 121}}")
    args = ("--config", str(config), "--out", str(tmp_path / "out"), "--json", str(file), "--quiet")
    running = process("presage.__main__", "demo", "--unknown", *args)
    assert running.wait(170) == 0, running.output
    numbers = json.loads(file.read_text())
    assert numbers["world"] == "rooms"
    for step, words in zip(numbers["steps"], ("explored a", "kidnapped", "a goal", "returned"), strict=True):
        assert words in step["what"]
        assert step["error_m"] < 0.1, numbers
    assert numbers["steps"][-1]["mapped_share"] > 0.9
    assert numbers["contacts"] == 0
    (path,) = (tmp_path / "out").glob("*.mcap")
    assert {each.name for each in path.parent.iterdir()} == {path.name, path.with_suffix(".png").name}


def test_demo_without_a_belief():
    note = "the scan does not fit the weights; presage train --beams 100"
    health = Health(stamp_ns=0, service="estimator", uptime=1.0, counters={"unfit_scans": 1}, note=note)
    with pytest.raises(UserError, match=f"the estimator publishes no belief; its health reports: {note}"):
        _check_estimator(health, 1.0)
    _check_estimator(None, FIRST_BELIEF_TIMEOUT_S - 1)
    with pytest.raises(UserError, match="no belief came within"):
        _check_estimator(None, FIRST_BELIEF_TIMEOUT_S + 1)


@pytest.fixture
def up(process, free_port, tmp_path):
    """A function that runs `presage up` until all are alive. Returns it, its child processes and its port."""
    (tmp_path / "background.py").write_text(BACKGROUND)

    def start(*args, **env):
        port = free_port()
        args = ("up", "--port", str(port), *args)
        running = process(tmp_path / "background.py", *args, env={"PRESAGE_VIEWER_PORT": "0", **env})
        running.wait_for("all alive", WAIT_TIMEOUT_S)
        return running, psutil.Process(running.child.pid).children(), port

    return start


def test_up_with_page_and_dead_service(up):
    running, children, _ = up("--world", "corridor")
    assert len(children) == 6  # router, simulator, estimator, controller, viewer and an idle recorder
    (where,) = [line.split()[-1] for line in running.output.splitlines() if line.startswith("page:")]
    with Page(where) as page:
        assert page.wait_for("world")["world"]["name"] == "corridor"
        assert page.frame(lambda header: header["belief"] is not None)
        page.wait_for("services", lambda message: len(message["services"]) == 5 and not message["missing"])
        assert page.done("record", action="status")["recording"] is False
    next(child for child in children if "services.estimator" in child.cmdline()).kill()
    running.wait_for("estimator ended with status -9")
    assert "python -m services.estimator" in running.output
    (session,) = running_sessions()
    command = start_command("estimator", session.robots[0], session.endpoint, session)
    assert f"again with: {command}" in running.output
    assert "PRESAGE_VIEWER_PORT=0" in command
    assert command.endswith("python -m services.estimator --world=corridor")
    assert [ended(child) for child in children].count(False) == 5
    assert running.stop(signal.SIGINT) == 130
    assert wait_until(lambda: all(map(ended, children)), 10)


def test_up_with_two_robots(up):
    running, children, port = up("--robots", "2", "--no-viewer", PRESAGE_ROBOT="r", PRESAGE_BEAMS="181")
    assert "page:" not in running.output
    assert len(children) == 6  # a simulator and a controller for each robot, one router and one estimator
    for robot in ("r-1", "r-2"):
        with open_bus(Link(robot, (f"tcp/127.0.0.1:{port}",))) as bus:
            messages = LatestMessages(bus, BELIEF, TRUTH)
            assert messages.wait_for(Belief, lambda belief: belief.state == "tracking", WAIT_TIMEOUT_S)
            belief = messages.latest["belief"]
            truth = messages.wait_for(
                Truth, lambda truth, stamp=belief.stamp_ns: truth.stamp_ns >= stamp, WAIT_TIMEOUT_S
            )
            assert abs(belief.pose.x - truth.pose.x) < 0.3
            alive = {"estimator", "simulator", "controller"}
            assert wait_until(lambda bus=bus, alive=alive: bus.alive() == alive, WAIT_TIMEOUT_S), bus.alive()
    assert running.stop(signal.SIGTERM) == 130
    assert wait_until(lambda: all(map(ended, children)), 10)


def test_killed_up_leaves_no_process(up):
    running, children, _ = up("--no-viewer")
    running.kill()
    assert wait_until(lambda: all(map(ended, children)), 10)
