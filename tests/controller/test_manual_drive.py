"""Manual driving: priority over the goal, the limits, and the timeout."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages.definitions import Drive, Twist
from common.robot.robot import Robot
from services.controller.manual_drive import ManualDrive
from services.controller.navigator import Navigator
from tests.controller.driving import PERIOD_NS, PERIOD_S, box, goal, room, scan, session

ROOM = room(10, 4)
NEAR, FAR, IN_A_WALL = goal(3, 2), goal(8.5, 2), goal(20, 20)


def move(vx=0.0, vy=0.0, wz=0.0) -> Drive:
    return Drive(stamp_ns=0, twist=Twist(vx=vx, vy=vy, wz=wz))


@pytest.mark.parametrize(
    ("to", "belief_state", "drives", "states"),
    [
        (FAR, "tracking", [None] * 3 + [move(-0.4)] * 20 + [None] * 20,
         [("navigating", 3), ("manual", 27), ("navigating", 13)]),  # 7 periods are 0.467 s
        (FAR, "tracking", [move(vy=0.5)] * 5 + [move()] * 30, [("manual", 13), ("navigating", 22)]),
        (None, "tracking", [move(wz=1.0)] * 5 + [None] * 20, [("manual", 12), ("idle", 13)]),
        (NEAR, "tracking", [None] * 2 + [move(1.0)] * 30 + [None] * 20, [("reached", 2), ("manual", 37), ("idle", 13)]),
        (IN_A_WALL, "tracking", [None, move(1.0), *[None] * 10], [("blocked", 1), ("manual", 8), ("blocked", 3)]),
        (FAR, "lost", [None, *[move(0.5)] * 10, *[None] * 9], [("lost", 1), ("manual", 17), ("lost", 2)]),
    ],
    ids=["with a goal", "repeated zero", "without a goal", "reached goal", "refused goal", "lost"],
)  # fmt: skip
def test_priority_until_the_timeout(to, belief_state, drives, states):
    navigator = Navigator(world=ROOM)
    if to is not None:
        navigator.on_goal(to)
    log = session(navigator, [3.0, 2, 0], drives, ROOM, state=belief_state)
    assert [(state, len(list(run))) for state, run in itertools.groupby(log, lambda row: row[1].state)] == states
    for _, status, _ in log:
        if status.state == "manual":
            assert status.reason == ("driven by hand; the goal waits" if to is FAR else "driven by hand")


def test_goal_set_during_manual_drive():
    navigator = Navigator(world=ROOM)
    session(navigator, [3.0, 2, 0], [move(0.2)] * 3, ROOM)
    navigator.on_goal(goal(8.5, 2, seq=7))
    log = session(navigator, [3.0, 2, 0], [move(0.2)] * 3 + [None] * 9, ROOM, first=3)
    assert (log[0][1].state, log[0][1].goal_seq, log[-1][1].state) == ("manual", 7, "navigating")
    assert log[2][0].twist.vx == pytest.approx(0.2)


@settings(max_examples=15)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=5, max_size=15))
def test_limits_hold_for_any_velocity(drives):
    robot = Robot(max_speed=0.6, acceleration=0.5)
    log = session(Navigator(robot), [3.0, 2, 0], [move(*twist) for twist in drives for _ in range(3)], ROOM)
    twists = np.array([command.twist.array() for command, _, _ in log])
    speed = np.linalg.norm(twists[:, :2], axis=1)
    assert speed.max() <= 0.6 + 1e-9
    assert np.abs(twists[:, 2]).max() <= robot.max_turn + 1e-9
    changes = np.linalg.norm(np.diff(twists, axis=0)[:, :2], axis=1)
    assert (changes[speed[1:] >= speed[:-1]] <= 0.5 * PERIOD_S + 1e-6).all()  # braking may be sharper


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_stops_before_obstacles(heading):
    world = room(10, 4, box(6, 2, 1, 1))
    log = session(Navigator(), [3.0, 2, 0], [move(3 * np.cos(heading), 3 * np.sin(heading))] * 75, world)
    places = np.array([pose[:2] for _, _, pose in log])
    assert world.clearance(places).min() > Robot().radius
    assert np.hypot(*(places[-1] - places[0])) > 1.0
    assert np.hypot(*log[-1][0].twist.array()[:2]) < 0.05


def test_drive_without_beliefs():
    navigator, answers = Navigator(world=ROOM), []
    for number in range(60):
        navigator.on_scan(scan(number * PERIOD_NS, [3.0, 2, 0], ROOM))
        if 5 <= number < 30:
            navigator.on_drive(move(0.8))
        answers.append(navigator.step_without_belief(number * PERIOD_NS))
    assert answers[:5] == [None] * 5
    assert answers[-1] is None  # the robot stands, and no drive message is valid
    command, status = answers[20]
    assert (command.stamp_ns, status.state) == (20 * PERIOD_NS, "manual")
    commands = [command.twist.vx for command, _ in filter(None, answers)]
    assert max(commands) == pytest.approx(0.8)
    assert commands[-1] == 0.0
    assert all(a - b <= PERIOD_S + 1e-9 for a, b in itertools.pairwise(commands))


def test_drive_without_beliefs_after_time_went_back():
    navigator = Navigator(world=ROOM)
    for number in (*range(900, 960), *range(20)):
        navigator.on_scan(scan(number * PERIOD_NS, [3.0, 2, 0], ROOM))
        if number < 930:
            navigator.on_drive(move(0.8))
        answer = navigator.step_without_belief(number * PERIOD_NS)
    assert answer is not None
    assert answer[1].state == "manual"


@pytest.mark.parametrize(
    ("messages", "valid"),
    [
        ([], [(0, False)]),
        ([(100, 1)], [(100, True), (600, True), (601, False)]),
        ([(0, 1), (400, 0)], [(900, True), (901, False)]),  # zero velocity once
        ([(0, 0), (400, 0)], [(500, True), (501, False)]),  # repeated: the time counts from the first
        ([(0, 0), (400, 0), (600, 1)], [(1100, True)]),
        ([(0, 0), (501, 0)], [(1001, True), (1002, False)]),  # after a gap the time counts from zero
        ([(100, 1)], [(33, True), (100, True), (600, True), (601, False)]),  # a belief that lags behind the scans
        ([(100_000, 1)], [(100_000, True), (0, False), (100_000, False)]),  # time went back: a reset
    ],
)
def test_timeouts(messages, valid):
    """``messages``: time in ms and vx; ``valid``: time in ms and whether the robot is driven by hand."""
    manual = ManualDrive()
    for now, vx in messages:
        manual.update(move(vx), now * 10**6)
    assert [(now, manual.twist(now * 10**6) is not None) for now, _ in valid] == valid
