"""Replays over real zenoh: unchanged payloads, control during the replay, conflicts with live publishers."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.requests import ConfigReply, PlayerReply, PlayerRequest, Request
from common.messages.topics import BELIEF, CONFIG, GOAL, HEALTH, ODOM, PLAYER, SCAN, TOPICS
from services.recorder.files.writer import RecordingWriter
from services.recorder.replaying import player as core
from services.recorder.replaying import replay as shell
from services.recorder.replaying.replay import ReplayOptions, replay

SECOND = 10**9
FAST = ReplayOptions(rate=0)


def write(path, entries):
    writer = RecordingWriter(path)
    for topic, key, payload, at in entries:
        writer.write(topic, key, payload, at, at)
    return writer.finish()


@pytest.fixture
def listening(bus, link):
    """An inbox subscribed to every topic of the test's robot."""
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
        entries += [(SCAN, scan, bytes([n]), n * SECOND), (ODOM, odom, bytes([n]), n * SECOND + SECOND // 2)]
    return write(tmp_path / "run.mcap", entries)


@pytest.fixture
def running(scans, link):
    """Returns a function that starts a replay in a thread and returns its control, thread and counts."""
    stop, threads, failed = threading.Event(), [], []

    def start(choice, path=scans):
        there, remotes, counts = threading.Event(), [], {}

        @contextmanager
        def steering(remote):
            remotes.append(remote)
            there.set()
            yield

        def work():
            try:
                counts.update(replay(path, link, choice, stop=stop, steering=steering))
            except BaseException as error:
                failed.append(error)
                there.set()
                raise

        threads.append(threading.Thread(target=work))
        threads[-1].start()
        assert there.wait(20)
        assert not failed, failed
        return remotes[0], threads[-1], counts

    yield start
    stop.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()


def drain(inbox):
    got = []
    while isinstance(entry := inbox.get(0), Sample):
        got.append((entry.key, entry.payload))
    return got


@pytest.mark.parametrize("rate", [0.0, 20.0])
def test_the_same_bytes_come_back_in_their_order(tmp_path, link, listening, rate):
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
    assert wait_until(lambda: len(listening) == 500, 10)
    got = drain(listening)
    for key in (scan, odom):  # zenoh keeps the order of a key
        assert [payload for k, payload in got if k == key] == [payload for _, k, payload, _ in entries if k == key]


def test_it_waits_for_who_comes_a_little_late(tmp_path, link, bus, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 20.0)
    inbox = Inbox()
    late = threading.Timer(1.0, lambda: bus.subscribe(SCAN, inbox, keep_all=True))
    late.start()
    replay(write(tmp_path / "run.mcap", [(SCAN, SCAN.key(link.robot), b"s", 0)]), link, FAST)
    late.join()
    assert wait_until(lambda: len(inbox) == 1, 10)


def test_only_what_was_chosen_is_sent(scans, link, listening):
    only = ReplayOptions(rate=0, only=frozenset({"odom"}), start=10.0, end=-88.9)
    assert replay(scans, link, only) == {ODOM.key(link.robot): 1}
    assert wait_until(lambda: len(listening) == 1, 10)
    assert drain(listening) == [(ODOM.key(link.robot), bytes([10]))]


def test_what_is_left_out_is_not_sent(scans, link, listening):
    choice = ReplayOptions(rate=0, leave_out=frozenset({"odom", "belief"}), start=98.0)
    assert replay(scans, link, choice) == {SCAN.key(link.robot): 2}


def test_another_robot_gets_the_bytes(scans, link, bus):
    inbox = Inbox()
    bus.subscribe(SCAN, inbox, keep_all=True, robot=f"{link.robot}-ghost")
    assert replay(scans, link, ReplayOptions(rate=0, robot=f"{link.robot}-ghost", start=99.0, only=frozenset({"scan"})))
    assert wait_until(lambda: len(inbox) == 1, 10)
    assert drain(inbox) == [(SCAN.key(f"{link.robot}-ghost"), bytes([99]))]


def test_nothing_to_replay_is_said(scans, link):
    with pytest.raises(UserError, match=r"run.mcap: nothing to replay"):
        replay(scans, link, ReplayOptions(leave_out=frozenset({"scan", "odom"})))


def test_it_ends_when_it_is_told_to(tmp_path, link, listening):
    entries = [(SCAN, SCAN.key(link.robot), b"s", at) for at in (0, 3600 * SECOND)]
    stop = threading.Event()
    path = write(tmp_path / "hour.mcap", entries)
    assert replay(path, link, on_progress=lambda _: stop.set(), stop=stop) == {SCAN.key(link.robot): 1}


def test_an_unfinished_recording_is_replayed_with_a_warning(tmp_path, link, listening, capsys, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 5.0)
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.write(SCAN, SCAN.key(link.robot), b"s", 1, 1)
    writer.flush()
    assert replay(writer.active, link, FAST) == {SCAN.key(link.robot): 1}
    assert "run.mcap.active: incomplete" in capsys.readouterr().err
    writer.finish()


def test_a_key_nobody_listens_to_is_named_and_it_ends_all_the_same(tmp_path, link, bus, capsys, monkeypatch):
    monkeypatch.setattr(shell, "SUBSCRIBER_TIMEOUT_S", 2.0)
    inbox = Inbox()
    bus.subscribe(ODOM, inbox, keep_all=True)
    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    path = write(tmp_path / "run.mcap", [(SCAN, scan, b"s", 1), (ODOM, odom, b"o", 2)])
    assert replay(path, link) == {scan: 1, odom: 1}
    assert f"warning: no subscriber for {scan}\n" in capsys.readouterr().err
    assert wait_until(lambda: len(inbox) == 1, 10)


def test_it_is_steered_over_the_bus(running, listening, bus, link):
    def ask(action, value=0.0):
        return bus.ask(PLAYER, PlayerRequest(action=action, value=value), PlayerReply, timeout=10)

    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    _, thread, counts = running(ReplayOptions(rate=1e-6))  # so slow that messages are only published on request
    assert wait_until(lambda: len(listening) == 1, 10)  # the first is due at once
    assert ask("pause").paused
    assert ask("status").duration_s == pytest.approx(99.5)
    for _ in range(2):  # a scan, and the odometry before it
        ask("step")
    assert wait_until(lambda: len(listening) == 5, 10)
    assert sorted(drain(listening)) == [(odom, bytes([n])) for n in range(2)] + [(scan, bytes([n])) for n in range(3)]
    assert ask("seek", 50.0).position_s == 50.0
    ask("step")
    assert wait_until(lambda: len(listening) == 1, 10)
    assert drain(listening) == [(SCAN.key(link.robot), bytes([50]))]
    ask("seek", 10.0)  # backwards
    ask("step")
    assert wait_until(lambda: len(listening) == 1, 10)
    assert drain(listening) == [(SCAN.key(link.robot), bytes([10]))]
    assert not ask("rate", -1.0).ok
    assert ask("seek", 95.0).paused
    assert ask("rate", 0.0).rate == 0.0
    ask("resume")
    thread.join(20)
    assert not thread.is_alive()
    assert wait_until(lambda: len(listening) == 10, 10)
    assert sorted(payload[0] for _, payload in drain(listening)) == sorted([*range(95, 100)] * 2)
    assert sum(counts.values()) == 17


def test_hostile_requests_are_refused_and_it_goes_on(running, bus):
    running(ReplayOptions(rate=1e-6))
    assert wait_until(lambda: "replay" in bus.alive(), 20)

    @settings(max_examples=200, suppress_health_check=list(HealthCheck))
    @given(
        st.binary(max_size=60) | st.dictionaries(st.text(max_size=8), st.integers(-9, 9) | st.text()).map(msgpack.packb)
    )
    def ask(payload):
        (answer,) = bus._session.get(PLAYER.key(bus.robot), payload=payload, timeout=30)
        assert answer.err is not None
        assert "PlayerRequest" in answer.err.payload.to_string()

    ask()
    for value in (float("nan"), float("inf")):
        request = msgpack.packb({"action": "seek", "value": value})
        (answer,) = bus._session.get(PLAYER.key(bus.robot), payload=request, timeout=30)
        assert answer.err is not None
    assert bus.ask(PLAYER, PlayerRequest(action="status"), PlayerReply, timeout=10).ok


def test_it_says_what_it_is(running, bus, scans):
    running(ReplayOptions(rate=1e-6))
    assert wait_until(lambda: "replay" in bus.alive(), 10)
    reply = bus.ask(CONFIG, Request(), ConfigReply, timeout=10, service="replay")
    assert json.loads(reply.config)["file"] == str(scans)


def test_a_loop_begins_anew(running, listening, link, monkeypatch):
    monkeypatch.setattr(core, "LOOP_GAP_S", 0.01)
    remote, thread, counts = running(ReplayOptions(rate=0, start=98.0, loop=True, only=frozenset({"scan"})))
    assert wait_until(lambda: len(listening) >= 20, 10)
    remote.quit()
    thread.join(10)
    assert not thread.is_alive()
    assert counts[SCAN.key(link.robot)] >= 20
    assert [payload[0] for _, payload in drain(listening)][:6] == [98, 99] * 3


@pytest.fixture
def alive(link):
    """Returns a function that declares a service of this robot alive, in a session of its own."""
    sessions = []  # keeps references, because zenoh undeclares tokens of collected sessions
    with ExitStack() as stack:

        def declare(service):
            sessions.append(stack.enter_context(open_bus(link)))
            sessions[-1].declare_alive(service)

        yield declare


def believed(path, link):
    entries = [(t, t.key(link.robot), b"x", n) for n, t in enumerate((SCAN, BELIEF, GOAL))]
    return write(path / "b.mcap", entries)


def test_it_does_not_publish_beside_a_live_publisher_unless_told(tmp_path, link, bus, alive):
    path = believed(tmp_path, link)
    alive("estimator")
    assert wait_until(lambda: "estimator" in bus.alive(), 20)
    with pytest.raises(UserError, match=f"the estimator of '{link.robot}' is alive and publishes .*/belief;.*--except"):
        replay(path, link, FAST)
    assert sum(replay(path, link, replace(FAST, leave_out=frozenset({"belief"}))).values()) == 2
    assert sum(replay(path, link, replace(FAST, force=True)).values()) == 3
    assert sum(replay(path, link, replace(FAST, robot=f"{link.robot}-ghost")).values()) == 3


def test_a_second_replay_of_the_same_keys_is_refused(running, link, scans, bus):
    running(ReplayOptions(rate=1e-6))
    assert wait_until(lambda: "replay" in bus.alive(), 20)
    with pytest.raises(UserError, match="the replay of"):
        replay(scans, link, FAST)
