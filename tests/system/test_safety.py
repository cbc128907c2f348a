"""An obstacle that appears at 1 m/s: stopped by the base's obstacle stop alone, the controller alone, or neither.

The processes run in lockstep, so that the results do not depend on the machine's speed.
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
from common.robot.robot import Robot
from tests.conftest import WAIT_TIMEOUT_S, wait_for_message

TIMEOUT_S = 60.0
TEST_DRIVER = "driver"  # liveliness token of the test; the simulator waits for it
FAULT_SPEED = 0.97  # m/s
START = ("--start", "3.2,1.4,0", "--beams", "271", "--pace", "lockstep", "--seed", "3")
# m from the robot's front to the box. Braking at 1 m/s² takes 0.5 m, and the reaction a scan or two.
BOX_DISTANCE = 0.95
SCANS_WITH_BOX = 45  # braking takes 15
RATE = 15  # scans per second


def speed(truth):
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


def add_barrier(bus, truth):
    """Adds a box across the whole corridor, ``BOX_DISTANCE`` ahead of the robot."""
    box = Box(center=(truth.pose.x + 0.27 + BOX_DISTANCE + 0.2, 2.25), size=(0.4, 4.5))
    request = ObstacleRequest(action="add", name="barrier", obstacle=Obstacle(box=box))
    assert bus.query(OBSTACLE, request, Reply, timeout=WAIT_TIMEOUT_S).ok


def drive(bus, truths, answer):
    """Drives until the box has been there for `SCANS_WITH_BOX`, or the robot touches it. Returns the true states.

    ``answer(truth)`` must publish the message with which the simulation continues.
    """
    seen, end = [], 600
    while len(seen) < end:
        truth = wait_for_message(truths, Truth, lambda _: True)
        seen.append(truth)
        if end == 600 and speed(truth) > FAULT_SPEED:
            add_barrier(bus, truth)  # the simulation waits during this call
            end = len(seen) + SCANS_WITH_BOX
        if truth.contact:
            break
        answer(truth)
    assert end < 600, "the robot never drove at full speed"
    return seen


@pytest.fixture
def truths(bus):
    inbox = Inbox()
    bus.subscribe(TRUTH, inbox, keep_all=True)
    return inbox


@pytest.mark.parametrize("stop", ["--obstacle-stop", "--no-obstacle-stop"])
def test_obstacle_stop_of_the_base(process, bus, truths, stop):
    simulator = process("simulator", *START, "--wait-for", TEST_DRIVER, stop)
    assert wait_until(lambda: "simulator" in bus.alive(), TIMEOUT_S), simulator.output
    assert bus.wait_matching(CMD_VEL, TIMEOUT_S)
    bus.declare_alive(TEST_DRIVER)

    def command_full_speed(truth):
        bus.put(CMD_VEL, CmdVel(stamp_ns=truth.stamp_ns, twist=Twist(vx=1.0)).encode())

    seen = drive(bus, truths, command_full_speed)
    # Without the obstacle stop there is contact, so the test is meaningful.
    assert seen[-1].contact == (stop == "--no-obstacle-stop")
    assert seen[-1].stopped == (stop == "--obstacle-stop")
    if seen[-1].stopped:
        box = seen[-SCANS_WITH_BOX - 1].pose.x + BOX_DISTANCE  # x of the robot if it touched the box
        assert box - seen[-1].pose.x > Robot().margin
        # It stands, but for millimetres where noise makes the gap look larger than it is.
        assert seen[-1].pose.x - seen[-RATE].pose.x < 0.005
    assert simulator.stop() == 0, simulator.output


@pytest.mark.parametrize("base", ["holonomic", "differential"])
def test_controller_without_obstacle_stop(process, bus, truths, base):
    """The controller's map has no box, so it can only see the box in the scan. The belief is the true pose."""
    statuses = Inbox()
    bus.subscribe(STATUS, statuses, keep_all=True)
    controller = process("controller", "--drive", base, "--belief-timeout", "60")
    simulator = process(
        "simulator", *START, "--drive", base, "--no-obstacle-stop", "--wait-for", f"controller,{TEST_DRIVER}"
    )
    assert wait_until(lambda: {"controller", "simulator"} <= bus.alive(), TIMEOUT_S), controller.output
    assert bus.wait_matching(GOAL, TIMEOUT_S)
    assert bus.wait_matching(BELIEF, TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, seq=1, pose=Pose(x=15.5, y=1.5)).encode())
    wait_for_message(statuses, Status, lambda status: status.goal_seq == 1)
    bus.declare_alive(TEST_DRIVER)

    def publish_true_belief(truth):
        belief = Belief(
            stamp_ns=truth.stamp_ns, state="tracking", pose=truth.pose, xi=np.zeros(3), free_energy=0.0, accuracy=0.0
        )
        bus.put(BELIEF, belief.encode())

    seen = drive(bus, truths, publish_true_belief)
    assert not any(truth.contact for truth in seen)
    wait_for_message(statuses, Status, lambda status: status.reason.startswith("waiting; the nearest obstacle"))
    for running in (simulator, controller):
        assert running.stop() == 0, running.output
