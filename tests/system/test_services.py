"""Each service alone: settings and clean end. Together: any order of starts, and the death of any service."""

from __future__ import annotations

import signal

import numpy as np
import pytest
import yaml

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Goal, Pose
from common.messages.topics import BELIEF, CMD_VEL, GOAL, STATUS, TRUTH
from tests.conftest import WAIT_TIMEOUT_S, wait_for_message

SERVICES = dict.fromkeys(("recorder", "controller"), signal.SIGINT)
SERVICES |= dict.fromkeys(("simulator", "estimator"), signal.SIGTERM)


def next_message(bus, topic, condition=lambda _: True):
    """Waits for a message of the topic from now on that meets the condition, and returns it."""
    inbox = Inbox()
    bus.subscribe(topic, inbox, keep_all=True)
    return wait_for_message(inbox, topic.message, condition)


def moving(truth):
    return truth.twist.vx**2 + truth.twist.vy**2 > 0.09


def standing(truth):
    return abs(truth.twist.vx) + abs(truth.twist.vy) < 1e-3


def test_help_and_effective_settings(process):
    started = [(name, process(name, "--help"), process(name, "--print-config")) for name in SERVICES]
    for name, helping, printing in started:
        assert (helping.wait(60), printing.wait(60)) == (0, 0)
        assert f"python -m services.{name}" in helping.output
        assert "examples:" in helping.output.lower()
        settings = yaml.safe_load(printing.output)
        assert list(settings) == [name]
        assert settings[name]["robot"].startswith("test")


def test_clean_end_alone(process, bus, tmp_path):
    started = {name: process(name, fresh=name == "estimator") for name in SERVICES if name != "recorder"}
    started["recorder"] = process("recorder", "--directory", str(tmp_path), fresh=True)
    assert wait_until(lambda: SERVICES.keys() <= bus.alive(), WAIT_TIMEOUT_S)
    for name, number in SERVICES.items():
        assert started[name].stop(number) == 0, started[name].output
        assert "Traceback" not in started[name].output
        assert wait_until(lambda n=name: n not in bus.alive(), 10)


def test_lockstep_with_late_services(process, bus):
    simulator = process("simulator", "--pace", "lockstep", "--lockstep-deadline", "0.5", "--wait-for", "")
    simulator.wait_for("no command answered the scan")
    assert next_message(bus, TRUTH).stamp_ns == 0
    process("estimator")
    process("controller", "--belief-timeout", "30")
    next_message(bus, TRUTH, lambda truth: truth.stamp_ns > 10**9)


def test_death_and_restart(process, bus):
    """Started in the order opposite to the data's; then each is killed while the robot drives."""
    running = {}
    for name in ("controller", "estimator", "simulator"):
        running[name] = process(name, *(("--initial-pose", "3,1.5,90") if name == "estimator" else ()))
        assert wait_until(lambda n=name: n in bus.alive(), WAIT_TIMEOUT_S)
    next_message(bus, BELIEF, lambda belief: belief.state == "tracking")
    assert bus.wait_matching(GOAL, 10)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=15.5, y=1.5)).encode())
    next_message(bus, TRUTH, moving)

    running["estimator"].kill()
    next_message(bus, STATUS, lambda status: "no belief" in status.reason)
    pose = next_message(bus, TRUTH, standing).pose
    start = f"{pose.x:.3f},{pose.y:.3f},{np.rad2deg(pose.yaw):.1f}"
    running["estimator"] = process("estimator", "--initial-pose", start)
    next_message(bus, STATUS, lambda status: status.state == "navigating" and "standing" not in status.reason)
    next_message(bus, TRUTH, moving)

    running["controller"].kill()  # the simulator's command timeout stops the wheels
    next_message(bus, TRUTH, standing)
    process("controller")  # it gets the unfinished goal from the simulator or the estimator
    next_message(bus, STATUS, lambda status: status.state == "navigating" and status.goal.x == 15.5)
    truth = next_message(bus, TRUTH, moving)
    # Killed while it sends a scan, it could leave the controller with a scan that the estimator never gets.
    next_message(bus, STATUS, lambda status: status.stamp_ns >= truth.stamp_ns)

    running["simulator"].kill()
    next_message(bus, STATUS, lambda status: "no scan" in status.reason)
    process("simulator")
    next_message(bus, CMD_VEL)
    assert running["estimator"].running


@pytest.mark.parametrize(
    ("service", "args", "says"),
    [
        ("simulator", ("--world", "nowhere"), "one of corridor, maze, office"),
        ("estimator", ("--world", "maze", "--estimator", "paper"), "presage train --world maze --preset paper"),
        ("estimator", ("--robots", "a b"), "robots"),
        ("estimator", ("--robots", "a,b", "--initial-pose", "3,1.5"), "initial_pose is for one robot"),
        ("estimator", ("--robots", "a,b,c", "--max-robots", "2"), "--max-robots"),
        ("simulator", ("--scanner", "sonar"), "no scanner 'sonar': choose one of tim571"),
        ("simulator", ("--start", "0.1,0.1"), "the robot needs 0.27 m around it"),
        ("simulator", ("--connect", "nonsense"), "nonsense"),
        ("controller", ("--gamma", "7"), "gamma"),
    ],
)
def test_invalid_settings(process, service, args, says):
    running = process(service, *args)
    assert running.wait(60) == 2, running.output
    assert says in running.output
    assert "Traceback" not in running.output
    assert len([line for line in running.output.splitlines() if line.startswith(f"{service}:")]) == 1
