"""The table of `presage top`."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from common.bus.bus import DEFAULT_ENDPOINT
from common.messages.definitions import Belief, CmdVel, Health, Pose, Scan, TopicHealth, Twist
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN
from common.runtime.service_monitor import REPORT_TIMEOUT_S
from common.runtime.session_files import session_file
from presage.diagnosis.health_board import LATENCY_WINDOW, HealthBoard
from presage.diagnosis.top import tables

MS = 1_000_000


@pytest.fixture
def board():
    return HealthBoard("robot")


def health(service, *rows, **rest) -> Health:
    return Health(stamp_ns=0, service=service, uptime=65.0, topics=list(rows), **rest)


def scan(stamp):
    return Scan(stamp_ns=stamp, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.ones(3))


def belief(stamp):
    pose = Pose(x=0.0, y=0.0)
    return Belief(stamp_ns=stamp, state="tracking", pose=pose, xi=np.zeros(3), free_energy=0.0, accuracy=0.0)


def row(board, name, now=0.0):
    return next(row for row in board.rows(now) if row.service.name == name)


def text(board, now=0.0) -> str:
    console = Console(width=170, file=io.StringIO())
    console.print(tables({board.robot: board}, now))
    return console.file.getvalue()


def test_states():
    board = HealthBoard("r2", "tcp/10.0.0.1:7447")
    board.monitor.set_alive({"simulator", "replay"}, 0.0)
    board.add_message(HEALTH, health("controller", note="n"), 0, 0.0)
    words = {row.service.name: row.state for row in board.rows(1.0)}
    assert words == {
        "simulator": "starting", "estimator": "not running", "controller": "alive", "recorder": "not running",
        "viewer": "not running", "replay": "alive",
    }  # fmt: skip
    board.monitor.set_alive({"simulator"}, 9.0)
    words = {row.service.name: row.state for row in board.rows(9.0)}
    assert (words["simulator"], words["estimator"], words["controller"]) == ("silent", "missing", "gone")
    start = "start it: python -m services.estimator --robot r2 --connect tcp/10.0.0.1:7447"
    assert start in " ".join(text(board, 9.0).replace("│", " ").split())


def test_services_of_a_known_session(board):
    """Its own commands start the missing ones; those that it was started without are no rows."""
    world = "/a/folder/with/a/long/name/that/fits/into/no/column/of/the/table/office.yaml"
    command = f"python -m services.estimator --world={world}"
    commands = {"estimator": command, "recorder": "python -m services.recorder"}
    with session_file(DEFAULT_ENDPOINT, ["robot"], None, commands):
        names = [row.service.name for row in board.rows(0.0)]
        note, shown = row(board, "estimator").note, text(board)
    assert names == ["simulator", "estimator", "controller", "recorder"]
    assert note == f"start it: {command}"
    assert world in "".join(shown.replace("│", " ").split())


def test_rates_and_counts(board):
    topics = [
        TopicHealth(key="presage/robot/belief", published=30, rate=10.0),
        TopicHealth(key="presage/robot/scan", received=30, rate=15.0, dropped=2, undecodable=3),
        TopicHealth(key="presage/robot/goal", received=1, rate=0.0),
        TopicHealth(key="presage/robot/health/estimator", published=9, rate=1.0),
        TopicHealth(key="others", received=9, dropped=4),
    ]
    board.monitor.set_alive({"estimator"}, 0.0)
    board.add_message(HEALTH, health("estimator", *topics, counters={"failed": 5}), 0, 1.0)
    found = row(board, "estimator", 1.0)
    assert [(rate.topic, rate.hz, rate.slow) for rate in found.published] == [("belief", 10.0, True)]
    assert [(rate.topic, rate.hz, rate.slow) for rate in found.received] == [("scan", 15.0, False)]
    line = next(line for line in text(board, 1.0).splitlines() if "estimator" in line)
    cells = " ".join(line.replace("│", " ").split())
    assert cells == "estimator alive 0.0 s 1:05 belief 10.0 scan 15.0 6 3 5"
    late = row(board, "estimator", 1.1 + REPORT_TIMEOUT_S)
    assert late.published == late.received == ()


def test_latency_is_the_median(board):
    for name in ("estimator", "controller"):
        board.add_message(HEALTH, health(name), 0, 0.0)
    for stamp, latency in enumerate((5, 7, 90)):
        board.add_message(SCAN, scan(stamp), stamp * 1000 * MS, 0.0)
        board.add_message(BELIEF, belief(stamp), stamp * 1000 * MS + latency * MS, 0.0)
        for repeated in (2, 500):  # only the first command answers the belief
            command = CmdVel(stamp_ns=stamp, twist=Twist())
            board.add_message(CMD_VEL, command, stamp * 1000 * MS + (latency + repeated) * MS, 0.0)
    board.add_message(BELIEF, belief(99), 1, 0.0)  # without a scan
    assert row(board, "estimator").latency_ms == pytest.approx(7.0)
    assert row(board, "controller").latency_ms == pytest.approx(2.0)
    assert row(board, "simulator").latency_ms is None


def test_memory_is_limited(board):
    for stamp in range(10 * LATENCY_WINDOW):
        board.add_message(SCAN, scan(stamp), stamp, 0.0)
    assert all(len(stamps) <= LATENCY_WINDOW for stamps in board._published.values())


def test_notes_are_made_printable(board):
    board.add_message(HEALTH, health("simulator", note="[red]x[/red] \x1b[2J"), 0, 0.0)
    assert "[red]x[/red]" in text(board)
    assert "\x1b" not in text(board)
