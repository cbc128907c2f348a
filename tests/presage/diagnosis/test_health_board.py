"""`presage top`'s board: who is there, how it does, and how to start who is not."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from common.messages.definitions import Belief, CmdVel, Health, Pose, Scan, TopicHealth, Twist
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN
from presage.diagnosis.health_board import (
    HEALTH_TIMEOUT_S,
    LATENCY_WINDOW,
    LIVELINESS_GRACE_S,
    MAX_SERVICES,
    HealthBoard,
)
from presage.diagnosis.top import tables

MS = 1_000_000


def health(service, *rows, **rest) -> Health:
    return Health(stamp_ns=0, service=service, uptime=65.0, topics=list(rows), **rest)


def scan(stamp):
    return Scan(
        stamp_ns=stamp, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.ones(3)
    )  # fmt: skip


def belief(stamp):
    pose = Pose(x=0.0, y=0.0)
    return Belief(stamp_ns=stamp, state="tracking", pose=pose, xi=np.zeros(3), free_energy=0.0, accuracy=0.0)


def rows(board, now):
    return {row.name: row for row in board.rows(now)}


def shown(board, now) -> str:
    console = Console(width=170, file=io.StringIO())
    console.print(tables({board.robot: board}, now))
    return console.file.getvalue()


def test_nobody_there_is_three_missing_with_what_starts_them():
    board = HealthBoard("r2", ("tcp/10.0.0.1:7447",))
    found = rows(board, 0.0)
    assert {name: row.state for name, row in found.items()} == {
        "simulator": "missing", "estimator": "missing", "controller": "missing", "recorder": "off", "viewer": "off",
    }  # fmt: skip
    start = "python -m services.estimator --robot r2 --connect tcp/10.0.0.1:7447"
    assert start in found["estimator"].note
    assert not found["estimator"].ok
    assert found["recorder"].ok
    assert HealthBoard("robot").start_command("viewer") == "python -m services.viewer"
    assert "start it: " + start in " ".join(shown(board, 0.0).replace("│", " ").split())


def test_a_replay_stands_for_the_others():
    board = HealthBoard("robot")
    board.update_alive({"replay"}, 0.0)
    assert all(row.ok for row in board.rows(0.0))
    assert rows(board, 0.0)["simulator"].state == "off"
    assert rows(board, 0.0)["replay"].state == "starting"


def test_a_robot_in_ros_stands_for_the_simulator_alone():
    board = HealthBoard("robot")
    board.update_alive({"bridge_ros2"}, 0.0)
    assert [rows(board, 0.0)[name].state for name in ("simulator", "estimator")] == ["off", "missing"]


def test_a_service_comes_falls_silent_and_goes():
    board = HealthBoard("robot")
    board.update_alive({"controller"}, 10.0)
    assert rows(board, 10.0 + HEALTH_TIMEOUT_S)["controller"].state == "starting"
    assert rows(board, 10.1 + HEALTH_TIMEOUT_S)["controller"].state == "silent"
    assert not board.all_reported()
    board.add_message(HEALTH, health("controller", note="waits"), 0, 20.0)
    assert board.all_reported()
    row = rows(board, 20.4)["controller"]
    assert (row.state, row.age, row.uptime, row.note) == ("alive", pytest.approx(0.4), 65.0, "waits")
    assert rows(board, 20.1 + HEALTH_TIMEOUT_S)["controller"].state == "silent"
    board.update_alive(set(), 20.5)
    assert rows(board, 20.5)["controller"].state == "alive"  # liveliness alone may be wrong while a link is made anew
    assert rows(board, 20.1 + LIVELINESS_GRACE_S)["controller"].state == "gone"
    board.update_alive(set(), 24.0)
    gone = rows(board, 24.0)["controller"]
    assert gone.state == "gone"
    assert gone.note == "start it again: python -m services.controller"
    assert not gone.ok


def test_rates_drops_and_failures_are_those_of_the_pulse():
    board = HealthBoard("robot")
    board.update_alive({"estimator"}, 0.0)
    pulse = health(
        "estimator",
        TopicHealth(key="presage/robot/belief", published=30, rate=10.0),
        TopicHealth(key="presage/robot/scan", received=30, rate=15.0, dropped=2, undecodable=3),
        TopicHealth(key="presage/robot/goal", received=1, rate=0.0),
        TopicHealth(key="presage/robot/health/estimator", published=9, rate=1.0),
        TopicHealth(key="others", received=9, dropped=4),
        counters={"failed": 5},
    )
    board.add_message(HEALTH, pulse, 0, 1.0)
    row = rows(board, 1.0)["estimator"]
    assert [(rate.topic, rate.hz, rate.slow) for rate in row.published] == [("belief", 10.0, True)]
    assert [(rate.topic, rate.hz, rate.slow) for rate in row.received] == [("scan", 15.0, False)]
    assert (row.dropped, row.undecodable, row.failed) == (6, 3, 5)
    text = shown(board, 1.0)
    for words in ("belief 10.0", "scan 15.0", "1:05", "alive", "0.0 s"):
        assert words in text
    stale = rows(board, 1.1 + HEALTH_TIMEOUT_S)["estimator"]
    assert stale.published == stale.received == ()  # of long ago


def test_latency_is_the_median_between_two_messages_of_a_stamp():
    board = HealthBoard("robot")
    board.update_alive({"estimator", "controller"}, 0.0)
    for name in ("estimator", "controller"):
        board.add_message(HEALTH, health(name), 0, 0.0)
    for stamp, late in enumerate((5, 7, 90)):
        board.add_message(SCAN, scan(stamp), stamp * 1000 * MS, 0.0)
        board.add_message(BELIEF, belief(stamp), stamp * 1000 * MS + late * MS, 0.0)
        for again in (2, 500):  # a command sent again answers nothing
            command = CmdVel(stamp_ns=stamp, twist=Twist())
            board.add_message(CMD_VEL, command, stamp * 1000 * MS + (late + again) * MS, 0.0)
    board.add_message(BELIEF, belief(99), 1, 0.0)  # of a scan that never came
    found = rows(board, 0.0)
    assert found["estimator"].latency_ms == pytest.approx(7.0)
    assert found["controller"].latency_ms == pytest.approx(2.0)
    assert found["simulator"].latency_ms is None


def test_it_forgets_what_is_old_and_does_not_grow():
    board = HealthBoard("robot")
    for stamp in range(10 * LATENCY_WINDOW):
        board.add_message(SCAN, scan(stamp), stamp, 0.0)
        board.add_message(HEALTH, health(f"x{stamp}"), 0, 0.0)
    assert all(len(seen) <= LATENCY_WINDOW for seen in board._published.values())
    assert len(board.rows(0.0)) <= MAX_SERVICES + 5


def test_a_note_cannot_draw_on_the_terminal():
    board = HealthBoard("robot")
    board.update_alive({"simulator"}, 0.0)
    board.add_message(HEALTH, health("simulator", note="[red]x[/red] \x1b[2J"), 0, 0.0)
    text = shown(board, 0.0)
    assert "[red]x[/red]" in text
    assert "\x1b" not in text
