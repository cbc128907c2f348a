"""Each service alone: help, settings and clean end. Together: starts in any order, and the death of any service."""

from __future__ import annotations

import itertools
import signal
import time

import pytest
import yaml

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, Sample
from common.messages.definitions import CmdVel, Goal, Health, Pose, Twist
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, STATUS, TRUTH

SERVICES = ("simulator", "estimator", "controller", "recorder")


def next_message(bus, topic, condition=lambda _: True, timeout=60.0):
    """Waits for a message of the topic from now on that meets the condition, and returns it."""
    inbox, found = Inbox(), []
    bus.subscribe(topic, inbox, keep_all=True)

    def check():
        while isinstance(sample := inbox.get(0), Sample):
            message = topic.message.decode(sample.payload)
            if condition(message):
                found.append(message)
                return True
        return False

    assert wait_until(check, timeout), f"no matching message on {topic.name}"
    return found[0]


def test_help_and_effective_settings(process):
    started = [(name, process(name, "--help"), process(name, "--print-config")) for name in SERVICES]
    for name, helping, printing in started:
        assert helping.wait(60) == 0
        assert f"python -m services.{name}" in helping.output
        assert "examples:" in helping.output.lower()
        assert printing.wait(60) == 0
        settings = yaml.safe_load(printing.output)
        assert list(settings) == [name]
        assert settings[name]["robot"].startswith("test")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_each_service_alone_ends_cleanly(process, bus, number, tmp_path):
    started = {
        name: process(name, *(("--directory", str(tmp_path)) if name == "recorder" else ())) for name in SERVICES
    }
    assert wait_until(lambda: set(SERVICES) <= bus.alive(), 60)
    for name in ("recorder", "controller", "estimator", "simulator"):
        status, seconds = started[name].stop(number)
        assert status == 0, started[name].output
        assert seconds < 10
        assert "Traceback" not in started[name].output
        assert wait_until(lambda n=name: n not in bus.alive(), 10)


def test_a_service_without_a_router_waits_and_ends_cleanly(process):
    alone = process("controller", env={"PRESAGE_CONNECT": "tcp/127.0.0.1:9"})
    alone.wait_for("ready")
    assert alone.stop()[0] == 0


@pytest.mark.parametrize("order", list(itertools.permutations(("simulator", "estimator", "controller")))[::2])
def test_services_start_in_any_order(process, bus, order):
    for name in order:
        process(name)
        assert wait_until(lambda n=name: n in bus.alive(), 60)
    next_message(bus, CMD_VEL)


def test_a_dead_service_stops_the_robot_and_a_restarted_one_resumes(process, bus):
    running = {name: process(name) for name in ("simulator", "controller")}
    running["estimator"] = process("estimator", "--initial-pose", "3,1.5")
    next_message(bus, BELIEF, lambda b: b.state == "tracking")
    assert bus.wait_matching(GOAL, 10)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=15.5, y=1.5)).encode())
    next_message(bus, TRUTH, lambda t: t.twist.vx**2 + t.twist.vy**2 > 0.09)

    running["estimator"].kill()
    next_message(bus, STATUS, lambda s: "no belief" in s.reason)
    next_message(bus, TRUTH, lambda t: abs(t.twist.vx) + abs(t.twist.vy) < 1e-3)
    where = next_message(bus, TRUTH)
    running["estimator"] = process("estimator", "--initial-pose", f"{where.pose.x:.3f},{where.pose.y:.3f}")
    next_message(bus, STATUS, lambda s: s.state == "navigating" and "standing" not in s.reason)
    next_message(bus, TRUTH, lambda t: t.twist.vx**2 + t.twist.vy**2 > 0.09)

    running["controller"].kill()  # while driving: the simulator's command timeout stops the wheels
    next_message(bus, TRUTH, lambda t: abs(t.twist.vx) + abs(t.twist.vy) < 1e-3)
    process("controller")  # it gets the unfinished goal from the simulator or the estimator
    next_message(bus, STATUS, lambda s: s.state == "navigating" and s.goal is not None and s.goal.x == 15.5)
    next_message(bus, TRUTH, lambda t: t.twist.vx**2 + t.twist.vy**2 > 0.09)

    running["simulator"].kill()
    next_message(bus, STATUS, lambda s: "no belief" in s.reason)
    process("simulator")
    next_message(bus, CMD_VEL)
    assert running["estimator"].running


def test_a_teleported_robot_is_localised_again_or_reported_lost(process, bus):
    process("simulator")
    process("estimator", "--initial-pose", "3,1.5")
    next_message(bus, BELIEF, lambda b: b.state == "tracking")
    carried = process("presage.__main__", "teleport", "12", "1.5")
    assert carried.wait(60) == 0, carried.output
    next_message(bus, BELIEF, lambda b: b.state != "tracking" or b.pose.x > 6)


def test_commands_with_a_wrong_stamp_are_never_executed(process, bus):
    process("simulator")
    truth = next_message(bus, TRUTH, lambda t: t.stamp_ns > 10**9)
    assert bus.wait_matching(CMD_VEL, 10)
    for count, stamp in enumerate((0, truth.stamp_ns + 10**12), start=1):
        bus.put(CMD_VEL, CmdVel(stamp_ns=stamp, twist=Twist(vx=1.0)).encode())
        next_message(bus, HEALTH, lambda h, n=count: h.service == "simulator" and h.counters.get("stale_commands") == n)
    assert next_message(bus, TRUTH).pose.array() == pytest.approx(truth.pose.array(), abs=1e-6)


def test_lockstep_reports_a_missing_service_and_continues_when_it_arrives(process, bus):
    simulator = process("simulator", "--pace", "lockstep", "--lockstep-deadline", "0.5", "--wait-for", "")
    simulator.wait_for("no command answered the scan")
    before = next_message(bus, TRUTH)
    assert before.stamp_ns == 0
    process("estimator")
    process("controller", "--belief-timeout", "30")
    next_message(bus, TRUTH, lambda t: t.stamp_ns > 10**9)


@pytest.mark.parametrize(
    ("service", "args", "says"),
    [
        ("simulator", ("--world", "nowhere"), "one of corridor, maze, office"),
        ("estimator", ("--world", "nowhere"), "one of corridor, maze, office"),
        ("controller", ("--world", "nowhere"), "one of corridor, maze, office"),
        (
            "estimator",
            ("--world", "maze", "--estimator", "paper"),
            "presage train --world maze --preset paper",
        ),
        ("simulator", ("--scanner", "sonar"), "no scanner 'sonar': choose one of tim571"),
        ("simulator", ("--start", "0.1,0.1"), "the robot needs 0.27 m around it"),
        ("simulator", ("--beams", "one"), "beams"),
        ("simulator", ("--connect", "nonsense"), "nonsense"),
        ("recorder", ("--directory", "/proc/nowhere"), "/proc/nowhere"),
        ("controller", ("--gamma", "7"), "gamma"),
    ],
)
def test_invalid_settings_give_one_line_and_status_2(process, service, args, says):
    running = process(service, *args)
    assert running.wait(60) == 2, running.output
    assert says in running.output
    assert "Traceback" not in running.output
    complaints = [line for line in running.output.splitlines() if line.startswith(f"{service}:")]
    assert len(complaints) == 1


def test_health_is_published_periodically(process, bus):
    process("controller")
    first = next_message(bus, HEALTH, lambda h: h.service == "controller")
    began = time.monotonic()
    later = next_message(bus, HEALTH, lambda h: h.service == "controller" and h.seq >= first.seq + 3)
    assert isinstance(later, Health)
    assert later.uptime > first.uptime
    assert time.monotonic() - began < 30
