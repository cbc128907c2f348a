"""Two instances of one service: one is active, the other is reported and waits."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import CmdVel, Goal, Health, Pose, Status, Truth, Twist
from common.messages.topics import CMD_VEL, GOAL, HEALTH, STATUS, TRUTH
from tests.conftest import received_messages, wait_for_message

TIMEOUT_S = 60.0


def speed(truth):
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


@pytest.fixture
def heard(bus):
    """A function that subscribes to a topic and returns an inbox of the messages from now on."""

    def begin(topic):
        inbox = Inbox()
        bus.subscribe(topic, inbox, keep_all=True)
        return inbox

    return begin


def test_standby_controller(process, bus, heard):
    first = process("controller")
    assert wait_until(lambda: "controller" in bus.alive(), TIMEOUT_S), first.output
    second = process("controller")
    second.wait_for("standing by", TIMEOUT_S)
    assert f"process {first.child.pid} on" in second.output
    process("simulator")
    process("estimator", "--initial-pose", "3,1.5")
    assert wait_until(lambda: {"simulator", "estimator", "controller"} <= bus.alive(), TIMEOUT_S)
    assert [len(names) for names in bus.alive_instances().values()] == [1, 1, 1]
    assert list(bus.alive_instances(standby=True)) == ["controller"]

    truths, commands, states = heard(TRUTH), heard(CMD_VEL), heard(STATUS)
    assert bus.wait_matching(GOAL, TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, seq=7, pose=Pose(x=9.0, y=1.5)).encode())
    wait_for_message(truths, Truth, lambda t: speed(t) > 0.5)
    drivers = set()
    while (sample := commands.get(0)) is not None:
        drivers.add(sample.source)
    assert len(drivers) == 1

    # A frozen controller is no longer the active one; the other continues to the same goal.
    first.send(signal.SIGSTOP)
    wait_for_message(truths, Truth, lambda t: speed(t) < 1e-3)
    second.wait_for("taking over", TIMEOUT_S)
    second.wait_for("resuming the goal of the previous controller instance", TIMEOUT_S)
    wait_for_message(states, Status, lambda s: s.goal_seq == 7 and s.state == "navigating")
    wait_for_message(truths, Truth, lambda t: speed(t) > 0.3)

    # When it runs again, the older instance becomes active, and the newer one ends.
    first.send(signal.SIGCONT)
    assert wait_until(lambda: not second.running, TIMEOUT_S), first.output + second.output
    assert second.wait() == 2
    assert "was started before this one and is active, so this one ends" in second.output
    assert wait_until(lambda: list(bus.alive_instances().get("controller", [])) != [], TIMEOUT_S)
    wait_for_message(states, Status, lambda s: s.state == "reached", 120)
    assert first.running


def test_other_sources_of_commands(process, bus, heard, link):
    simulator = process("simulator")
    truths, health = heard(TRUTH), heard(HEALTH)
    assert bus.wait_matching(CMD_VEL, TIMEOUT_S), simulator.output

    def command(driver, **twist):
        now = wait_for_message(truths, Truth, lambda _: True).stamp_ns
        driver.put(CMD_VEL, CmdVel(stamp_ns=now, twist=Twist(**twist)).encode())

    with open_bus(link) as leader:
        leader.declare_alive("controller")
        assert leader.wait_matching(CMD_VEL, TIMEOUT_S)
        for _ in range(10):
            command(leader, wz=0.5)
        assert wait_until(lambda: "controller" in bus.alive(), TIMEOUT_S)
        before = wait_for_message(health, Health, lambda h: h.service == "simulator").counters.get("other_sources", 0)

        def counted() -> bool:
            command(leader, wz=0.5)
            command(bus, vx=1.0)  # a busy simulator processes only the newest of several commands
            return any(h.counters.get("other_sources", 0) >= before + 20 for h in received_messages(health, Health))

        assert wait_until(counted, TIMEOUT_S)
        truth = wait_for_message(truths, Truth, lambda _: True)
        assert speed(truth) < 1e-3
        assert bus.zid in simulator.output
    assert wait_until(lambda: "controller" not in bus.alive(), TIMEOUT_S)
    # Without an active controller, commands from another source are obeyed.

    def driven() -> bool:
        command(bus, vx=0.5)
        return speed(wait_for_message(truths, Truth, lambda _: True)) > 0.1

    assert wait_until(driven, TIMEOUT_S)
