"""Two of what should be one, by mistake or on purpose: one leads, the other is named and waits."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import CmdVel, Goal, Health, Pose, Status, Truth, Twist
from common.messages.topics import CMD_VEL, GOAL, HEALTH, STATUS, TRUTH
from tests.conftest import received_messages, wait_for_message

PATIENCE = 60.0


def speed(truth):
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


@pytest.fixture
def heard(bus):
    """What of a topic arrives from now on."""

    def begin(topic):
        inbox = Inbox()
        bus.subscribe(topic, inbox, keep_all=True)
        return inbox

    return begin


def test_the_second_controller_stands_by_and_takes_the_goal_over(process, bus, heard):
    first = process("controller")
    assert wait_until(lambda: "controller" in bus.alive(), PATIENCE), first.output
    second = process("controller")
    second.wait_for("standing by", PATIENCE)
    assert f"process {first.child.pid} on" in second.output
    process("simulator")
    process("estimator", "--initial-pose", "3,1.5")
    assert wait_until(lambda: {"simulator", "estimator", "controller"} <= bus.alive(), PATIENCE)
    assert [len(names) for names in bus.alive_instances().values()] == [1, 1, 1]
    assert list(bus.alive_instances(standby=True)) == ["controller"]

    truths, commands, states = heard(TRUTH), heard(CMD_VEL), heard(STATUS)
    assert bus.wait_matching(GOAL, PATIENCE)
    bus.put(GOAL, Goal(stamp_ns=0, seq=7, pose=Pose(x=16.5, y=1.5)).encode())
    wait_for_message(truths, Truth, lambda t: speed(t) > 0.5)
    drivers = set()
    while (sample := commands.get(0)) is not None:
        drivers.add(sample.source)
    assert len(drivers) == 1

    # Frozen, it loses the lead; the other goes on to the same goal.
    first.send(signal.SIGSTOP)
    wait_for_message(truths, Truth, lambda t: speed(t) < 1e-3)
    second.wait_for("taking over", PATIENCE)
    second.wait_for("resuming the goal of the previous controller instance", PATIENCE)
    wait_for_message(states, Status, lambda s: s.goal_seq == 7 and s.state == "navigating")
    wait_for_message(truths, Truth, lambda t: speed(t) > 0.3)

    # Back again, the older one leads; never are both heard.
    first.send(signal.SIGCONT)
    assert second.wait(PATIENCE) == 2
    assert "was started before this one and is active, so this one ends" in second.output
    assert wait_until(lambda: list(bus.alive_instances().get("controller", [])) != [], PATIENCE)
    wait_for_message(states, Status, lambda s: s.state == "reached", 120)
    assert first.running


def test_the_one_that_leads_is_obeyed_and_another_source_is_counted_and_named(process, bus, heard, link):
    simulator = process("simulator")
    truths, health = heard(TRUTH), heard(HEALTH)
    assert bus.wait_matching(CMD_VEL, PATIENCE), simulator.output

    def command(driver, **twist):
        now = wait_for_message(truths, Truth, lambda _: True).stamp_ns
        driver.put(CMD_VEL, CmdVel(stamp_ns=now, twist=Twist(**twist)).encode())

    with open_bus(link) as leader:
        leader.declare_alive("controller")
        assert leader.wait_matching(CMD_VEL, PATIENCE)
        for _ in range(10):
            command(leader, wz=0.5)
        assert wait_until(lambda: "controller" in bus.alive(), PATIENCE)
        before = wait_for_message(health, Health, lambda h: h.service == "simulator").counters.get("other_sources", 0)

        def counted() -> bool:
            command(leader, wz=0.5)
            command(bus, vx=1.0)  # of several a busy simulator sees the newest
            return any(h.counters.get("other_sources", 0) >= before + 20 for h in received_messages(health, Health))

        assert wait_until(counted, PATIENCE)
        truth = wait_for_message(truths, Truth, lambda _: True)
        assert speed(truth) < 1e-3
        assert bus.zid in simulator.output
    assert wait_until(lambda: "controller" not in bus.alive(), PATIENCE)
    # Nobody leads now: a driver of the robot's own is heard.

    def driven() -> bool:
        command(bus, vx=0.5)
        return speed(wait_for_message(truths, Truth, lambda _: True)) > 0.1

    assert wait_until(driven, PATIENCE)
