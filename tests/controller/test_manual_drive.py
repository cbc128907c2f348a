"""Manual driving: priority over the goal, the limits, and the timeout."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World
from common.messages.definitions import Drive, Twist
from common.robot.base import Robot
from services.controller.manual_drive import MANUAL_TIMEOUT_NS, ManualDrive
from services.controller.navigator import Navigator
from tests.controller.test_navigator import PERIOD_NS, ROOM, belief, goal, scan


def drive_message(vx=0.0, vy=0.0, wz=0.0) -> Drive:
    return Drive(stamp_ns=0, twist=Twist(vx=vx, vy=vy, wz=wz))


def session(navigator, pose, drives, *, world=ROOM, first=0, state="tracking"):
    """Drive a perfect robot; ``drives`` has a message or None for each scan. Returns (command, status, pose) tuples."""
    pose, log = np.array(pose, float), []
    for number, drive in enumerate(drives, start=first):
        stamp = number * PERIOD_NS
        navigator.on_scan(scan(stamp, pose, world))
        if drive is not None:
            navigator.on_drive(drive)
        command, status = navigator.step(belief(stamp, pose, state))
        log.append((command, status, pose))
        pose = se2.compose(pose, command.twist.array() * PERIOD_NS * 1e-9)
    return log


def states(log) -> list[str]:
    return [status.state for _, status, _ in log]


def test_manual_drive_has_priority_until_it_times_out():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    log = session(navigator, [3.0, 2, 0], [None] * 3 + [drive_message(vx=-0.4)] * 20 + [None] * 20)
    assert states(log)[:3] == ["navigating"] * 3
    assert states(log)[3:30] == ["manual"] * 27  # 7 periods are 0.467 s
    assert states(log)[30:] == ["navigating"] * 13
    assert log[15][0].twist.vx == pytest.approx(-0.4)
    assert log[15][1].goal == goal(8.5, 2).pose
    assert "by hand" in log[15][1].reason
    assert "the goal waits" in log[15][1].reason
    assert log[-1][0].twist.vx > 0.1


def test_repeated_zero_velocity_releases_the_goal():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    log = session(navigator, [3.0, 2, 0], [drive_message(vy=0.5)] * 5 + [drive_message()] * 30)
    assert states(log)[:13] == ["manual"] * 13
    assert states(log)[13:] == ["navigating"] * 22
    assert not log[12][0].twist.array().any()


def test_idle_after_manual_drive_without_a_goal():
    log = session(Navigator(world=ROOM), [3.0, 2, 0], [drive_message(wz=1.0)] * 5 + [None] * 20)
    assert states(log) == ["manual"] * 12 + ["idle"] * 13
    assert log[4][1].reason == "driven by hand"
    assert log[4][0].twist.wz > 0.5
    assert not log[-1][0].twist.array().any()


def test_reached_goal_is_not_resumed():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(3.0, 2))
    log = session(navigator, [3.0, 2, 0], [None] * 2 + [drive_message(vx=1.0)] * 30 + [None] * 20)
    assert states(log)[1] == "reached"
    assert states(log)[-1] == "idle"
    assert log[-1][1].goal is None
    assert log[-1][2][0] > 3.5


def test_refused_goal_stays_refused():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(20, 20))
    log = session(navigator, [3.0, 2, 0], [None, drive_message(vx=1.0), *[None] * 10])
    assert (states(log)[1], states(log)[-1]) == ("manual", "blocked")
    assert "goal refused" in log[-1][1].reason


def test_goal_set_during_manual_drive():
    navigator = Navigator(world=ROOM)
    session(navigator, [3.0, 2, 0], [drive_message(vx=0.2)] * 3)
    navigator.on_goal(goal(8.5, 2, seq=7))
    log = session(navigator, [3.0, 2, 0], [drive_message(vx=0.2)] * 3 + [None] * 9, first=3)
    assert (states(log)[0], log[0][1].goal_seq) == ("manual", 7)
    assert states(log)[-1] == "navigating"


def test_manual_drive_with_a_lost_belief():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    log = session(navigator, [3.0, 2, 0], [None, *[drive_message(vx=0.5)] * 10, *[None] * 8], state="lost")
    assert (states(log)[0], states(log)[-1]) == ("lost", "lost")
    assert set(states(log)[1:11]) == {"manual"}
    assert log[10][0].twist.vx == pytest.approx(0.5)


@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=5, max_size=25))
def test_limits_hold_for_any_manual_velocity(drives):
    robot = Robot(max_speed=0.6, acceleration=0.5)
    log = session(Navigator(robot), [3.0, 2, 0], [drive_message(*twist) for twist in drives for _ in range(3)])
    twists = np.array([command.twist.array() for command, _, _ in log])
    period = PERIOD_NS * 1e-9
    assert np.isfinite(twists).all()
    assert np.linalg.norm(twists[:, :2], axis=1).max() <= 0.6 + 1e-9
    assert np.abs(twists[:, 2]).max() <= robot.max_turn + 1e-9
    changes = np.diff(twists, axis=0)
    held = np.linalg.norm(twists[1:, :2], axis=1) < np.linalg.norm(twists[:-1, :2], axis=1)  # braking may be sharper
    assert (np.linalg.norm(changes[:, :2], axis=1)[~held] <= 0.5 * period + 1e-6).all()


@pytest.mark.parametrize("heading", [0.0, 0.4, np.pi / 2, 2.5])
def test_manual_drive_stops_before_obstacles(heading):
    box = World(name="box", boundary=ROOM.boundary, obstacles=[{"box": {"center": (6, 2), "size": (1, 1)}}])
    speeds = drive_message(vx=3 * np.cos(heading), vy=3 * np.sin(heading))
    log = session(Navigator(), [3.0, 2, 0], [speeds] * 120, world=box)
    places = np.array([pose[:2] for _, _, pose in log])
    assert box.clearance(places).min() > Robot().radius
    assert np.hypot(*(places[-1] - places[0])) > 1.0
    assert np.hypot(*log[-1][0].twist.array()[:2]) < 0.05
    assert states(log)[-1] == "manual"


def test_manual_drive_without_beliefs_brakes_after_the_timeout():
    navigator, log = Navigator(world=ROOM), []
    for number in range(60):
        navigator.on_scan(scan(number * PERIOD_NS, [3.0, 2, 0]))
        if 5 <= number < 30:
            navigator.on_drive(drive_message(vx=0.8))
        log.append(navigator.step_without_belief(number * PERIOD_NS))
    assert log[:5] == [None] * 5
    commands = [answer[0].twist.vx for answer in log[5:] if answer is not None]
    assert max(commands) == pytest.approx(0.8)
    assert commands[-1] == 0.0
    assert all(a - b <= PERIOD_NS * 1e-9 + 1e-9 for a, b in itertools.pairwise(commands))
    assert log[20][1].state == "manual"
    assert [answer[1].state for answer in log[5:] if answer is not None][-1] == "idle"
    assert log[-1] is None  # the robot stands, and no drive message is valid
    assert log[20][0].stamp_ns == 20 * PERIOD_NS


def test_reset_of_time_discards_the_last_message():
    manual, late = ManualDrive(), 100 * 10**9
    manual.update(drive_message(vx=1.0), late)
    assert manual.twist(late) is not None
    assert manual.twist(0) is None
    assert manual.twist(late) is None


@given(st.lists(st.tuples(st.integers(0, 400), st.booleans()), min_size=1, max_size=30), st.integers(0, 1500))
def test_timeouts_for_random_message_sequences(messages, after):
    """``messages``: ms since the last one, and whether it commands motion; queried ``after`` ms after the last one."""
    manual, now, at = ManualDrive(), 0, []
    for step, moves in messages:
        now += step * 10**6
        manual.update(drive_message(vx=1.0) if moves else drive_message(), now)
        at.append((now, moves))
    query = now + after * 10**6
    last, in_motion = at[-1]
    zero_since = last
    for when, moves in reversed(at):
        if moves:
            break
        zero_since = when  # intervals are shorter than the timeout, so the run is not interrupted
    expected = query - last <= MANUAL_TIMEOUT_NS and (in_motion or query - zero_since <= MANUAL_TIMEOUT_NS)
    assert (manual.twist(query) is not None) == expected


def test_velocity_continues_after_a_pause():
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    before = session(navigator, [2.0, 2, 0], [None] * 12)[-1]
    stop = navigator.stop_without_belief(11 * PERIOD_NS, "no belief")[0]
    assert not stop.twist.array().any()
    after = session(navigator, before[2], [None] * 2, first=12)[0]
    assert after[0].twist.vx >= before[0].twist.vx > 0.5
    assert after[1].state == "navigating"


@pytest.mark.parametrize("late", [1, 9])
def test_velocity_starts_from_zero_after_a_late_estimator(late):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    before = session(navigator, [2.0, 2, 0], [None] * 12)[-1]
    for number in range(12, 12 + late):
        navigator.on_scan(scan(number * PERIOD_NS, before[2]))  # scans without beliefs
    navigator.stop_without_belief(11 * PERIOD_NS, "no belief")
    command, _ = navigator.step(belief((11 + late) * PERIOD_NS, before[2]))
    assert 0 < command.twist.vx <= Robot().acceleration * late * PERIOD_NS * 1e-9 + 1e-9
    assert command.twist.vx < before[0].twist.vx
