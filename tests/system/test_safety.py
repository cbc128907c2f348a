"""Fault injection at 1 m/s over real processes: the base's obstacle stop alone, the controller alone, neither.

In lockstep, so that what is asked does not hang on the machine's speed.
"""

from __future__ import annotations

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.geometry.world import Box, Obstacle
from common.messages.definitions import Belief, CmdVel, Goal, Pose, Status, Truth, Twist
from common.messages.requests import ObstacleRequest, Reply
from common.messages.topics import BELIEF, CMD_VEL, GOAL, OBSTACLE, STATUS, TRUTH
from tests.conftest import wait_for_message

PATIENCE = 60.0
DRIVER = "driver"  # ours: the simulator waits for it
FAST = 0.97  # m/s
START = ("--start", "3.2,1.4,0", "--beams", "271", "--pace", "lockstep", "--seed", "3")
GAP = 0.95  # m from the body's front to the box: braking takes 0.5 at 1 m/s², seeing and answering a scan or two


def speed(truth):
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


def block(bus, truth):
    """A box across the whole corridor, ``GAP`` before the robot."""
    box = Box(center=(truth.pose.x + 0.27 + GAP + 0.2, 1.5), size=(0.4, 2.9))
    request = ObstacleRequest(action="add", name="barrier", obstacle=Obstacle(box=box))
    assert bus.ask(OBSTACLE, request, Reply).ok


def drive(bus, truths, answer):
    """Truths until the robot stands before the box, or touches it; ``answer(truth)`` lets the simulation go on."""
    seen, placed = [], False
    while len(seen) < 600:
        truth = wait_for_message(truths, Truth, lambda _: True)
        seen.append(truth)
        if not placed and speed(truth) > FAST:
            block(bus, truth)  # the simulation waits meanwhile
            placed = True
        if truth.contact or (placed and speed(truth) < 1e-3):
            return seen
        answer(truth)
    raise AssertionError("it neither stood nor touched")


@pytest.fixture
def truths(bus):
    inbox = Inbox()
    bus.subscribe(TRUTH, inbox, keep_all=True)
    return inbox


@pytest.mark.parametrize("stop", ["--obstacle-stop", "--no-obstacle-stop"])
def test_whoever_commands_the_base_s_own_stop_prevents_contact(process, bus, truths, stop):
    simulator = process("simulator", *START, "--wait-for", DRIVER, stop)
    assert wait_until(lambda: "simulator" in bus.alive(), PATIENCE), simulator.output
    assert bus.wait_matching(CMD_VEL, PATIENCE)
    bus.declare_alive(DRIVER)

    def rush(truth):
        bus.put(CMD_VEL, CmdVel(stamp_ns=truth.stamp_ns, twist=Twist(vx=1.0)).encode())

    seen = drive(bus, truths, rush)
    assert max(map(speed, seen)) > FAST
    # Without it there is contact: there was something to prevent.
    assert seen[-1].contact == (stop == "--no-obstacle-stop")
    assert seen[-1].stopped == (stop == "--obstacle-stop")
    assert simulator.stop()[0] == 0, simulator.output


@pytest.mark.parametrize("base", ["holonomic", "differential"])
def test_without_the_base_s_stop_the_controller_alone_prevents_contact(process, bus, truths, base):
    """Its map has no box, and the belief is the truth: what it knows of the box it knows from the scan."""
    statuses = Inbox()
    bus.subscribe(STATUS, statuses, keep_all=True)
    controller = process("controller", "--drive", base, "--belief-timeout", "60")
    simulator = process(
        "simulator", *START, "--drive", base, "--no-obstacle-stop", "--wait-for", f"controller,{DRIVER}"
    )
    assert wait_until(lambda: {"controller", "simulator"} <= bus.alive(), PATIENCE), controller.output
    assert bus.wait_matching(GOAL, PATIENCE)
    assert bus.wait_matching(BELIEF, PATIENCE)
    bus.put(GOAL, Goal(stamp_ns=0, seq=1, pose=Pose(x=15.5, y=1.5)).encode())
    wait_for_message(statuses, Status, lambda status: status.goal_seq == 1)
    bus.declare_alive(DRIVER)

    def know(truth):
        belief = Belief(
            stamp_ns=truth.stamp_ns, state="tracking", pose=truth.pose, xi=np.zeros(3), free_energy=0.0, accuracy=0.0
        )
        bus.put(BELIEF, belief.encode())

    seen = drive(bus, truths, know)
    assert max(map(speed, seen)) > FAST
    assert not any(truth.contact for truth in seen)
    said = wait_for_message(statuses, Status, lambda status: status.stamp_ns == seen[-2].stamp_ns)
    assert said.reason.startswith("waiting: something")
    for running in (simulator, controller):
        assert running.stop()[0] == 0, running.output
