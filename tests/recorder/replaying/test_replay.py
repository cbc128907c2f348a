"""Replays over real zenoh: unchanged payloads, control during the replay, conflicts with live publishers."""

from __future__ import annotations

import json
import threading
from contextlib import contextmanager
from dataclasses import replace

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.requests import ConfigReply, ModelReply, PlayerReply, PlayerRequest, Request, WorldReply
from common.messages.topics import BELIEF, CONFIG, GOAL, HEALTH, ODOM, PLAYER, SCAN, TOPICS, WORLD
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import write_description
from services.recorder.replaying import player as core
from services.recorder.replaying import replay as shell
from services.recorder.replaying.replay import ReplayOptions, replay
from tests.conftest import WAIT_TIMEOUT_S
from tests.recorder import sessions

SECOND_NS = 10**9
FAST = ReplayOptions(rate=0)
ON_REQUEST = ReplayOptions(rate=1e-6)  # so slow that after the first message others are only published on request


def write(path, entries):
    writer = RecordingWriter(path)
    for topic, key, payload, received_ns in entries:
        writer.write(topic, key, payload, received_ns, received_ns)
    return writer.finish()


@pytest.fixture(autouse=True)
def _no_wait_for_subscribers(monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 0.0)


@pytest.fixture
def listening(bus, monkeypatch):
    """An inbox subscribed to every topic of the test's robot."""
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 20.0)
    inbox = Inbox()
    for topic in TOPICS:
        bus.subscribe(topic, inbox, keep_all=True)
    return inbox


@pytest.fixture
def scans(tmp_path, link):
    """A recording of 100 s with one scan and one odometry message each second; payloads are their numbers."""
    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    entries = []
    for n in range(100):
        entries += [(SCAN, scan, bytes([n]), n * SECOND_NS), (ODOM, odom, bytes([n]), n * SECOND_NS + SECOND_NS // 2)]
    return write(tmp_path / "run.mcap", entries)


@pytest.fixture
def session(tmp_path):
    """The recording of a session, with its world."""
    return sessions.write(tmp_path / "hall.mcap")


@pytest.fixture
def start(scans, link, bus):
    """A function that starts a replay in a thread and returns its control, thread and counts."""
    stop, threads, failed = threading.Event(), [], []

    def begin(options, path=scans):
        options = replace(options, robot=link.robot)
        there, remotes, counts = threading.Event(), [], {}

        @contextmanager
        def get_control(remote):
            remotes.append(remote)
            there.set()
            yield

        def work():
            try:
                counts.update(replay(path, link, options, stop=stop, control_context=get_control))
            except BaseException as error:
                failed.append(error)
                there.set()
                raise

        threads.append(threading.Thread(target=work))
        threads[-1].start()
        assert there.wait(30)
        assert not failed, failed
        assert wait_until(lambda: "replay" in bus.alive(), 20)
        return remotes[0], threads[-1], counts

    yield begin
    stop.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()


@pytest.fixture
def control(bus):
    """A function that sends a request to the replay."""

    def send(action, value=0.0):
        return bus.query(PLAYER, PlayerRequest(action=action, value=value), PlayerReply, timeout=WAIT_TIMEOUT_S)

    return send


def drain(inbox):
    entries = []
    while isinstance(entry := inbox.get(0), Sample):
        entries.append((entry.key, entry.payload))
    return entries


def next_payloads(inbox, count):
    """Topic and first byte of the next payloads, sorted."""
    assert wait_until(lambda: len(inbox) >= count, 20)
    return sorted((key.rsplit("/", 1)[-1], payload[0]) for key, payload in drain(inbox))


@pytest.mark.parametrize("rate", [0.0, 20.0])
def test_same_bytes_in_order(tmp_path, link, listening, rate):
    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    entries = []
    for number in range(500):
        topic, key = (SCAN, scan) if number % 3 else (ODOM, odom)
        entries.append((topic, key, number.to_bytes(4, "little") + b"\xc1\x00" * (number % 40), number * 10_000_000))
    health = (HEALTH, HEALTH.key(link.robot, "estimator"), b"pulse", 0)
    path = write(tmp_path / "run.mcap", [health, *entries])
    progress = []
    counts = replay(path, link, ReplayOptions(rate=rate), on_progress=lambda state: progress.append(state.position_s))
    assert counts == {scan: 333, odom: 167}
    assert progress[-1] == pytest.approx(4.99)
    assert progress == sorted(progress)
    assert wait_until(lambda: len(listening) == 500, 20)
    received = drain(listening)
    for key in (scan, odom):  # zenoh keeps the order of a key
        assert [payload for k, payload in received if k == key] == [payload for _, k, payload, _ in entries if k == key]


def test_late_subscriber(tmp_path, link, bus, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 20.0)
    inbox = Inbox()
    late = threading.Timer(1.0, lambda: bus.subscribe(SCAN, inbox, keep_all=True))
    late.start()
    replay(write(tmp_path / "run.mcap", [(SCAN, SCAN.key(link.robot), b"s", 0)]), link, FAST)
    late.join()
    assert wait_until(lambda: len(inbox) == 1, 10)


def test_key_without_subscriber(tmp_path, link, bus, capsys, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 2.0)
    inbox = Inbox()
    bus.subscribe(ODOM, inbox, keep_all=True)
    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    path = write(tmp_path / "run.mcap", [(SCAN, scan, b"s", 1), (ODOM, odom, b"o", 2)])
    assert replay(path, link) == {scan: 1, odom: 1}
    assert f"warning: no subscriber for {scan}\n" in capsys.readouterr().err
    assert wait_until(lambda: len(inbox) == 1, 10)


def test_selection(scans, link, listening):
    options = ReplayOptions(rate=0, only=frozenset({"odom"}), start=10.0, end=-88.9)
    assert replay(scans, link, options) == {ODOM.key(link.robot): 1}
    assert next_payloads(listening, 1) == [("odom", 10)]
    options = ReplayOptions(rate=0, leave_out=frozenset({"odom", "belief"}), start=98.0)
    assert replay(scans, link, options) == {SCAN.key(link.robot): 2}
    with pytest.raises(UserError, match=r"run.mcap: nothing to replay"):
        replay(scans, link, ReplayOptions(leave_out=frozenset({"scan", "odom"})))


def test_another_robot(scans, link, bus, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 20.0)
    inbox, robot = Inbox(), f"{link.robot}-ghost"
    bus.subscribe(SCAN, inbox, keep_all=True, robot=robot)
    assert replay(scans, link, ReplayOptions(rate=0, robot=robot, start=99.0, only=frozenset({"scan"})))
    assert next_payloads(inbox, 1) == [("scan", 99)]


def test_stop(tmp_path, link):
    entries = [(SCAN, SCAN.key(link.robot), b"s", seconds * SECOND_NS) for seconds in (0, 3600)]
    stop, path = threading.Event(), write(tmp_path / "hour.mcap", entries)
    assert replay(path, link, on_progress=lambda _: stop.set(), stop=stop) == {SCAN.key(link.robot): 1}


def test_unfinished_recording(tmp_path, link, capsys):
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.write(SCAN, SCAN.key(link.robot), b"s", 1, 1)
    writer.flush()
    assert replay(writer.active, link, FAST) == {SCAN.key(link.robot): 1}
    assert "run.mcap.active: incomplete" in capsys.readouterr().err
    writer.finish()


def test_control_over_the_bus(start, listening, control):
    _, thread, counts = start(ON_REQUEST)
    assert next_payloads(listening, 1) == [("scan", 0)]  # the first is due at once
    assert control("pause").paused
    assert control("status").duration_s == pytest.approx(99.5)
    for _ in range(2):  # a scan, and the odometry before it
        control("step")
    assert next_payloads(listening, 4) == [("odom", 0), ("odom", 1), ("scan", 1), ("scan", 2)]
    for place in (50, 10):  # forwards, backwards
        assert control("seek", place).position_s == place
        control("step")
        assert next_payloads(listening, 1) == [("scan", place)]
    assert not control("rate", -1.0).ok
    assert control("seek", 95.0).paused
    assert control("rate", 0.0).rate == 0.0
    control("resume")
    thread.join(20)
    assert not thread.is_alive()
    assert next_payloads(listening, 10) == [(topic, n) for topic in ("odom", "scan") for n in range(95, 100)]
    assert sum(counts.values()) == 17


def test_hostile_requests(start, bus, control):
    start(ON_REQUEST)

    def refused(payload):
        (answer,) = bus._session.get(PLAYER.key(bus.robot), payload=payload, timeout=WAIT_TIMEOUT_S)
        return answer.err is not None and "PlayerRequest" in answer.err.payload.to_string()

    @settings(max_examples=50, suppress_health_check=list(HealthCheck))
    @given(
        st.binary(max_size=60) | st.dictionaries(st.text(max_size=8), st.integers(-9, 9) | st.text()).map(msgpack.packb)
    )
    def send(payload):
        assert refused(payload)

    send()
    for value in (float("nan"), float("inf")):
        assert refused(msgpack.packb({"action": "seek", "value": value}))
    assert control("status").ok


def test_descriptions(start, bus, session):
    start(replace(ON_REQUEST, paused=True), session)
    reply = bus.query(CONFIG, Request(), ConfigReply, timeout=WAIT_TIMEOUT_S, service="replay")
    assert json.loads(reply.config)["file"] == str(session)
    world = bus.query(WORLD, Request(), WorldReply, timeout=WAIT_TIMEOUT_S)
    assert (world.world, world.scanner, world.robot.radius) == (sessions.WORLD, sessions.SCANNER, 0.3)


def test_recording_without_world(start, bus):
    start(ON_REQUEST)
    reply = bus.query(WORLD, Request(), WorldReply, timeout=WAIT_TIMEOUT_S)
    assert (reply.ok, reply.reason) == (False, "run.mcap holds neither a world nor a map")


def test_recording_of_a_real_robot(start, bus, link, tmp_path):
    writer = RecordingWriter(tmp_path / "robot.mcap")
    write_description(writer, "estimator", ModelReply(estimator="precise", world=sessions.WORLD))
    writer.write(SCAN, SCAN.key(link.robot), b"", 1, 1)
    start(replace(ON_REQUEST, paused=True), writer.finish())
    reply = bus.query(WORLD, Request(), WorldReply, timeout=WAIT_TIMEOUT_S)
    assert (reply.world, reply.scanner) == (sessions.WORLD, None)


def test_world_beside_a_simulator(start, session, bus):
    inbox = Inbox()
    bus.serve(WORLD, inbox)
    bus.declare_alive("simulator")
    start(replace(ON_REQUEST, paused=True, force=True), session)
    answering = threading.Thread(target=lambda: inbox.get(20).reply(WorldReply(ok=False, reason="mine").encode()))
    answering.start()
    assert bus.query(WORLD, Request(), WorldReply, timeout=WAIT_TIMEOUT_S).reason == "mine"
    answering.join()


def test_pause_at_the_end(start, listening, control):
    """The page's replay begins paused, and stays at its end until a seek."""
    start(ReplayOptions(rate=0, paused=True, start=90.0))
    assert control("status").paused
    assert len(listening) == 0
    for _ in range(2):
        control("seek", 95.0)
        control("resume")
        assert len(next_payloads(listening, 10)) == 10
        assert wait_until(lambda: control("status").paused, 20)
        assert control("status").position_s == pytest.approx(control("status").duration_s)
        control("step")
        control("resume")
        assert wait_until(lambda: control("status").paused, 20)  # nothing comes after the end
        assert len(listening) == 0


def test_loop(start, listening, link, monkeypatch):
    monkeypatch.setattr(core, "LOOP_GAP_S", 0.01)
    remote, thread, counts = start(ReplayOptions(rate=0, start=98.0, loop=True, only=frozenset({"scan"})))
    assert wait_until(lambda: len(listening) >= 20, 10)
    remote.quit()
    thread.join(10)
    assert not thread.is_alive()
    assert counts[SCAN.key(link.robot)] >= 20
    assert [payload[0] for _, payload in drain(listening)][:6] == [98, 99] * 3


def test_live_publisher(tmp_path, link, bus):
    path = write(tmp_path / "b.mcap", [(t, t.key(link.robot), b"x", n) for n, t in enumerate((SCAN, BELIEF, GOAL))])
    with open_bus(link) as live:
        live.declare_alive("estimator")
        assert wait_until(lambda: "estimator" in bus.alive(), 20)
        refusal = f"the estimator of '{link.robot}' is alive and publishes .*/belief;.*--except"
        with pytest.raises(UserError, match=refusal):
            replay(path, link, FAST)
        assert sum(replay(path, link, replace(FAST, leave_out=frozenset({"belief"}))).values()) == 2
        assert sum(replay(path, link, replace(FAST, force=True)).values()) == 3
        assert sum(replay(path, link, replace(FAST, robot=f"{link.robot}-ghost")).values()) == 3


def test_second_replay(start, link, scans):
    start(ON_REQUEST)
    with pytest.raises(UserError, match="the replay of"):
        replay(scans, link, FAST)
