"""The bus over real zenoh, with sessions in this process and routers as processes."""

from __future__ import annotations

import signal
import threading
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

PATIENCE = 30.0


@pytest.fixture
def other(link):
    """A second session of the same robot."""
    with open_bus(link) as session:
        assert wait_until(session.linked, PATIENCE)
        yield session


def scan(i: int = 0) -> Scan:
    return Scan(stamp_ns=i, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.full(811, i))


@contextmanager
def answering(bus, query, answer):
    """Answer requests in a thread, as a service's loop does."""
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
    assert bus.wait_matching(SCAN, PATIENCE)
    sent = [scan(i).encode() for i in range(200)]
    for payload in sent:
        bus.put(SCAN, payload)
    assert wait_until(lambda: len(inbox) == 200, PATIENCE)
    got = [inbox.get(0) for _ in sent]
    assert [sample.payload for sample in got] == sent
    first = got[0]
    assert first.topic is SCAN
    assert first.key == SCAN.key(bus.robot)
    assert 0 <= first.received_ns - first.published_ns < 60e9


def test_slow_receivers_get_the_newest_and_count_the_loss(bus, other):
    inbox = Inbox()
    other.subscribe(SCAN, inbox)
    assert bus.wait_matching(SCAN, PATIENCE)
    for i in range(500):
        bus.put(SCAN, scan(i).encode())
    assert wait_until(lambda: inbox.received.total() == 500, PATIENCE)
    assert len(inbox) == 1
    assert Scan.decode(inbox.get(0).payload).stamp_ns == 499
    assert inbox.dropped[SCAN.key(bus.robot)] == 499


def test_robots_are_separate(bus, other, link):
    mine, theirs = Inbox(), Inbox()
    other.subscribe(SCAN, mine)
    with open_bus(replace(link, robot=link.robot + "x")) as neighbour:
        neighbour.subscribe(SCAN, theirs)
        neighbour.subscribe(SCAN, theirs, robot=link.robot + "y")
        assert bus.wait_matching(SCAN, PATIENCE)
        bus.put(SCAN, b"mine")
        assert wait_until(lambda: len(mine) == 1, PATIENCE)
        # What comes on the neighbour's own key arrives, so the silence above is no missing link.
        assert bus.wait_matching(SCAN, PATIENCE, key=SCAN.key(link.robot + "x"))
        bus.put(SCAN, b"theirs", key=SCAN.key(link.robot + "x"))
        assert wait_until(lambda: len(theirs) == 1, PATIENCE)
        assert theirs.get(0).payload == b"theirs"


def test_a_subscription_to_a_per_service_topic_covers_all_services(bus, other):
    inbox = Inbox()
    other.subscribe(HEALTH, inbox)
    for service in ("estimator", "controller"):
        assert bus.wait_matching(HEALTH, PATIENCE, service)
        bus.put(HEALTH, b"x", service)
    assert wait_until(lambda: len(inbox) == 2, PATIENCE)
    assert {inbox.get(0).key.rsplit("/", 1)[-1] for _ in range(2)} == {"estimator", "controller"}


def test_large_payloads_arrive_complete(bus, other):
    inbox = Inbox()
    other.subscribe(SCAN, inbox, keep_all=True)
    assert bus.wait_matching(SCAN, PATIENCE)
    payload = np.random.default_rng(0).bytes(MAX_BYTES)
    bus.put(SCAN, payload)
    bus.put(SCAN, payload + b"x")
    assert wait_until(lambda: inbox.received.total() == 2, PATIENCE)
    assert inbox.get(0).payload == payload
    assert inbox.oversized.total() == 1


def test_a_request_is_answered(bus, other):
    asked = []

    def answer(call):
        asked.append(PoseRequest.decode(call.payload))
        call.reply(Reply(ok=False, reason="a wall is there").encode())

    request = PoseRequest(pose=Pose(x=1.0, y=2.0))
    with answering(other, TELEPORT, answer):
        assert wait_until(lambda: _answers(bus, request), PATIENCE)
    assert asked[-1] == request


def _answers(bus, request) -> bool:
    try:
        return bus.ask(TELEPORT, request, Reply, timeout=1.0).reason == "a wall is there"
    except UserError:  # the queryable is not known here yet
        return False


def _said(bus, text: str) -> bool:
    try:
        bus.ask(TELEPORT, PoseRequest(pose=Pose(x=1.0, y=2.0)), Reply, timeout=1.0)
    except UserError as error:
        return text in str(error)
    return False


def test_a_refusal_is_a_user_error(bus, other):
    with answering(other, TELEPORT, lambda call: call.refuse("not on a Sunday")):
        assert wait_until(lambda: _said(bus, "refused: not on a Sunday"), PATIENCE)


def test_an_undecodable_reply_is_a_user_error(bus, other):
    with answering(other, TELEPORT, lambda call: call.reply(b"\xc1")):
        assert wait_until(lambda: _said(bus, "the reply cannot be decoded"), PATIENCE)


def test_the_error_without_a_server_says_what_to_do(bus):
    with pytest.raises(UserError, match=r"no service answers presage/\S+/teleport .* is the simulator running\?"):
        bus.ask(TELEPORT, Request(), Reply, timeout=0.3)
    with pytest.raises(UserError, match="is the estimator running"):
        bus.ask(CONFIG, Request(), Reply, timeout=0.3, service="estimator")


def _reply_to(bus, number, timeout=PATIENCE, x=1.0):
    """The reply to a non-blocking request; checks that there is exactly one."""
    inbox = Inbox()
    bus.request(TELEPORT, PoseRequest(pose=Pose(x=x, y=2.0)), number, inbox, timeout)
    assert wait_until(lambda: len(inbox) > 0, PATIENCE)
    answer = inbox.get(0)
    assert (answer.query, answer.number) == (TELEPORT, number)
    assert len(inbox) == 0
    return answer.reply()


def test_requests_do_not_block(bus, other):
    may_answer, inbox = threading.Event(), Inbox()

    def answer(call):
        x = PoseRequest.decode(call.payload).pose.x
        assert x == -1 or may_answer.wait(PATIENCE)
        call.reply(Reply(reason=f"at {x:g}").encode())

    with answering(other, TELEPORT, answer):
        assert wait_until(lambda: _reply_to(bus, 1, x=-1.0).reason == "at -1", PATIENCE)
        for number in range(20):
            bus.request(TELEPORT, PoseRequest(pose=Pose(x=float(number), y=0.0)), number, inbox, PATIENCE)
        assert len(inbox) == 0  # all requests are sent and none is answered yet
        may_answer.set()
        assert wait_until(lambda: len(inbox) >= 20, PATIENCE)
    answers = [inbox.get(0) for _ in range(len(inbox))]
    assert sorted((a.number, a.reply().reason) for a in answers) == [(n, f"at {n}") for n in range(20)]


def test_every_failed_request_gets_exactly_one_answer(bus, other):
    nobody = _reply_to(bus, 3)
    assert not nobody.ok
    assert "is the simulator running?" in nobody.reason
    kept = []
    ways = {
        "not on a Sunday": lambda call: call.refuse("not on a Sunday"),
        "cannot be decoded": lambda call: call.reply(b"\xc1"),
        "no service answers": kept.append,
    }
    now = ["not on a Sunday"]

    def answer(call):
        ways[now[0]](call)

    with answering(other, TELEPORT, answer):
        for text in ways:
            now[0] = text
            assert wait_until(lambda t=text: t in _reply_to(bus, 4, 0.5).reason, PATIENCE)
    assert kept


def test_a_requester_may_disappear(bus, other):
    calls = Inbox()
    other.serve(TELEPORT, calls)

    def asked() -> bool:
        with pytest.raises(UserError, match="no service answers"):
            bus.ask(TELEPORT, Request(), Reply, timeout=0.2)
        return len(calls) > 0

    assert wait_until(asked, PATIENCE)
    call = calls.get(0)
    call.reply(Reply().encode())
    assert other.alive() == set()


def test_liveliness_is_reported(bus, link):
    changes = []
    bus.watch_alive(lambda service, there: changes.append((service, there)))
    with open_bus(link) as session:
        session.declare_alive("estimator")
        assert wait_until(lambda: changes == [("estimator", True)], PATIENCE)
        assert wait_until(lambda: bus.alive() == {"estimator"}, PATIENCE)
        late = []
        bus.watch_alive(lambda service, there: late.append((service, there)))  # a late watcher is notified too
        # Existing and new services may be reported once or twice, but no others.
        assert wait_until(lambda: set(late) == {("estimator", True)}, PATIENCE)
    assert wait_until(lambda: changes[-1] == ("estimator", False), PATIENCE)
    assert wait_until(lambda: bus.alive() == set(), PATIENCE)


def test_a_session_closes_while_other_threads_use_it(link):
    ended = threading.Event()

    def ask(bus):
        with suppress(zenoh.ZError):  # that it is closed
            while True:
                with suppress(UserError):
                    bus.ask(CONFIG, Request(), Reply, timeout=0.01)
        ended.set()

    for _ in range(10):
        ended.clear()
        with open_bus(link) as bus:
            threading.Thread(target=ask, args=(bus,), daemon=True).start()
        assert ended.wait(PATIENCE)


def test_sessions_survive_a_restart_of_the_router(processes, free_port):
    port = free_port()
    link = Link(robot="late", connect=(f"tcp/127.0.0.1:{port}",))
    inbox = Inbox()
    with open_bus(link) as one, open_bus(link) as two:
        two.subscribe(SCAN, inbox, keep_all=True)
        assert not one.linked()
        listen = ("common.router", "--listen", link.connect[0])
        router = processes.start(*listen)
        assert one.wait_matching(SCAN, PATIENCE), router.output
        one.put(SCAN, b"with")
        assert wait_until(lambda: len(inbox) == 1, PATIENCE)

        router.send(signal.SIGKILL)
        router.wait()
        one.put(SCAN, b"without")
        assert wait_until(lambda: len(inbox) == 2, PATIENCE)

        processes.start(*listen)
        with open_bus(replace(link, listen=())) as three:  # it can be reached through the router alone
            assert three.wait_matching(SCAN, PATIENCE)
            three.put(SCAN, b"through the new one")
            assert wait_until(lambda: len(inbox) == 3, PATIENCE)
    assert [inbox.get(0).payload for _ in range(3)] == [b"with", b"without", b"through the new one"]


def test_a_router_ends_cleanly_and_ignores_settings_of_services(processes, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    env = {"PRESAGE_CONNECT": endpoint, "PRESAGE_LISTEN": "tcp/127.0.0.1:1"}
    for number in (signal.SIGTERM, signal.SIGINT):
        router = processes.start("common.router", "--listen", endpoint, env=env)
        router.wait_for("router listens")
        assert endpoint in router.output
        status, seconds = router.stop(number)
        assert status == 0, router.output
        assert seconds < 5
        assert "Traceback" not in router.output


def test_a_port_in_use_ends_the_router_with_status_2(processes):
    _, port = processes.start_router()
    second = processes.start("common.router", "--listen", f"tcp/127.0.0.1:{port}")
    assert second.wait() == 2
    assert second.output.splitlines() == [f"router: port in use: tcp/127.0.0.1:{port}; choose another with --listen"]
    with (
        pytest.raises(UserError, match=f"port in use: tcp/127.0.0.1:{port}"),
        open_bus(Link(connect=(), listen=(f"tcp/127.0.0.1:{port}",))),
    ):
        pass


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/127.0.0.1:99999", "carrier/pigeon:1", "tcp/127.0.0.1", ""])
def test_an_invalid_endpoint_is_a_one_line_error(endpoint):
    with pytest.raises(UserError) as caught, open_bus(Link(connect=(), listen=(endpoint,))):
        pass
    assert "\n" not in str(caught.value)
    assert endpoint in str(caught.value)
    assert "tcp/127.0.0.1:7447" in str(caught.value)
