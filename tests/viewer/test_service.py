"""The viewer as a process over zenoh: access, a robot made of synthetic messages, hostile visitors."""

from __future__ import annotations

import contextlib
import json
import socket
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, IncomingRequest, Sample
from common.geometry.world import load_world
from common.messages.definitions import Health
from common.messages.requests import ModelReply, Reply, WorldReply
from common.messages.topics import HEALTH, MODEL, PAUSE, PREFERENCE, SCAN, TOPICS, TRUTH, WORLD
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.viewer.state.robot_view import SHOWN_TOPICS
from tests.conftest import WAIT_TIMEOUT_S, received_messages
from tests.viewer.client import Page, is_complete, page_of
from tests.viewer.messages import RANGES, at, preference


@pytest.fixture
def viewer(process):
    """Returns a function that starts a viewer and returns its process and link."""

    def start(*args, env=None):
        running = process("viewer", "--port", "0", *args, env=env)
        return running, page_of(running)

    return start


def fetch(url, **headers):
    """Status, headers and text of a page."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=WAIT_TIMEOUT_S) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read().decode()


class Pretence:
    """A robot made of synthetic messages."""

    def __init__(self, bus):
        self.bus = bus
        assert all(bus.wait_matching(topic, WAIT_TIMEOUT_S) for topic in SHOWN_TOPICS if topic is not HEALTH)

    def say(self, stamp_s, **how):
        for topic, message in at(stamp_s, **how).items():
            self.bus.put(topic, message.encode())

    def keep_saying(self, page, wanted, begin=1.0, timeout=WAIT_TIMEOUT_S):
        """Publishes one stamp after another until a frame meets a condition."""
        deadline, stamp = time.monotonic() + timeout, begin
        while time.monotonic() < deadline:
            stamp += 1 / 15
            self.say(stamp)
            with contextlib.suppress(AssertionError):
                return page.frame(wanted, 0.2)
        raise AssertionError("no frame as wanted")


def test_empty_system(viewer, link):
    _, where = viewer()
    with Page(where) as page:
        hello = page.wait_for("hello")
        assert (hello["control"], hello["robots"], hello["robot"]) == (True, [link.robot], link.robot)
        assert page.wait_for("history")["samples"]["t"] == []
        services = page.wait_for("services", lambda m: m["linked"])
        assert [row["name"] for row in services["missing"]] == ["simulator", "estimator", "controller"]
        start = services["missing"][1]["start"]
        command = f"python -m services.estimator --robot {link.robot} --connect {link.connect[0]}"
        assert start == f"{command}  # add --world and --estimator of the session"
        rows = page.wait_for("services", lambda m: m["services"] and m["services"][0]["rates"])["services"]
        assert rows[0]["name"] == "viewer"
        answer = page.request("teleport", x=1, y=1, timeout=2.0)  # the viewer does not wait for a missing service
        assert "the simulator is not running; start it with: python -m services.simulator" in answer["reason"]


def test_headers_and_origins(viewer):
    _, where = viewer()
    status, headers, text = fetch(where)
    assert status == 200
    assert "<html" in text.lower()
    assert headers["content-security-policy"].startswith("default-src 'self';")
    assert headers["x-content-type-options"] == "nosniff"
    for outside in ("../settings.py", "%2e%2e/settings.py", "..%2fsettings.py", "ws", "no/such"):
        assert fetch(where + outside)[0] in {400, 403, 404, 426}, outside
    port = int(where.rstrip("/").rsplit(":", 1)[1])
    for origin in ("http://evil.example", f"http://127.0.0.1:{port + 1}", f"http://localhost:{port}", "null"):
        assert refused(where, origin=origin) == 403, origin
    status, _, text = fetch(where, Host=f"evil.example:{port}")  # a foreign name that leads here
    assert (status, "token" in text) == (403, True)
    assert fetch(where, Host=f"localhost:{port}")[0] == 200


def refused(where, **options):
    """The status with which a web socket is refused."""
    with pytest.raises(InvalidStatus) as error:
        Page(where, **options)
    return error.value.response.status_code


def test_token(viewer):
    _, where = viewer(env={"PRESAGE_VIEWER_TOKEN": "tea-2"})
    assert where.endswith("/?token=tea-2")
    base = where.split("?")[0]
    for url in (base, base + "?token=coffee", base + "js/main.js"):
        status, headers, _ = fetch(url)
        assert (status, headers["set-cookie"]) == (401, None), url
    status, headers, _ = fetch(where)
    assert status == 200
    assert "HttpOnly" in headers["set-cookie"]
    cookie = headers["set-cookie"].split(";")[0]
    assert fetch(base, Cookie=cookie)[0] == 200
    assert fetch(base, Cookie=cookie, Host="robot.example")[0] == 200  # a page of another host does not have the cookie
    assert refused(base) == 401
    assert refused(where, origin="http://evil.example") == 403
    with Page(base, additional_headers={"Cookie": cookie}) as page:
        assert page.wait_for("hello")["control"] is True


def test_visitors_beyond_loopback(viewer, bus, link):
    _, where = viewer("--host", "0.0.0.0")
    inbox = Inbox()
    for topic in TOPICS:
        bus.subscribe(topic, inbox, keep_all=True)
    with Page(where) as page:
        assert page.wait_for("hello")["control"] is False
        for do, fields in [
            ("goal", {"x": 1, "y": 1}), ("drive", {"vx": 1}), ("pause", {}), ("recordings", {}),
            ("open", {"name": "a.mcap"}), ("player", {"action": "pause"}), ("record", {"action": "start"}),
        ]:  # fmt: skip
            assert "only watch" in page.request(do, **fields)["reason"]
        page.done("watch", robot=link.robot)
        page.wait_for("services", lambda m: any(row["name"] == "viewer" for row in m["services"]))
    heard = {sample.topic for sample in iter(lambda: inbox.get(0), None) if isinstance(sample, Sample)}
    assert heard <= {HEALTH}


def test_messages_and_late_visitors(viewer, bus):
    _, where = viewer()
    robot = Pretence(bus)
    with Page(where) as page:
        page.wait_for("history")
        bus.put(PREFERENCE, preference(1.0).encode())
        assert page.wait_for("field").header["goal"]["x"] == 9.0
        frame = robot.keep_saying(page, lambda h: is_complete(h) and h["truth"] and h["cmd"] and h["status"])
        header = frame.header
        assert header["robot"] == bus.robot
        assert header["error"] == pytest.approx(0.5)
        np.testing.assert_array_equal(frame.arrays["ranges"], RANGES)
        np.testing.assert_array_equal(frame.arrays["predicted"], np.arange(5))
        rows = page.by_now("journal", lambda m: m["rows"])["rows"]
        assert [row["state"] for row in rows] == ["navigating"]
        services = page.wait_for("services", lambda m: len(m["missing"]) < 3)
        assert "simulator" not in [row["name"] for row in services["missing"]]  # scans arrive
        bus.put(PREFERENCE, preference(2.0, x=3.0).encode())
        assert page.wait_for("field").header["goal"]["x"] == 3.0
    bus.put(PREFERENCE, preference(3.0, x=4.0).encode())  # without visitors
    time.sleep(0.2)
    with Page(where) as page:
        assert page.frame().header["stamp_ns"] >= header["stamp_ns"]
        errors = page.last["history"]["samples"]["error"]
        assert errors == [pytest.approx(0.5)] * len(errors) != []
        assert page.by_now("field", lambda f: f.header["goal"]["x"] == 4.0).arrays["distance"][-1] == np.inf
        assert page.by_now("journal", lambda m: m["rows"])["rows"] == rows
        robot.keep_saying(page, lambda h: h["t"] > 100, begin=100.0)
        robot.keep_saying(page, lambda h: h["t"] < 10)  # time goes back
        page.by_now("history", lambda m: max(m["samples"]["t"], default=0) < 10)


def test_several_robots(viewer, bus, link):
    _, where = viewer()
    name = "two" + link.robot
    with Page(where) as page, Page(where) as other, open_bus(Link(name, link.connect)) as second:
        page.wait_for("hello")
        assert not page.request("watch", robot=name)["ok"]
        second.declare_alive("simulator")
        assert page.wait_for("hello", lambda m: len(m["robots"]) == 2)["robots"] == [link.robot, name]
        page.done("watch", robot=name)
        assert page.last["hello"]["robot"] == name
        Pretence(second).keep_saying(page, lambda h: h["robot"] == name)
        Pretence(bus).keep_saying(other, lambda h: h["robot"] == link.robot)
        second.put(PREFERENCE, preference(1.0).encode())
        page.wait_for("field", lambda f: f.header["robot"] == name)
        page.done("watch", robot=link.robot)
        assert page.frame().header["robot"] == link.robot
        for _ in range(2):  # long enough to unfollow a robot without visitors
            page.wait_for("services")
        page.done("watch", robot=name)
        assert page.wait_for("field").header["robot"] == name


class Servant:
    """Answers queries like the services."""

    def __init__(self, bus, *queries):
        self.inbox, self.world = Inbox(), load_world("maze")
        for query in queries:
            bus.serve(query, self.inbox)

    def answer(self, name, timeout=WAIT_TIMEOUT_S):
        """Answers all queries until one of this name was answered."""
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            call = self.inbox.get(left)
            if not isinstance(call, IncomingRequest):
                continue
            reply = Reply()
            if call.query is WORLD:
                reply = WorldReply(world=self.world, scanner=SCANNERS["tim571"], robot=Robot(radius=0.3))
            if call.query is MODEL:
                reply = ModelReply(estimator="precise", world=self.world)
            call.reply(reply.encode())
            if call.query.name == name:
                return
        raise AssertionError(f"no request {name}")


@pytest.mark.parametrize(("query", "radius", "beams"), [(WORLD, 0.3, 811), (MODEL, None, None)])
def test_world_that_changes(viewer, bus, query, radius, beams):
    """The simulator's, or of a real robot the estimator's map."""
    _, where = viewer()
    servant = Servant(bus, query)
    bus.declare_alive(query.server)
    with Page(where) as page:
        servant.answer(query.name)
        message = page.wait_for("world")
        assert message["world"]["name"] == "maze"
        assert (message["robot"] or {"radius": None})["radius"] == radius
        assert (message["scanner"] or {"beams": None})["beams"] == beams
        servant.world = load_world("office")
        servant.answer(query.name, 20)
        assert page.wait_for("world")["world"]["name"] == "office"


HOSTILE = [
    "", "{", "[" * 4000, '{"id": 1}', '{"id": 1, "do": "goal", "x": NaN, "y": 1}', '{"id": 1, "do": "__init__"}',
    '{"id": {"$gt": 0}, "do": "watch", "robot": "../**"}', "x" * 5000, b"\x00\x01", b"",
    '{"do": "open", "name": "../../a"}',
    '{"do": "obstacle", "action": "add", "name": "", "obstacle": {"polygon": []}}', '"😀"', "\x00",
]  # fmt: skip


def test_hostile_visitors(viewer, bus):
    running, where = viewer()
    address = ("127.0.0.1", int(where.rstrip("/").rsplit(":", 1)[1]))
    inbox = Inbox()
    bus.subscribe(HEALTH, inbox)
    with Page(where) as page:
        for message in HOSTILE:
            page.socket.send(message)
            assert not page.wait_for("answer")["ok"], message
        assert page.request("recordings")["ok"]
    with Page(where) as page:  # longer than the server accepts
        page.wait_for("hello")
        with pytest.raises(ConnectionClosed):  # noqa: PT012 - sending may fail already
            page.socket.send("x" * 200_000)
            for _ in range(100):
                page.next()
    with socket.create_connection(address, WAIT_TIMEOUT_S) as raw:
        raw.sendall(b"GET /ws HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: \xff\r\n\r\n")
        raw.shutdown(socket.SHUT_WR)
        while raw.recv(4096):
            pass
    with Page(where) as flood, Page(where) as page:
        page.wait_for("hello")
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            for i in range(1000):
                flood.socket.send(json.dumps({"id": i, "do": "recordings"}))
        assert page.request("recordings", timeout=5.0)["ok"]  # others do not wait

    def counted():
        return any(
            health.service == "viewer" and health.counters.get("malformed", 0) >= len(HOSTILE)
            for health in received_messages(inbox, Health)
        )

    assert wait_until(counted, WAIT_TIMEOUT_S)
    assert running.running
    assert "Traceback" not in running.output


def test_slow_visitor(viewer, bus):
    _, where = viewer()
    Pretence(bus)
    base = where.rstrip("/")
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    narrow.connect(("127.0.0.1", int(base.rsplit(":", 1)[1])))
    big = {"ranges": np.ones(4000, np.float32)}  # 16 kB
    sent = 400
    with Page(where) as quick, Page(where, sock=narrow, max_queue=1) as slow:
        quick.wait_for("history")
        slow.wait_for("history")
        seen = set()
        for i in range(sent):  # 6 MB, more than any buffer in between holds
            stamp = 100.0 + i / 15
            message = at(stamp)
            for topic in (TRUTH, SCAN):
                bus.put(topic, message[topic].model_copy(update=big if topic is SCAN else {}).encode())
            seen.add(quick.frame(lambda h, s=stamp: abs(h["t"] - s) < 1e-6).header["stamp_ns"])
        assert len(seen) == sent
        stamps = []
        last = 100.0 + (sent - 1) / 15
        while not stamps or stamps[-1] < last - 1e-6:
            stamps.append(slow.frame().header["t"])
        assert stamps == sorted(stamps)
        assert len(stamps) < sent / 2


def test_router_that_comes_back(processes, tmp_path):
    router, port = processes.start_router()
    env = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "again"}
    running = processes.start("viewer", "--port", "0", env=env)
    with Page(page_of(running)) as page:
        page.wait_for("services", lambda m: m["linked"])
        router.stop()
        lost = page.wait_for("services", lambda m: not m["linked"])
        assert lost["missing"][0] == {"name": "router", "start": "python -m common.router"}
        processes.start("common.router", "--listen", f"tcp/127.0.0.1:{port}")
        page.wait_for("services", lambda m: m["linked"])
        with open_bus(Link("again", (f"tcp/127.0.0.1:{port}",))) as bus:
            Pretence(bus).keep_saying(page, lambda h: h["belief"])


def test_end_with_visitors(viewer):
    running, where = viewer()
    with Page(where) as page:
        page.wait_for("hello")
        idle = socket.create_connection(("127.0.0.1", int(where.rstrip("/").rsplit(":", 1)[1])))
        with idle:
            assert running.stop() == 0, running.output
        with pytest.raises(ConnectionClosed):  # noqa: PT012 - some may be on the way
            for _ in range(100):
                page.next()
    assert "Traceback" not in running.output


def test_answer_that_does_not_come(viewer, bus):
    _, where = viewer()
    bus.declare_alive("simulator")
    bus.serve(PAUSE, Inbox())  # receives the query but never answers
    with Page(where) as page:
        page.wait_for("services", lambda m: "simulator" not in [each["name"] for each in m["missing"]])
        answer = page.request("pause")
        assert not answer["ok"]
        assert "no service answers" in answer["reason"]
