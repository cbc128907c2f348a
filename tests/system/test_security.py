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

INTRUDER = Path(__file__).with_name("intruder.py")
HERE = "presage/robot"
SERVICES = ("simulator", "estimator", "controller", "recorder", "viewer")


class Guarded:
    """A router in secure mode, and how to get past it, or not."""

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
        with open_bus(link, patience=WAIT_TIMEOUT_S) as bus:
            assert wait_until(bus.linked, WAIT_TIMEOUT_S)
            yield bus

    def settings(self, name, keys=None):
        """A bare zenoh client's, with these credentials, and no access control of its own."""
        mine = credentials(keys or self.keys, (name,)).zenoh()
        del mine["access_control"]
        return {
            **mine, "mode": "client", "connect/endpoints": [f"tls/127.0.0.1:{self.port}"],
            "connect/timeout_ms": 20_000, "connect/exit_on_failure": True, "transport/shared_memory/enabled": False,
        }  # fmt: skip

    def intrude(self, settings, *actions):
        """What it said in the end."""
        running = self.processes.start(INTRUDER, json.dumps(settings), *map(json.dumps, actions))
        running.wait(60)
        return running.output


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    made = Guarded(tmp_path_factory.mktemp("guarded"))
    try:
        yield made
    finally:
        made.processes.close()


def plain_tcp(guarded):
    mine = guarded.settings("observer")
    return {
        "mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{guarded.port}"], "scouting/multicast/enabled": False,
        **{key: mine[key] for key in ("connect/timeout_ms", "connect/exit_on_failure")},
    }  # fmt: skip


def no_certificate(guarded):
    mine = guarded.settings("observer")
    tls = mine["transport/link/tls"]
    return {
        **mine,
        "transport/link/tls": {key: tls[key] for key in ("root_ca_certificate", "verify_name_on_connect")},
    }


def wrong_password(guarded):
    return {**guarded.settings("controller"), "transport/auth/usrpwd": {"user": "controller", "password": "guess"}}


def no_password(guarded):
    mine = guarded.settings("controller")
    del mine["transport/auth/usrpwd"]
    return mine


def other_authority(guarded):
    """Of the same name, with the right password."""
    mine, theirs = guarded.settings("controller"), guarded.settings("controller", guarded.others)
    tls = {
        **theirs["transport/link/tls"],
        "root_ca_certificate": mine["transport/link/tls"]["root_ca_certificate"],
    }
    return {**mine, "transport/link/tls": tls}


@pytest.mark.parametrize(
    ("who", "said"),
    [
        (plain_tcp, "no TLS"),
        (no_certificate, "no certificate"),
        (wrong_password, "wrong password"),
        (no_password, "no password"),
        (other_authority, "certificate of another authority"),
    ],
)
def test_strangers_are_not_let_in_and_the_router_says_so(guarded, who, said):
    assert "not let in" in guarded.intrude({**who(guarded), "connect/timeout_ms": 1000})
    guarded.router.wait_for(f"why='{said}")


def test_the_same_intruder_with_right_credentials_is_let_in(guarded):
    """What the others lack is the credentials, and nothing else."""
    assert "not let in" not in guarded.intrude(guarded.settings("observer"))


def test_another_name_s_certificate_with_ones_own_password_has_no_rights(guarded):
    """An observer who got hold of the controller's certificate alone."""
    mixed = {
        **guarded.settings("controller"),
        "transport/auth/usrpwd": guarded.settings("observer")["transport/auth/usrpwd"],
    }
    command = CmdVel(stamp_ns=1, twist=Twist(vx=1.0, vy=0.0, wz=0.0))
    heard = Inbox()
    with guarded.session("simulator") as simulator, guarded.session("controller") as controller:
        simulator.subscribe(CMD_VEL, heard, keep_all=True)
        assert "done" in guarded.intrude(mixed, ["put", CMD_VEL.key("robot"), command.encode().hex()])
        assert stamps_until_own(controller, heard) == [7]


def stamps_until_own(controller, heard):
    """Stamps of the commands that arrive, until one of the controller itself, stamped 7, is there."""
    own = CmdVel(stamp_ns=7, twist=Twist(vx=0.0, vy=0.0, wz=0.0)).encode()
    assert controller.wait_matching(CMD_VEL, WAIT_TIMEOUT_S)
    controller.put(CMD_VEL, own)
    stamps = []

    def look():
        while isinstance(sample := heard.get(0), Sample):
            stamps.append(CmdVel.decode(sample.payload).stamp_ns)
        return 7 in stamps

    assert wait_until(look, WAIT_TIMEOUT_S)
    return stamps


def test_an_observer_does_not_drive_send_or_carry(guarded):
    command = CmdVel(stamp_ns=1, twist=Twist(vx=1.0, vy=0.0, wz=0.0)).encode().hex()
    goal = Goal(stamp_ns=1, pose=Pose(x=1.0, y=1.0, yaw=0.0)).encode().hex()
    asked = PoseRequest(pose=Pose(x=1.0, y=1.0, yaw=0.0)).encode().hex()
    heard, goals, calls = Inbox(), Inbox(), Inbox()
    with guarded.session("simulator") as simulator, guarded.session("controller") as controller:
        simulator.subscribe(CMD_VEL, heard, keep_all=True)
        simulator.serve(TELEPORT, calls)
        controller.subscribe(GOAL, goals, keep_all=True)
        output = guarded.intrude(
            guarded.settings("observer"),
            ["put", f"{HERE}/cmd_vel", command],
            ["put", "presage/*/cmd_vel", command],
            ["put", "presage/**", command],
            ["put", f"{HERE}/goal", goal],
            ["get", f"{HERE}/teleport", asked],
            ["get", "presage/**", asked],
        )
        assert "done" in output
        assert output.count("answers 0") == 2, output
        assert stamps_until_own(controller, heard) == [7]
    assert goals.get(0) is None
    assert calls.get(0) is None
    guarded.router.wait_for(f"key={HERE}/cmd_vel")
    guarded.router.wait_for("who=observer why=put")
    guarded.router.wait_for("who=observer why=query")


def test_an_estimator_does_not_speak_for_the_scanner(guarded):
    heard = Inbox()
    with guarded.session("estimator") as victim, guarded.session("simulator") as scanner:
        victim.subscribe(SCAN, heard, keep_all=True)
        assert "done" in guarded.intrude(guarded.settings("estimator"), ["put", f"{HERE}/scan", "00"])
        assert scanner.wait_matching(SCAN, WAIT_TIMEOUT_S)
        scanner.put(SCAN, b"mine")
        assert wait_until(lambda: len(heard) > 0, WAIT_TIMEOUT_S)
        assert heard.get(0).payload == b"mine"
    guarded.router.wait_for("who=estimator why=put")


@pytest.mark.parametrize(("name", "answered"), [("router", True), ("observer", False)])
def test_nobody_s_certificate_passes_for_a_router_s(guarded, name, answered):
    """An observer at the router's address: whoever dials it tells it nothing, and believes nothing."""
    port = free_tcp_port()
    settings = guarded.settings(name)
    settings["transport/auth/usrpwd"]["dictionary_file"] = str(guarded.keys / "router" / "passwords")  # at worst
    settings |= {"mode": "router", "connect/endpoints": [], "listen/endpoints": [f"tls/127.0.0.1:{port}"]}
    reply = WorldReply(reason="I am the world").encode().hex()
    fake = guarded.processes.start(INTRUDER, json.dumps(settings), json.dumps(["serve", f"{HERE}/world", reply]))
    fake.wait_for("serving")
    link = Link(connect=(f"tcp/127.0.0.1:{port}",), security=credentials(guarded.keys, ("operator",)))
    with open_bus(link, patience=WAIT_TIMEOUT_S) as bus:
        assert wait_until(bus.linked, WAIT_TIMEOUT_S)
        if answered:
            assert bus.ask(WORLD, Request(), WorldReply, WAIT_TIMEOUT_S).reason == "I am the world"
        else:
            with pytest.raises(UserError, match="no service answers"):
                bus.ask(WORLD, Request(), WorldReply, 2.0)
    fake.kill()


def test_a_session_just_opened_knows_at_once_who_is_there(guarded):
    """A router's client answers its own queries, also before it was told."""
    with ExitStack() as stack:
        for name in SERVICES[:4]:
            stack.enter_context(guarded.session(name)).declare_alive(name)
        watching = stack.enter_context(guarded.session("observer"))
        assert wait_until(lambda: watching.alive() == set(SERVICES[:4]), WAIT_TIMEOUT_S)
        for _ in range(20):
            with guarded.session("observer") as newcomer:
                assert newcomer.alive() == set(SERVICES[:4])
                assert newcomer.alive() == set(SERVICES[:4])


def test_who_is_struck_off_is_let_in_no_more_once_the_router_starts_again(guarded):
    secure.add(guarded.keys, "operator", "anna")
    guarded.router.stop()
    guarded.router, _ = guarded.start_router(guarded.port)
    annas = guarded.settings("anna")
    assert "not let in" not in guarded.intrude(annas)
    kept = guarded.keys / "kept"
    (guarded.keys / "anna").rename(kept)  # she still has it
    secure.remove(guarded.keys, "anna")
    guarded.router.stop()
    guarded.router, _ = guarded.start_router(guarded.port)
    kept.rename(guarded.keys / "anna")
    assert "not let in" in guarded.intrude({**annas, "connect/timeout_ms": 1000})
    guarded.router.wait_for("password'")


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


def test_a_member_joins_while_others_keep_failing(guarded):
    """Zenoh handles ten failed handshakes per second: a member waits behind all of them, twice."""
    with clients_without_certificate(guarded.port, 16):
        began = time.monotonic()
        with guarded.session("operator"):
            print(f"joined in {time.monotonic() - began:.2f} s")


def test_our_own_commands_say_what_a_role_may_not(guarded):
    with guarded.session("observer") as bus:
        with pytest.raises(UserError, match="role 'observer' may not publish goal; allowed roles: operator"):
            bus.put(GOAL, b"")
        with pytest.raises(UserError, match="role 'observer' may not query teleport"):
            bus.ask(TELEPORT, PoseRequest(pose=Pose(x=0.0, y=0.0, yaw=0.0)), Reply)


def test_a_service_waits_for_its_router_and_can_be_ended_meanwhile(guarded):
    port = free_tcp_port()
    waiting = guarded.processes.start(
        "simulator", "--security", str(guarded.keys), "--connect", f"tcp/127.0.0.1:{port}"
    )
    waiting.wait_for("waiting")
    status, _ = waiting.stop()
    assert status == 0, waiting.output


def test_the_whole_loop_and_an_old_command_played_again(guarded):
    """Every service in its own role; then the controller's credentials send an old command."""
    environment = {"PRESAGE_SECURITY": str(guarded.keys), "PRESAGE_CONNECT": f"tcp/127.0.0.1:{guarded.port}"}
    more = {"viewer": ["--port", "0"], "recorder": ["--directory", "recordings"], "simulator": ["--beams", "181"]}
    started = [guarded.processes.start(name, *more.get(name, []), env=environment) for name in SERVICES]
    inbox, commands = Inbox(), Inbox()
    with guarded.session("operator") as bus:
        wait_until(lambda: set(SERVICES) <= bus.alive(timeout=0.5) or not all(p.running for p in started), 120)
        assert set(SERVICES) <= bus.alive(), "\n".join(p.output for p in started)
        bus.subscribe(CMD_VEL, commands, keep_all=True)
        goal = guarded.processes.start("presage.__main__", "goal", "4.5", "1.5", "--wait", env=environment)
        assert goal.wait(120) == 0, goal.output
        assert "reached" in goal.output
        old = wait_for_message(commands, CmdVel, lambda c: np.hypot(c.twist.vx, c.twist.vy) > 0.3)
        for topic in (TRUTH, HEALTH):
            bus.subscribe(topic, inbox, keep_all=True)
        there = wait_for_message(inbox, Truth, lambda _: True)
        # While the controller leads nobody else is heard; after it, what is old is refused.
        for counter in ("other_sources", "stale_commands"):
            before = wait_for_message(inbox, Health, lambda h: h.service == "simulator").counters.get(counter, 0)
            played = guarded.intrude(guarded.settings("controller"), ["put", f"{HERE}/cmd_vel", old.encode().hex()])
            assert "done" in played
            wait_for_message(
                inbox, Health,
                lambda h, c=counter, b=before: h.service == "simulator" and h.counters.get(c, 0) > b,
            )  # fmt: skip
            if counter == "other_sources":
                controller = started[SERVICES.index("controller")]
                assert controller.stop()[0] == 0, controller.output
                assert wait_until(lambda: "controller" not in bus.alive(), 20)
        after = wait_for_message(inbox, Truth, lambda _: True)  # of the pulses that told, or later
    assert np.hypot(after.pose.x - 4.5, after.pose.y - 1.5) < 0.3
    assert np.hypot(after.pose.x - there.pose.x, after.pose.y - there.pose.y) < 0.05
    statuses = {process.name: process.stop()[0] for process in reversed(started) if process.running}
    assert set(statuses.values()) == {0}, statuses
    (recording,) = (started[3].log.parent / "recordings").glob("*.mcap")
    assert recording.stat().st_size > 10_000
