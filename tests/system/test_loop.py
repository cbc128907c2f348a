"""The whole loop as processes over zenoh: lockstep runs are reproducible, and a replay gives the same beliefs."""

from __future__ import annotations

import json
import signal

import psutil
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Belief, Goal, Health, Pose, Scan
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, ODOM, PREDICTION, SCAN, STATUS, TRUTH
from services.recorder.reader import read_recording
from tests.conftest import wait_for_message
from tests.recorder import sessions as made
from tests.viewer.client import Page

SCANS = 90
REPEATED = (SCAN, ODOM, TRUTH, BELIEF, PREDICTION, STATUS, CMD_VEL)


def run_in_lockstep(process, bus, folder, name):
    """Records localisation and driving for SCANS scans. Returns the payloads by topic."""
    inbox = Inbox()
    for topic in (SCAN, HEALTH):
        bus.subscribe(topic, inbox, keep_all=True)
    driver = f"driver-{name}"  # the simulator waits for this token, so that the goal is set before the first scan
    started = [
        process("recorder", "--directory", str(folder), "--file", f"{name}.mcap"),
        process("controller", "--belief-timeout", "60"),
        process("estimator", "--initial-pose", "3.2,1.4"),
        process(
            "simulator", "--beams", "622", "--pace", "lockstep", "--seed", "3",
            "--wait-for", f"estimator,controller,recorder,{driver}",
        ),
    ]  # fmt: skip
    assert wait_until(lambda: {"recorder", "controller", "estimator", "simulator"} <= bus.alive(), 60)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=15.5, y=1.5)).encode())
    goal_key = GOAL.key(bus.robot)
    wait_for_message(
        inbox, Health, lambda h: h.service == "controller" and any(t.key == goal_key and t.received for t in h.topics)
    )
    bus.declare_alive(driver)
    wait_for_message(inbox, Scan, lambda scan: scan.seq >= SCANS)
    for running in reversed(started):
        assert running.stop()[0] == 0, running.output
    raw = read_recording(folder / f"{name}.mcap").raw
    return {topic.name: [r.payload for r in raw if r.key == topic.key(bus.robot)][:SCANS] for topic in REPEATED}


def test_lockstep_with_a_seed_is_reproducible_byte_for_byte(process, bus, tmp_path):
    first = run_in_lockstep(process, bus, tmp_path, "first")
    second = run_in_lockstep(process, bus, tmp_path, "second")
    for topic in REPEATED:
        assert len(first[topic.name]) == SCANS, topic.name
        assert first[topic.name] == second[topic.name], topic.name
    moved = [TRUTH.message.decode(p).pose.x for p in first["truth"]]
    assert moved[-1] - moved[0] > 1.0  # the robot really moved


def test_recorded_scans_give_the_recorded_beliefs(process, bus, tmp_path):
    recorded = run_in_lockstep(process, bus, tmp_path, "run")
    inbox = Inbox()
    bus.subscribe(BELIEF, inbox, keep_all=True)
    process("estimator", "--initial-pose", "3.2,1.4")
    assert wait_until(lambda: "estimator" in bus.alive(), 60)
    assert bus.wait_matching(SCAN, 10)
    for scan, belief in zip(recorded["scan"], recorded["belief"], strict=True):
        bus.put(SCAN, scan)
        stamp = Scan.decode(scan).stamp_ns
        again = wait_for_message(inbox, Belief, lambda b, s=stamp: b.stamp_ns == s)
        assert again == Belief.decode(belief)


def wait_for_one(running, folder, pattern):
    assert wait_until(lambda: list(folder.glob(pattern)) or not running.running, 60), running.output
    (path,) = folder.glob(pattern)
    return path


def test_demo_localises_navigates_records_and_draws(process, tmp_path):
    demo = process(
        "presage.__main__",
        "demo",
        "--out",
        str(tmp_path / "out"),
        "--json",
        str(tmp_path / "d.json"),
        env={"PRESAGE_PACE": "lockstep"},
    )
    recording = wait_for_one(demo, tmp_path / "out", "*.mcap.active")
    made.write(tmp_path / "out" / "another.mcap")  # a file of another program, written during the demo
    assert demo.wait(170) == 0, demo.output
    numbers = json.loads((tmp_path / "d.json").read_text())
    assert numbers["goal_reached"]
    assert numbers["straight_line_m"] >= 12
    assert numbers["localised_after_scans"] >= 1
    assert numbers["localised_error_m"] < 0.5
    assert numbers["goal_distance_m"] < 0.2 + 0.3
    assert numbers["contacts"] == 0
    assert numbers["scans"] > 100
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"another.mcap", recording.stem, recording.with_suffix("").with_suffix(".png").name}
    recording_contents = read_recording(recording.with_suffix(""))
    # No scan is lost. On a slow machine a scan is sent again, and only such repetitions may be dropped.
    scans, beliefs = (
        {message.stamp_ns for _, message, _ in recording_contents.messages(topic)} for topic in (SCAN, BELIEF)
    )
    assert scans - beliefs <= {max(scans)}
    simulated = [health for _, health, _ in recording_contents.messages(HEALTH) if health.service == "simulator"]
    assert numbers["dropped"] == 0 or simulated[-1].counters.get("scans_sent_again", 0) > 0, numbers["dropped_by_key"]
    (goal,) = [message for _, message, _ in recording_contents.messages(GOAL)]
    assert goal.seq > 0
    assert {message.goal_seq for _, message, _ in recording_contents.messages(STATUS) if message.goal} == {goal.seq}
    for word in (
        "page: http://127.0.0.1:",
        "distance to goal",
        "localisation error",
        "scans",
        "dropped",
        "recording",
        "figure",
        "goal reached",
    ):
        assert word in demo.output


def test_demo_at_full_speed_starts_when_all_services_are_alive(process, tmp_path):
    numbers = tmp_path / "d.json"
    config = tmp_path / "fast.yaml"
    config.write_text("simulator: {pace: fast}")
    args = ("--config", str(config), "--out", str(tmp_path), "--json", str(numbers))
    demo = process("presage.__main__", "demo", *args)
    assert demo.wait(170) in {0, 1}, demo.output  # on a slow machine commands may be late
    assert "localised after" in demo.output
    recording = read_recording(next(tmp_path.glob("*.mcap")))
    assert next(recording.messages(SCAN))[1].seq == 0
    assert json.loads(numbers.read_text())["localised_after_scans"] is not None


def test_demo_without_a_belief_reports_the_reason(process, tmp_path):
    args = ("--estimator", "paper", "--out", str(tmp_path), "--quiet")
    demo = process("presage.__main__", "demo", *args, env={"PRESAGE_BEAMS": "100"})
    assert demo.wait(60) == 2, demo.output
    (line,) = demo.output.splitlines()
    assert line.startswith("presage: the estimator publishes no belief; its health reports: the scan does not fit the")
    assert "presage train" in line
    assert "--beams 100" in line


BACKGROUND = """
import runpy, signal
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a script's background commands
runpy.run_module("presage", run_name="__main__")
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_presage_up(process, free_port, number, tmp_path):
    (tmp_path / "background.py").write_text(BACKGROUND)
    up = process(tmp_path / "background.py", "up", "--port", str(free_port()))
    up.wait_for("all alive", 90)
    children = psutil.Process(up.child.pid).children(recursive=True)
    assert len(children) == 6  # router, simulator, estimator, controller, viewer and an idle recorder
    up.send(number)
    assert up.wait(20) == (-9 if number == signal.SIGKILL else 130)
    assert wait_until(lambda: not any(child.is_running() and child.status() != "zombie" for child in children), 10)


def test_up_reports_a_service_that_ends_and_keeps_the_others(process, free_port):
    up = process("presage.__main__", "up", "--port", str(free_port()))
    up.wait_for("all alive", 90)
    estimator = next(c for c in psutil.Process(up.child.pid).children() if "services.estimator" in c.cmdline())
    estimator.kill()
    up.wait_for("estimator ended with status -9", 20)
    assert "python -m services.estimator" in up.output
    assert len([c for c in psutil.Process(up.child.pid).children() if c.status() != "zombie"]) == 5


def test_up_serves_the_page(process, free_port):
    up = process("presage.__main__", "up", "--port", str(free_port()), env={"PRESAGE_VIEWER_PORT": "0"})
    up.wait_for("all alive", 90)
    (where,) = [line.split()[-1] for line in up.output.splitlines() if line.startswith("page:")]
    with Page(where) as page:
        assert page.told("world")["world"]["name"] == "corridor"
        assert page.frame(lambda h: h["belief"] is not None)
        assert page.told("services", lambda m: len(m["services"]) == 5)["missing"] == []
        assert page.done("record", action="status")["recording"] is False
    assert up.stop(signal.SIGINT, 20)[0] == 130


def test_up_without_a_page(process, free_port):
    up = process("presage.__main__", "up", "--port", str(free_port()), "--no-viewer")
    up.wait_for("all alive", 90)
    assert "page:" not in up.output
    assert len(psutil.Process(up.child.pid).children()) == 4
