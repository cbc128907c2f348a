"""The service loop in a real process over real zenoh."""

from __future__ import annotations

import json
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.errors import UserError
from common.messages.definitions import CmdVel, Goal, Health, Pose, Scan
from common.messages.requests import ConfigReply, PoseRequest, Reply, Request
from common.messages.topics import CMD_VEL, CONFIG, GOAL, HEALTH, MAX_BYTES, SCAN, TELEPORT
from tests.conftest import WAIT_TIMEOUT_S

SMALL = Path(__file__).parents[1] / "small_service.py"


class Beside:
    """A running service and its health messages."""

    def __init__(self, bus, running):
        self.bus, self.running = bus, running
        self.health, self.commands = Inbox(), Inbox()
        self.latest: Health | None = None
        bus.subscribe(HEALTH, self.health)
        bus.subscribe(CMD_VEL, self.commands, keep_all=True)
        assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), running.output
        assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
        assert bus.wait_matching(GOAL, WAIT_TIMEOUT_S)
        assert self.until(lambda h: True)

    def until(self, fits) -> bool:
        """Waits for a health message that satisfies ``fits``; returns whether it arrives."""

        def look() -> bool:
            while (sample := self.health.get(0)) is not None:
                if sample.key == HEALTH.key(self.bus.robot, "small"):
                    self.latest = Health.decode(sample.payload)
                    if fits(self.latest):
                        return True
            return False

        return wait_until(look, WAIT_TIMEOUT_S)

    def row(self, health: Health, topic):
        return next((row for row in health.topics if row.key == topic.key(self.bus.robot)), None)

    def goal(self, x: float, y: float = 0.0, *, cancel: bool = False) -> None:
        self.bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=x, y=y), cancel=cancel).encode())


@pytest.fixture
def small(bus, process):
    return Beside(bus, process(SMALL))


def scan(stamp: int) -> bytes:
    return Scan(
        stamp_ns=stamp, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.ones(5)
    ).encode()


def test_messages_are_numbered_and_counted(small):
    for i in range(20):
        small.bus.put(SCAN, scan(i))
        assert wait_until(lambda i=i: small.commands.received.total() == i + 1, WAIT_TIMEOUT_S)
    commands = [CmdVel.decode(small.commands.get(0).payload) for _ in range(20)]
    assert [(c.stamp_ns, c.seq) for c in commands] == [(i, i) for i in range(20)]
    rates = []

    def is_idle_again(health):
        if (row := small.row(health, SCAN)) is not None:
            rates.append(row.rate)
        return health.counters.get("scans") == 20 and rates[-1] == 0

    assert small.until(is_idle_again)
    assert 0 < max(rates) <= 20 / 0.9
    health = small.latest
    assert (health.service, health.counters["failed"], health.idle) == ("small", 0, False)
    assert small.row(health, SCAN).received == small.row(health, CMD_VEL).published == 20


def test_health_is_published_once_a_second(small):
    first = small.latest
    assert small.until(lambda h: h.seq >= first.seq + 2)
    before = small.latest
    assert before.uptime - first.uptime == pytest.approx(before.seq - first.seq, abs=0.9)
    small.goal(2.5)  # a long step
    assert small.until(lambda h: h.uptime > before.uptime + 2.5)
    assert small.latest.seq <= before.seq + 2  # missed messages are skipped
    last = small.latest
    assert small.until(lambda h: True)
    assert small.latest.uptime - last.uptime > 0.5


def test_undecodable_payloads(small):
    # On health, where every payload is kept: on a newest-only key one may take the place of another before it is read.
    key = HEALTH.key(small.bus.robot, "intruder")
    assert small.bus.wait_matching(HEALTH, WAIT_TIMEOUT_S, key=key)
    began = time.monotonic()
    for payload in [b"", b"\xc1", b"x" * 100, scan(1)[:-3], bytes(MAX_BYTES + 1)] * 10:
        small.bus.put(HEALTH, payload, key=key)
    assert small.until(lambda h: any(row.key == key and row.undecodable == row.received == 50 for row in h.topics))
    assert 1 <= small.running.output.count("payload dropped") <= 1 + time.monotonic() - began
    small.bus.put(SCAN, scan(5))
    assert small.until(lambda h: h.counters.get("scans") == 1)
    assert small.latest.counters["failed"] == 0


def test_exceptions_and_user_errors(small):
    small.goal(-1)
    assert small.until(lambda h: h.counters["failed"] == 1)
    assert "a bug in on_message" in small.running.output
    small.goal(-1)
    assert small.until(lambda h: h.counters["failed"] == 2)
    small.running.wait_for("step failed (as before)")
    assert "so_far=2" in small.running.output
    assert small.running.output.count("Traceback") == 1
    assert "locals" not in small.running.output
    small.goal(101)
    assert small.running.wait() == 2
    assert "small: the map ends before that" in small.running.output
    assert small.running.output.count("Traceback") == 1
    assert "closed" in small.running.output


def test_requests_to_itself(small):
    """They do not block, so that a service can answer its own requests, and end while one is open."""
    requests = [
        (3.0, 0.0, "1 teleport True at 3"),
        (-3.0, 0.0, "2 teleport False inside a wall"),
        (101.0, 0.0, "refused: small failed: ValueError: a bug in on_request"),
        (1.0, 1.0, "4 predict False no service answers"),
    ]
    for count, (x, y, text) in enumerate(requests, 1):
        small.goal(x, y, cancel=True)
        assert small.until(lambda h, n=count: h.counters.get("replies") == n), small.running.output
        assert text in small.latest.note
    small.goal(1.0, 1.0, cancel=True)
    assert small.running.stop() == 0, small.running.output


def test_requests_that_another_thread_answers(small):
    """Meanwhile the service handles messages."""

    def ask(x: float) -> Reply:
        return small.bus.query(TELEPORT, PoseRequest(pose=Pose(x=x, y=2.0)), Reply)

    with ThreadPoolExecutor(2) as pool:
        replies = [pool.submit(ask, x) for x in (3.0, 50.0)]
        small.bus.put(SCAN, scan(1))
        assert small.until(lambda h: h.counters.get("scans") == 1)
    assert replies[0].result() == Reply(reason="late at 3")
    assert replies[1].result() == Reply(ok=False, reason="inside a wall of the other thread")


def test_results_of_requests(small):
    def ask(x: float) -> Reply:
        return small.bus.query(TELEPORT, PoseRequest(pose=Pose(x=x, y=0.0)), Reply)

    assert ask(3.0) == Reply(reason="at 3")
    assert ask(-3.0) == Reply(ok=False, reason="inside a wall")
    with pytest.raises(UserError, match="refused: small failed: ValueError: a bug in on_request"):
        ask(101.0)
    with pytest.raises(UserError, match=r"refused: PoseRequest\.pose"):
        small.bus.query(TELEPORT, Request(), Reply)
    assert small.until(lambda h: any(row.key == "teleport" and row.undecodable == 1 for row in h.topics))
    assert small.latest.counters["failed"] == 1
    reply = small.bus.query(CONFIG, Request(), ConfigReply, service="small")
    config = json.loads(reply.config)
    assert (reply.service, config["robot"]) == ("small", small.bus.robot)
    assert config["connect"].startswith("tcp/127.0.0.1:")
    assert reply.versions["python"]


def test_failing_timer(bus, process):
    beside = Beside(bus, process(SMALL, "--fail", "timer"))
    beside.bus.put(SCAN, scan(5))
    assert wait_until(lambda: len(beside.commands) == 1, WAIT_TIMEOUT_S)


@pytest.mark.parametrize(
    ("number", "step_s"), [(signal.SIGTERM, 0), (signal.SIGINT, 0), (signal.SIGHUP, 0), (signal.SIGTERM, 1.0)]
)
def test_signals(small, number, step_s):
    if step_s:
        small.goal(step_s)
    assert small.running.stop(number) == 0, small.running.output
    assert "closed" in small.running.output
    assert small.running.output.rstrip().endswith("ended")
    assert "Traceback" not in small.running.output
    assert wait_until(lambda: small.bus.alive() == set(), WAIT_TIMEOUT_S)


@pytest.mark.parametrize(("when", "text"), [("making", "in the making"), ("opening", "opening")])
def test_signals_before_the_loop(process, when, text):
    running = process(SMALL, "--slow", when)
    running.wait_for(text)
    assert running.stop() == 0, running.output
    assert "closed" in running.output


def test_without_a_router(process, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    running = process(SMALL, env={"PRESAGE_CONNECT": endpoint})
    running.wait_for("ready")
    running.wait_for(f"nothing answers at {endpoint}")
    assert "start a session with `presage up`, or name its address with --connect" in running.output
    assert running.stop() == 0, running.output


def test_errors_at_the_start(router, process):
    for args, line in (
        (("--fail", "open"), "small: no weights in that folder; train some"),
        (
            ("--listen", f"tcp/127.0.0.1:{router}"),
            f"small: port in use: tcp/127.0.0.1:{router}; choose another with --listen",
        ),
    ):
        running = process(SMALL, *args)
        assert running.wait() == 2
        assert running.output.splitlines() == [line]


def test_two_robots_share_a_network(bus, process, link):
    beside = Beside(bus, process(SMALL))
    other = process(SMALL, env={"PRESAGE_ROBOT": link.robot + "b"})
    other.wait_for("ready")
    assert beside.bus.wait_matching(SCAN, WAIT_TIMEOUT_S, key=SCAN.key(link.robot + "b"))
    beside.bus.put(SCAN, scan(1))
    assert wait_until(lambda: len(beside.commands) == 1, WAIT_TIMEOUT_S)
    assert beside.until(lambda h: h.counters.get("scans") == 1)
    assert wait_until(lambda: beside.bus.alive() == {"small"}, WAIT_TIMEOUT_S)  # one look may come too early
