"""Secure mode against real intruders, over real zenoh; and the whole loop in it."""

from __future__ import annotations

import json
import socket
import ssl
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.bus.security import credentials
from common.errors import UserError
from common.messages.definitions import CmdVel, Goal, Health, Pose, Truth, Twist
from common.messages.requests import PoseRequest, Reply, Request, WorldReply
from common.messages.topics import CMD_VEL, GOAL, HEALTH, SCAN, TELEPORT, TRUTH, WORLD
from presage.session import credentials as secure
from tests.conftest import WAIT_TIMEOUT_S, Processes, accepts, free_tcp_port, wait_for_message

INTRUDER_SCRIPT = Path(__file__).with_name("intruder.py")
KEY_PREFIX = "presage/robot"
SERVICES = ("simulator", "estimator", "controller", "recorder", "viewer")


class SecureRouter:
    """A router in secure mode, and clients with valid or invalid credentials."""

    def __init__(self, folder: Path) -> None:
        self.processes = Processes(folder)
        self.keys, self.others = folder / "keys", folder / "others"
        secure.init(self.keys)
        secure.init(self.others)
        self.router, self.port = self.start_router()

    def start_router(self, port=None):
        for _ in range(5):
            taken = port or free_tcp_port()
            running = self.processes.start(
                "common.router", "--listen", f"tcp/127.0.0.1:{taken}", "--security", str(self.keys)
            )
            wait_until(lambda r=running, p=taken: not r.running or accepts(p), WAIT_TIMEOUT_S)
            if running.running:
                return running, taken
        raise AssertionError(running.output)

    @contextmanager
    def session(self, name, **more):
        link = Link(connect=(f"tcp/127.0.0.1:{self.port}",), security=credentials(self.keys, (name,)), **more)
        with open_bus(link, connect_timeout=WAIT_TIMEOUT_S) as bus:
            assert wait_until(bus.linked, WAIT_TIMEOUT_S)
            yield bus

    def settings(self, name, keys=None):
        """Settings of a plain zenoh client with the credentials of ``name``, without client-side access control."""
        mine = credentials(keys or self.keys, (name,)).zenoh()
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
def secure_router(tmp_path_factory):
    made = SecureRouter(tmp_path_factory.mktemp("guarded"))
    try:
        yield made
    finally:
        made.processes.close()


def plain_tcp(secure_router):
    mine = secure_router.settings("observer")
    return {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{secure_router.port}"],
        "scouting/multicast/enabled": False,
        **{key: mine[key] for key in ("connect/timeout_ms", "connect/exit_on_failure")},
    }


def no_certificate(secure_router):
    mine = secure_router.settings("observer")
    tls = mine["transport/link/tls"]
    return {
        **mine,
        "transport/link/tls": {key: tls[key] for key in ("root_ca_certificate", "verify_name_on_connect")},
    }


def wrong_password(secure_router):
    return {
        **secure_router.settings("controller"),
        "transport/auth/usrpwd": {"user": "controller", "password": "guess"},
    }


def no_password(secure_router):
    mine = secure_router.settings("controller")
    del mine["transport/auth/usrpwd"]
    return mine


def other_authority(secure_router):
    """A certificate of another authority, with the same name and the right password."""
    mine, theirs = secure_router.settings("controller"), secure_router.settings("controller", secure_router.others)
    tls = {
        **theirs["transport/link/tls"],
        "root_ca_certificate": mine["transport/link/tls"]["root_ca_certificate"],
    }
    return {**mine, "transport/link/tls": tls}


@pytest.mark.parametrize(
    ("settings_of", "expected_text"),
    [
        (plain_tcp, "no TLS"),
        (no_certificate, "no certificate"),
        (wrong_password, "wrong password"),
        (no_password, "no password"),
        (other_authority, "certificate of another authority"),
    ],
)
def test_clients_with_invalid_credentials_are_refused_and_logged(secure_router, settings_of, expected_text):
    assert "not let in" in secure_router.intrude({**settings_of(secure_router), "connect/timeout_ms": 1000})
    secure_router.router.wait_for(f"why='{expected_text}")


def test_the_same_client_with_valid_credentials_is_accepted(secure_router):
    """Shows that the other clients are refused only because of their credentials."""
    assert "not let in" not in secure_router.intrude(secure_router.settings("observer"))


def test_another_users_certificate_with_ones_own_password_gives_no_rights(secure_router):
    """An observer that uses the controller's certificate with its own password."""
    mixed = {
        **secure_router.settings("controller"),
        "transport/auth/usrpwd": secure_router.settings("observer")["transport/auth/usrpwd"],
    }
    command = CmdVel(stamp_ns=1, twist=Twist(vx=1.0, vy=0.0, wz=0.0))
    inbox_of_victim = Inbox()
    with secure_router.session("simulator") as simulator, secure_router.session("controller") as controller:
        simulator.subscribe(CMD_VEL, inbox_of_victim, keep_all=True)
        assert "done" in secure_router.intrude(mixed, ["put", CMD_VEL.key("robot"), command.encode().hex()])
        assert stamps_until_own(controller, inbox_of_victim) == [7]


def stamps_until_own(controller, inbox_of_victim):
    """Stamps of the received commands up to the controller's own command, which has stamp 7."""
    own = CmdVel(stamp_ns=7, twist=Twist(vx=0.0, vy=0.0, wz=0.0)).encode()
    assert controller.wait_matching(CMD_VEL, WAIT_TIMEOUT_S)
    controller.put(CMD_VEL, own)
    stamps = []

    def check():
        while isinstance(sample := inbox_of_victim.get(0), Sample):
            stamps.append(CmdVel.decode(sample.payload).stamp_ns)
        return 7 in stamps

    assert wait_until(check, WAIT_TIMEOUT_S)
    return stamps


def test_an_observer_may_not_command_set_goals_or_teleport(secure_router):
    command = CmdVel(stamp_ns=1, twist=Twist(vx=1.0, vy=0.0, wz=0.0)).encode().hex()
    goal = Goal(stamp_ns=1, pose=Pose(x=1.0, y=1.0, yaw=0.0)).encode().hex()
    request = PoseRequest(pose=Pose(x=1.0, y=1.0, yaw=0.0)).encode().hex()
    inbox_of_victim, goals, calls = Inbox(), Inbox(), Inbox()
    with secure_router.session("simulator") as simulator, secure_router.session("controller") as controller:
        simulator.subscribe(CMD_VEL, inbox_of_victim, keep_all=True)
        simulator.serve(TELEPORT, calls)
        controller.subscribe(GOAL, goals, keep_all=True)
        output = secure_router.intrude(
            secure_router.settings("observer"),
            ["put", f"{KEY_PREFIX}/cmd_vel", command],
            ["put", "presage/*/cmd_vel", command],
            ["put", "presage/**", command],
            ["put", f"{KEY_PREFIX}/goal", goal],
            ["get", f"{KEY_PREFIX}/teleport", request],
            ["get", "presage/**", request],
        )
        assert "done" in output
        assert output.count("answers 0") == 2, output
        assert stamps_until_own(controller, inbox_of_victim) == [7]
    assert goals.get(0) is None
    assert calls.get(0) is None
    secure_router.router.wait_for(f"key={KEY_PREFIX}/cmd_vel")
    secure_router.router.wait_for("who=observer why=put")
    secure_router.router.wait_for("who=observer why=query")


def test_an_estimator_may_not_publish_scans(secure_router):
    inbox_of_victim = Inbox()
    with secure_router.session("estimator") as victim, secure_router.session("simulator") as scanner:
        victim.subscribe(SCAN, inbox_of_victim, keep_all=True)
        assert "done" in secure_router.intrude(secure_router.settings("estimator"), ["put", f"{KEY_PREFIX}/scan", "00"])
        assert scanner.wait_matching(SCAN, WAIT_TIMEOUT_S)
        scanner.put(SCAN, b"mine")
        assert wait_until(lambda: len(inbox_of_victim) > 0, WAIT_TIMEOUT_S)
        assert inbox_of_victim.get(0).payload == b"mine"
    secure_router.router.wait_for("who=estimator why=put")


@pytest.mark.parametrize(("name", "answered"), [("router", True), ("observer", False)])
def test_only_a_router_certificate_is_accepted_from_a_router(secure_router, name, answered):
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
    link = Link(connect=(f"tcp/127.0.0.1:{port}",), security=credentials(secure_router.keys, ("operator",)))
    with open_bus(link, connect_timeout=WAIT_TIMEOUT_S) as bus:
        assert wait_until(bus.linked, WAIT_TIMEOUT_S)
        if answered:
            assert bus.ask(WORLD, Request(), WorldReply, WAIT_TIMEOUT_S).reason == "I am the world"
        else:
            with pytest.raises(UserError, match="no service answers"):
                bus.ask(WORLD, Request(), WorldReply, 2.0)
    fake.kill()


def test_a_new_session_sees_all_liveliness_tokens_at_once(secure_router):
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


def test_a_removed_user_is_refused_after_the_router_restarts(secure_router):
    secure.add(secure_router.keys, "operator", "anna")
    secure_router.router.stop()
    secure_router.router, _ = secure_router.start_router(secure_router.port)
    annas = secure_router.settings("anna")
    assert "not let in" not in secure_router.intrude(annas)
    kept = secure_router.keys / "kept"
    (secure_router.keys / "anna").rename(kept)  # a copy of the removed user's credentials
    secure.remove(secure_router.keys, "anna")
    secure_router.router.stop()
    secure_router.router, _ = secure_router.start_router(secure_router.port)
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


def test_a_member_joins_while_others_keep_failing(secure_router):
    """Zenoh handles ten failed handshakes per second, and a valid client waits for all of them twice."""
    with clients_without_certificate(secure_router.port, 16):
        began = time.monotonic()
        with secure_router.session("operator"):
            print(f"joined in {time.monotonic() - began:.2f} s")


def test_actions_forbidden_to_a_role_raise_an_error_locally(secure_router):
    with secure_router.session("observer") as bus:
        with pytest.raises(UserError, match="role 'observer' may not publish goal; allowed roles: operator"):
            bus.put(GOAL, b"")
        with pytest.raises(UserError, match="role 'observer' may not query teleport"):
            bus.ask(TELEPORT, PoseRequest(pose=Pose(x=0.0, y=0.0, yaw=0.0)), Reply)


def test_a_service_waits_for_its_router_and_can_be_stopped_while_waiting(secure_router):
    port = free_tcp_port()
    waiting = secure_router.processes.start(
        "simulator", "--security", str(secure_router.keys), "--connect", f"tcp/127.0.0.1:{port}"
    )
    waiting.wait_for("waiting")
    status, _ = waiting.stop()
    assert status == 0, waiting.output


def test_the_whole_loop_and_a_replayed_command(secure_router):
    """Runs every service in its own role, then sends a recorded command again with the controller's credentials."""
    environment = {
        "PRESAGE_SECURITY": str(secure_router.keys),
        "PRESAGE_CONNECT": f"tcp/127.0.0.1:{secure_router.port}",
    }
    more = {"viewer": ["--port", "0"], "recorder": ["--directory", "recordings"], "simulator": ["--beams", "181"]}
    started = [secure_router.processes.start(name, *more.get(name, []), env=environment) for name in SERVICES]
    inbox, commands = Inbox(), Inbox()
    with secure_router.session("operator") as bus:
        wait_until(lambda: set(SERVICES) <= bus.alive(timeout=0.5) or not all(p.running for p in started), 120)
        assert set(SERVICES) <= bus.alive(), "\n".join(p.output for p in started)
        bus.subscribe(CMD_VEL, commands, keep_all=True)
        goal = secure_router.processes.start("presage.__main__", "goal", "4.5", "1.5", "--wait", env=environment)
        assert goal.wait(120) == 0, goal.output
        assert "reached" in goal.output
        old = wait_for_message(commands, CmdVel, lambda c: np.hypot(c.twist.vx, c.twist.vy) > 0.3)
        for topic in (TRUTH, HEALTH):
            bus.subscribe(topic, inbox, keep_all=True)
        there = wait_for_message(inbox, Truth, lambda _: True)
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
                assert controller.stop()[0] == 0, controller.output
                assert wait_until(lambda: "controller" not in bus.alive(), 20)
        after = wait_for_message(inbox, Truth, lambda _: True)  # at the time of those health messages or later
    assert np.hypot(after.pose.x - 4.5, after.pose.y - 1.5) < 0.3
    assert np.hypot(after.pose.x - there.pose.x, after.pose.y - there.pose.y) < 0.05
    statuses = {process.name: process.stop()[0] for process in reversed(started) if process.running}
    assert set(statuses.values()) == {0}, statuses
    (recording,) = (started[3].log.parent / "recordings").glob("*.mcap")
    assert recording.stat().st_size > 10_000
