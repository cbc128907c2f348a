"""The bus over real zenoh, with sessions in this process and routers as processes."""

from __future__ import annotations

import re
import signal
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox
from common.errors import UserError
from common.messages.definitions import Pose, Scan
from common.messages.requests import PoseRequest, Reply, Request
from common.messages.topics import CONFIG, HEALTH, MAX_BYTES, SCAN, TELEPORT
from tests.conftest import WAIT_TIMEOUT_S


@pytest.fixture
def other(link):
    """A second session of the same robot."""
    with open_bus(link) as session:
        assert wait_until(session.linked, WAIT_TIMEOUT_S)
        yield session


def scan(i: int = 0) -> Scan:
    return Scan(stamp_ns=i, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.full(811, i))


@contextmanager
def answering(bus, query, answer):
    """Answers requests in a thread, as a service's loop does."""
    inbox, end = Inbox(), threading.Event()
    bus.serve(query, inbox)

    def loop():
        while not end.is_set():
            if (call := inbox.get(0.05)) is not None:
                answer(call)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def test_payloads_arrive_unchanged_in_order(bus, other):
    inbox = Inbox()
    other.subscribe(SCAN, inbox, keep_all=True)
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    large, began_ns = np.random.default_rng(0).bytes(MAX_BYTES), time.monotonic_ns()
    sent = [*(scan(i).encode() for i in range(200)), large]
    for payload in (*sent, large + b"x"):
        bus.put(SCAN, payload)
    assert wait_until(lambda: inbox.received.total() == 202, WAIT_TIMEOUT_S)
    samples = [inbox.get(0) for _ in range(len(inbox))]
    assert [sample.payload for sample in samples] == sent
    assert (samples[0].topic, samples[0].key) == (SCAN, SCAN.key(bus.robot))
    assert began_ns <= samples[0].received_ns <= time.monotonic_ns()
    assert abs(time.time_ns() - samples[0].published_ns) < 60e9
    assert inbox.oversized.total() == 1


def test_slow_receivers_get_the_newest(bus, other):
    inbox = Inbox()
    other.subscribe(SCAN, inbox)
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    for i in range(500):
        bus.put(SCAN, scan(i).encode())
    assert wait_until(lambda: inbox.received.total() == 500, WAIT_TIMEOUT_S)
    assert (len(inbox), inbox.dropped[SCAN.key(bus.robot)]) == (1, 499)
    assert Scan.decode(inbox.get(0).payload).stamp_ns == 499


def test_robots_are_separate(bus, other, link):
    mine, theirs = Inbox(), Inbox()
    other.subscribe(SCAN, mine)
    with open_bus(replace(link, robot=link.robot + "x")) as neighbour:
        neighbour.subscribe(SCAN, theirs)
        neighbour.subscribe(SCAN, theirs, robot=link.robot + "y")
        for key, inbox in ((SCAN.key(bus.robot), mine), (SCAN.key(neighbour.robot), theirs)):
            assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S, key=key)
            bus.put(SCAN, key.encode(), key=key)
            assert wait_until(lambda i=inbox: len(i) == 1, WAIT_TIMEOUT_S)
        assert theirs.get(0).payload == SCAN.key(neighbour.robot).encode()


def test_subscription_to_all_services(bus, other):
    inbox = Inbox()
    other.subscribe(HEALTH, inbox)
    for service in ("estimator", "controller"):
        assert bus.wait_matching(HEALTH, WAIT_TIMEOUT_S, service)
        bus.put(HEALTH, b"x", service)
    assert wait_until(lambda: len(inbox) == 2, WAIT_TIMEOUT_S)
    assert {inbox.get(0).key.rsplit("/", 1)[-1] for _ in range(2)} == {"estimator", "controller"}


def result(bus, timeout=1.0, **options) -> str:
    """The reason in the reply to a blocking request, or the error."""
    try:
        return bus.query(TELEPORT, PoseRequest(pose=Pose(x=1.0, y=2.0)), Reply, timeout=timeout, **options).reason
    except UserError as error:
        return str(error)


def result_without_waiting(bus, number, timeout, x=1.0) -> str:
    """The reason in the reply to a request that does not block; checks that there is exactly one reply."""
    inbox = Inbox()
    bus.send_request(TELEPORT, PoseRequest(pose=Pose(x=x, y=2.0)), number, inbox, timeout)
    assert wait_until(lambda: len(inbox) > 0, WAIT_TIMEOUT_S)
    answer = inbox.get(0)
    assert (answer.query, answer.number, len(inbox)) == (TELEPORT, number, 0)
    return answer.reply().reason


def test_results_of_requests(bus, other):
    received, kept = [], []
    ways = {
        "a wall is there": lambda call: call.reply(Reply(ok=False, reason="a wall is there").encode()),
        "refused: not on a Sunday": lambda call: call.refuse("not on a Sunday"),
        "the reply cannot be decoded": lambda call: call.reply(b"\xc1"),
        "no service answers": kept.append,
    }
    assert re.search(r"no service answers presage/\S+/teleport .* is the simulator running\?", result(bus, 0.3))
    assert "is the estimator running" in result(bus, 0.3, service="estimator")
    assert "is the simulator running?" in result_without_waiting(bus, 3, 1.0)
    answer = []

    def handle(call):
        received.append(PoseRequest.decode(call.payload))
        answer[-1](call)

    with answering(other, TELEPORT, handle):
        for text, way in ways.items():
            answer.append(way)
            # Until the queryable is known, the error is that no service answers.
            assert wait_until(lambda t=text: t in result(bus, 0.5), WAIT_TIMEOUT_S)
            assert wait_until(lambda t=text: t in result_without_waiting(bus, 4, 0.5), WAIT_TIMEOUT_S)
    assert set(received) == {PoseRequest(pose=Pose(x=1.0, y=2.0))}
    assert kept


def test_requests_do_not_block(bus, other):
    may_answer, inbox = threading.Event(), Inbox()

    def answer(call):
        x = PoseRequest.decode(call.payload).pose.x
        assert x == -1 or may_answer.wait(WAIT_TIMEOUT_S)
        call.reply(Reply(reason=f"at {x:g}").encode())

    with answering(other, TELEPORT, answer):
        assert wait_until(lambda: result_without_waiting(bus, 1, WAIT_TIMEOUT_S, x=-1.0) == "at -1", WAIT_TIMEOUT_S)
        for number in range(20):
            bus.send_request(TELEPORT, PoseRequest(pose=Pose(x=float(number), y=0.0)), number, inbox, WAIT_TIMEOUT_S)
        assert len(inbox) == 0  # all requests are sent and none is answered yet
        may_answer.set()
        assert wait_until(lambda: len(inbox) >= 20, WAIT_TIMEOUT_S)
    answers = [inbox.get(0) for _ in range(len(inbox))]
    assert sorted((a.number, a.reply().reason) for a in answers) == [(n, f"at {n}") for n in range(20)]


def test_a_requester_may_disappear(bus, other):
    calls = Inbox()
    other.serve(TELEPORT, calls)

    def asked() -> bool:
        with pytest.raises(UserError, match="no service answers"):
            bus.query(TELEPORT, Request(), Reply, timeout=0.2)
        return len(calls) > 0

    assert wait_until(asked, WAIT_TIMEOUT_S)
    call = calls.get(0)
    call.reply(Reply().encode())
    assert other.alive() == set()


def test_liveliness(bus, link):
    changes = []
    bus.watch_alive(lambda *change: changes.append(change))
    with open_bus(link) as session:
        session.declare_alive("estimator")
        assert wait_until(lambda: changes == [("estimator", True)], WAIT_TIMEOUT_S)
        assert wait_until(lambda: bus.alive() == {"estimator"}, WAIT_TIMEOUT_S)
        late = []
        bus.watch_alive(lambda *change: late.append(change))  # a late watcher is notified too
        # Existing and new services may be reported once or twice, but no others.
        assert wait_until(lambda: set(late) == {("estimator", True)}, WAIT_TIMEOUT_S)
    assert wait_until(lambda: changes[-1] == ("estimator", False), WAIT_TIMEOUT_S)
    assert wait_until(lambda: bus.alive() == set(), WAIT_TIMEOUT_S)


def test_closing_a_session_in_use(link):
    ended = threading.Event()

    def ask(bus):
        with suppress(zenoh.ZError):  # that it is closed
            while True:
                with suppress(UserError):
                    bus.query(CONFIG, Request(), Reply, timeout=0.01)
        ended.set()

    for _ in range(10):
        ended.clear()
        with open_bus(link) as bus:
            threading.Thread(target=ask, args=(bus,), daemon=True).start()
        assert ended.wait(WAIT_TIMEOUT_S)


def test_restart_of_the_router(processes, free_port):
    port = free_port()
    link = Link(robot="late", connect=(f"tcp/127.0.0.1:{port}",))
    inbox = Inbox()
    with open_bus(link) as one, open_bus(link) as two:
        two.subscribe(SCAN, inbox, keep_all=True)
        assert not one.linked()
        listen = ("common.router", "--listen", link.connect[0])
        router = processes.start(*listen)
        assert one.wait_matching(SCAN, WAIT_TIMEOUT_S), router.output
        one.put(SCAN, b"with")
        assert wait_until(lambda: len(inbox) == 1, WAIT_TIMEOUT_S)

        router.send(signal.SIGKILL)
        router.wait()
        one.put(SCAN, b"without")
        assert wait_until(lambda: len(inbox) == 2, WAIT_TIMEOUT_S)

        processes.start(*listen)
        with open_bus(replace(link, listen=())) as three:  # it can be reached through the router alone
            assert three.wait_matching(SCAN, WAIT_TIMEOUT_S)
            three.put(SCAN, b"again")
            assert wait_until(lambda: len(inbox) == 3, WAIT_TIMEOUT_S)
    assert [inbox.get(0).payload for _ in range(3)] == [b"with", b"without", b"again"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_routers_end_cleanly(processes, free_port, number):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    env = {"PRESAGE_CONNECT": endpoint, "PRESAGE_LISTEN": "tcp/127.0.0.1:1"}  # for services
    router = processes.start("common.router", "--listen", endpoint, env=env)
    router.wait_for("router listens")
    assert endpoint in router.output
    assert router.stop(number) == 0, router.output
    assert "Traceback" not in router.output


def test_port_in_use(processes, router):
    endpoint = f"tcp/127.0.0.1:{router}"
    second = processes.start("common.router", "--listen", endpoint)
    assert second.wait() == 2
    assert second.output.splitlines() == [f"router: port in use: {endpoint}; choose another with --listen"]
    with pytest.raises(UserError, match=f"port in use: {endpoint}"), open_bus(Link(connect=(), listen=(endpoint,))):
        pass


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/127.0.0.1:99999", "carrier/pigeon:1", "tcp/127.0.0.1", ""])
def test_invalid_endpoints(endpoint):
    with pytest.raises(UserError) as caught, open_bus(Link(connect=(), listen=(endpoint,))):
        pass
    assert "\n" not in str(caught.value)
    assert endpoint in str(caught.value)
    assert "tcp/127.0.0.1:7447" in str(caught.value)
