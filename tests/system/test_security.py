"""Secure mode against real intruders, over real zenoh; and the whole loop in it."""

from __future__ import annotations

import json
import socket
import ssl
import threading
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox
from common.bus.security import read_credentials
from common.errors import UserError
from common.messages.definitions import CmdVel, Goal, Health, Pose, Truth, Twist
from common.messages.requests import PoseRequest, Request, WorldReply
from common.messages.topics import CMD_VEL, GOAL, HEALTH, SCAN, TELEPORT, TRUTH, WORLD
from presage.session import credentials as secure
from tests.conftest import WAIT_TIMEOUT_S, Processes, accepts, free_tcp_port, wait_for_message
from tests.recorder import sessions as recorded
from tests.viewer.client import Page, page_of

INTRUDER_SCRIPT = Path(__file__).with_name("intruder.py")
KEY_PREFIX = "presage/robot"
SERVICES = ("simulator", "estimator", "controller", "recorder", "viewer")


class SecureRouter:
    """A router in secure mode, and clients with valid or invalid credentials."""

    def __init__(self, processes: Processes) -> None:
        self.processes = processes
        self.keys, self.others = processes.folder / "keys", processes.folder / "others"
        secure.init(self.keys)
        secure.init(self.others)
        self.router, self.port = processes.start_router("--security", str(self.keys))

    def restart_router(self):
        self.router.stop()
        listen = f"tcp/127.0.0.1:{self.port}"
        self.router = self.processes.start("common.router", "--listen", listen, "--security", str(self.keys))
        assert wait_until(lambda: accepts(self.port), WAIT_TIMEOUT_S), self.router.output

    @contextmanager
    def session(self, name, **more):
        link = Link(connect=(f"tcp/127.0.0.1:{self.port}",), security=read_credentials(self.keys, (name,)), **more)
        with open_bus(link, connect_timeout=WAIT_TIMEOUT_S) as bus:
            assert wait_until(bus.linked, WAIT_TIMEOUT_S)
            yield bus

    def settings(self, name, keys=None):
        """Settings of a plain zenoh client with the credentials of ``name``, without client-side access control."""
        mine = read_credentials(keys or self.keys, (name,)).zenoh()
        del mine["access_control"]
        return {
            **mine, "mode": "client", "connect/endpoints": [f"tls/127.0.0.1:{self.port}"],
            "connect/timeout_ms": 20_000, "connect/exit_on_failure": True, "transport/shared_memory/enabled": False,
        }  # fmt: skip

    def intrude(self, settings, *actions):
        """Runs the intruder script. Returns its output."""
        running = self.processes.start(INTRUDER_SCRIPT, json.dumps(settings), *map(json.dumps, actions))
        running.wait(60)
        return running.output


@pytest.fixture(scope="module")
def secure_router(module_processes):
    return SecureRouter(module_processes)


def invalid_settings(secure_router):
    """Settings of clients that the router refuses, by the reason in its log."""
    mine, observer = secure_router.settings("controller"), secure_router.settings("observer")
    theirs = secure_router.settings("controller", secure_router.others)
    tls, wait = "transport/link/tls", {"connect/timeout_ms": 1000, "connect/exit_on_failure": True}
    authority = "root_ca_certificate"
    plain = {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{secure_router.port}"]}
    no_certificate = {key: observer[tls][key] for key in (authority, "verify_name_on_connect")}
    other_authority = {**theirs[tls], authority: mine[tls][authority]}  # same name, right password
    return {
        "no TLS": {**plain, **wait, "scouting/multicast/enabled": False},
        "no certificate": {**observer, **wait, tls: no_certificate},
        "certificate of another authority": {**mine, **wait, tls: other_authority},
        "wrong password": {**mine, **wait, "transport/auth/usrpwd": {"user": "controller", "password": "guess"}},
        "no password": {**{key: value for key, value in mine.items() if key != "transport/auth/usrpwd"}, **wait},
    }


def test_invalid_credentials(secure_router):
    for reason, settings in invalid_settings(secure_router).items():
        assert "not let in" in secure_router.intrude(settings), reason
        secure_router.router.wait_for(f"reason='{reason}")
    # The same client with valid credentials is accepted, so these are the reason.
    assert "not let in" not in secure_router.intrude(secure_router.settings("observer"))


def test_forbidden_actions(secure_router):
    """An observer, an observer with the controller's certificate but its own password, and an estimator."""
    command = CmdVel(stamp_ns=1, twist=Twist(vx=1.0)).encode().hex()
    own = CmdVel(stamp_ns=7, twist=Twist()).encode()
    goal = Goal(stamp_ns=1, pose=Pose(x=1.0, y=1.0)).encode().hex()
    request = PoseRequest(pose=Pose(x=1.0, y=1.0)).encode().hex()
    observer = secure_router.settings("observer")
    mixed = {
        **secure_router.settings("controller"),
        "transport/auth/usrpwd": observer["transport/auth/usrpwd"],
    }
    commands, goals, calls, scans = Inbox(), Inbox(), Inbox(), Inbox()
    with (
        secure_router.session("simulator") as simulator,
        secure_router.session("controller") as controller,
        secure_router.session("estimator") as estimator,
    ):
        simulator.subscribe(CMD_VEL, commands, keep_all=True)
        simulator.serve(TELEPORT, calls)
        controller.subscribe(GOAL, goals, keep_all=True)
        estimator.subscribe(SCAN, scans, keep_all=True)
        puts = [["put", f"presage/{key}", command] for key in ("robot/cmd_vel", "*/cmd_vel", "**")]
        gets = [["get", f"presage/{key}", request] for key in ("robot/teleport", "**")]
        output = secure_router.intrude(observer, *puts, ["put", f"{KEY_PREFIX}/goal", goal], *gets)
        assert "done" in output
        assert output.count("answers 0") == 2, output
        assert "done" in secure_router.intrude(mixed, puts[0])
        assert "done" in secure_router.intrude(secure_router.settings("estimator"), ["put", f"{KEY_PREFIX}/scan", "00"])
        # The first message to arrive is from a sender with the right, so none of those before it arrived.
        for sender, topic, payload, inbox in (
            (controller, CMD_VEL, own, commands),
            (simulator, SCAN, b"mine", scans),
        ):
            assert sender.wait_matching(topic, WAIT_TIMEOUT_S)
            sender.put(topic, payload)
            assert wait_until(lambda i=inbox: len(i) > 0, WAIT_TIMEOUT_S)
            assert inbox.get(0).payload == payload
    assert goals.get(0) is calls.get(0) is None
    for line in (f"key={KEY_PREFIX}/cmd_vel", "observer reason=put", "observer reason=query", "estimator reason=put"):
        secure_router.router.wait_for(line)


@pytest.mark.parametrize(("name", "answered"), [("router", True), ("observer", False)])
def test_imposter_of_the_router(secure_router, name, answered):
    """An observer that listens at the router's address gets no requests, and its replies are not accepted."""
    port = free_tcp_port()
    settings = secure_router.settings(name)
    settings["transport/auth/usrpwd"]["dictionary_file"] = str(secure_router.keys / "router" / "passwords")  # at worst
    settings |= {"mode": "router", "connect/endpoints": [], "listen/endpoints": [f"tls/127.0.0.1:{port}"]}
    reply = WorldReply(reason="I am the world").encode().hex()
    fake = secure_router.processes.start(
        INTRUDER_SCRIPT, json.dumps(settings), json.dumps(["serve", f"{KEY_PREFIX}/world", reply])
    )
    fake.wait_for("serving")
    link = Link(connect=(f"tcp/127.0.0.1:{port}",), security=read_credentials(secure_router.keys, ("operator",)))
    with open_bus(link, connect_timeout=WAIT_TIMEOUT_S) as bus:
        assert wait_until(bus.linked, WAIT_TIMEOUT_S)
        if answered:
            assert bus.query(WORLD, Request(), WorldReply, WAIT_TIMEOUT_S).reason == "I am the world"
        else:
            with pytest.raises(UserError, match="no service answers"):
                bus.query(WORLD, Request(), WorldReply, 2.0)
    fake.kill()


def test_tokens_seen_by_newcomers(secure_router):
    """A client also answers liveliness queries itself, possibly before it has received any tokens."""
    with ExitStack() as stack:
        for name in SERVICES[:4]:
            stack.enter_context(secure_router.session(name)).declare_alive(name)
        watching = stack.enter_context(secure_router.session("observer"))
        assert wait_until(lambda: watching.alive() == set(SERVICES[:4]), WAIT_TIMEOUT_S)
        for _ in range(20):
            with secure_router.session("observer") as newcomer:
                assert newcomer.alive() == set(SERVICES[:4])
                assert newcomer.alive() == set(SERVICES[:4])


def test_removed_user(secure_router):
    secure.add(secure_router.keys, "operator", "anna")
    secure_router.restart_router()
    annas = secure_router.settings("anna")
    assert "not let in" not in secure_router.intrude(annas)
    kept = secure_router.keys / "kept"
    (secure_router.keys / "anna").rename(kept)  # a copy of the removed user's credentials
    secure.remove(secure_router.keys, "anna")
    secure_router.restart_router()
    kept.rename(secure_router.keys / "anna")
    assert "not let in" in secure_router.intrude({**annas, "connect/timeout_ms": 1000})
    secure_router.router.wait_for("password'")


@contextmanager
def clients_without_certificate(port, count):
    """Clients that connect, fail and connect again until the block ends."""
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    tls.check_hostname, tls.verify_mode = False, ssl.CERT_NONE
    ended, failed = threading.Event(), [False] * count

    def fail(number):
        while not ended.is_set():
            with (
                suppress(OSError),
                socket.create_connection(("127.0.0.1", port), WAIT_TIMEOUT_S) as plain,
                tls.wrap_socket(plain) as refused,
            ):
                refused.recv(1)
            failed[number] = True

    threads = [threading.Thread(target=fail, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    try:
        assert wait_until(lambda: all(failed), WAIT_TIMEOUT_S)
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def test_join_while_others_fail(secure_router):
    """Zenoh handles ten failed handshakes per second, and a valid client waits for all of them twice."""
    with clients_without_certificate(secure_router.port, 16), secure_router.session("operator"):
        pass


def test_stop_while_waiting_for_the_router(secure_router):
    port = free_tcp_port()
    waiting = secure_router.processes.start(
        "simulator", "--security", str(secure_router.keys), "--connect", f"tcp/127.0.0.1:{port}"
    )
    waiting.wait_for("waiting")
    assert waiting.stop() == 0, waiting.output


def test_recording_opened_on_the_page(secure_router, tmp_path):
    secure.add(secure_router.keys, "replay", "replay")
    secure_router.restart_router()
    recorded.write(tmp_path / "hall.mcap")
    options = ("--port", "0", "--recordings", str(tmp_path), "--connect", f"tcp/127.0.0.1:{secure_router.port}")
    environment = {"PRESAGE_ROLE": "viewer-control"}  # must not become that of the replay
    viewer = secure_router.processes.start("viewer", *options, "--security", str(secure_router.keys), env=environment)
    with Page(page_of(viewer)) as page:
        page.wait_for("services", lambda m: m["linked"])
        page.done("open", name="hall.mcap")
        assert page.by_now("world", lambda m: m["world"])["world"]["name"] == "hall"
        page.frame(lambda header: header["robot"] == "robot-replay")
        page.done("close")
    assert viewer.stop() == 0, viewer.output


def test_whole_loop_and_replayed_command(secure_router):
    """Runs every service in its own role, then sends a recorded command again with the controller's credentials."""
    environment = {
        "PRESAGE_SECURITY": str(secure_router.keys),
        "PRESAGE_CONNECT": f"tcp/127.0.0.1:{secure_router.port}",
    }
    more = {"viewer": ["--port", "0"], "recorder": ["--directory", "recordings"], "simulator": ["--beams", "181"]}
    started = [secure_router.processes.start(name, *more.get(name, []), env=environment) for name in SERVICES]
    inbox, truths, commands = Inbox(), Inbox(), Inbox()
    with secure_router.session("operator") as bus:
        wait_until(lambda: set(SERVICES) <= bus.alive(timeout=0.5) or not all(p.running for p in started), 120)
        assert set(SERVICES) <= bus.alive(), "\n".join(p.output for p in started)
        bus.subscribe(CMD_VEL, commands, keep_all=True)
        goal = secure_router.processes.start("presage.__main__", "goal", "4.5", "1.5", "--wait", env=environment)
        assert goal.wait(120) == 0, goal.output
        assert "reached" in goal.output
        old = wait_for_message(commands, CmdVel, lambda c: np.hypot(c.twist.vx, c.twist.vy) > 0.3)
        bus.subscribe(HEALTH, inbox, keep_all=True)
        # While the controller is active, other sources are ignored. Afterwards old commands are refused.
        for counter in ("other_sources", "stale_commands"):
            before = wait_for_message(inbox, Health, lambda h: h.service == "simulator").counters.get(counter, 0)
            played = secure_router.intrude(
                secure_router.settings("controller"), ["put", f"{KEY_PREFIX}/cmd_vel", old.encode().hex()]
            )
            assert "done" in played
            wait_for_message(
                inbox, Health,
                lambda h, c=counter, b=before: h.service == "simulator" and h.counters.get(c, 0) > b,
            )  # fmt: skip
            if counter == "other_sources":
                controller = started[SERVICES.index("controller")]
                assert controller.stop() == 0, controller.output
                assert wait_until(lambda: "controller" not in bus.alive(), 20)
                bus.subscribe(TRUTH, truths, keep_all=True)
                there = wait_for_message(truths, Truth, lambda t: np.hypot(t.twist.vx, t.twist.vy) < 1e-3)
        while len(truths) > 1:
            truths.get(0)
        after = wait_for_message(truths, Truth, lambda _: True)
    assert np.hypot(after.pose.x - 4.5, after.pose.y - 1.5) < 0.3
    assert np.hypot(after.pose.x - there.pose.x, after.pose.y - there.pose.y) < 0.05
    statuses = {process.name: process.stop() for process in reversed(started) if process.running}
    assert set(statuses.values()) == {0}, statuses
    (recording,) = (started[3].log.parent / "recordings").glob("*.mcap")
    assert recording.stat().st_size > 10_000
