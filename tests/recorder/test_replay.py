"""When which bytes are due, and that they come back over real zenoh as they were."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.bus import wait_until
from common.errors import UserError
from common.inbox import Inbox, Sample
from common.topics import HEALTH, ODOM, SCAN, TOPICS
from services.recorder import replay as shell
from services.recorder.reader import Raw
from services.recorder.replay import replay, schedule, select
from services.recorder.writer import RecordingWriter


def raw(key="presage/r/scan", logged=0, payload=b""):
    return Raw(key, payload, 0, logged)


def test_the_schedule_keeps_the_original_distances():
    messages = [raw(logged=at) for at in (5_000_000_000, 5_500_000_000, 7_000_000_000)]
    assert [due for due, _ in schedule(messages, 1.0)] == pytest.approx([0.0, 0.5, 2.0])
    assert [due for due, _ in schedule(messages, 4.0)] == pytest.approx([0.0, 0.125, 0.5])
    assert [message for _, message in schedule(messages, 4.0)] == messages


@pytest.mark.parametrize("rate", [0.0, -1.0, float("inf")])
def test_no_rate_is_as_fast_as_it_goes(rate):
    assert [due for due, _ in schedule([raw(logged=0), raw(logged=10**12)], rate)] == [0.0, 0.0]


def test_nothing_has_no_schedule():
    assert list(schedule([], 1.0)) == []


@given(times=st.lists(st.integers(0, 2**62)).map(sorted), rate=st.floats(0.01, 100))
def test_nothing_is_due_before_what_came_before_it(times, rate):
    dues = [due for due, _ in schedule([raw(logged=at) for at in times], rate)]
    assert dues == sorted(dues)
    assert dues[:1] in ([], [0.0])


def test_topics_are_selected_by_name_and_health_only_when_asked_for():
    scan, odom, health = raw("presage/r/scan"), raw("presage/r/odom"), raw("presage/r/health/estimator")
    foreign = raw("other/key")
    everything = [scan, health, odom, foreign]
    assert select(everything, None) == [scan, odom]
    assert select(everything, {"odom"}) == [odom]
    assert select(everything, {"odom", "health"}) == [health, odom]
    with pytest.raises(UserError, match="no belief; it has health, odom, scan"):
        select(everything, {"belief", "scan"})


def write(path, entries):
    writer = RecordingWriter(path)
    for topic, key, payload, at in entries:
        writer.write(topic, key, payload, at, at)
    return writer.finish()


@pytest.fixture
def listening(bus, link):
    """An inbox that hears every topic of the test's robot."""
    inbox = Inbox()
    for topic in TOPICS:
        bus.subscribe(topic, inbox, keep_all=True)
    return inbox


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
    counts = replay(path, link, rate=rate, on_progress=progress.append)
    assert counts == {scan: 333, odom: 167}
    assert progress[-1] == 1.0
    assert progress == sorted(progress)
    assert wait_until(lambda: len(listening) == 500, 10)
    got = drain(listening)
    for key in (scan, odom):  # zenoh keeps the order of a key
        assert [payload for k, payload in got if k == key] == [payload for _, k, payload, _ in entries if k == key]


def test_it_waits_for_who_comes_a_little_late(tmp_path, link, bus, monkeypatch):
    monkeypatch.setattr(shell, "LISTENERS_WITHIN", 20.0)
    inbox = Inbox()
    late = threading.Timer(1.0, lambda: bus.subscribe(SCAN, inbox, keep_all=True))
    late.start()
    replay(write(tmp_path / "run.mcap", [(SCAN, SCAN.key(link.robot), b"s", 0)]), link, rate=0)
    late.join()
    assert wait_until(lambda: len(inbox) == 1, 10)


def test_only_what_was_chosen_is_sent(tmp_path, link, listening):
    entries = [(SCAN, SCAN.key(link.robot), b"s", 0), (ODOM, ODOM.key(link.robot), b"o", 1)]
    assert replay(write(tmp_path / "run.mcap", entries), link, only={"odom"}, rate=0) == {ODOM.key(link.robot): 1}
    assert wait_until(lambda: len(listening) == 1, 10)
    assert drain(listening) == [(ODOM.key(link.robot), b"o")]


def test_it_ends_when_it_is_told_to(tmp_path, link, listening):
    entries = [(SCAN, SCAN.key(link.robot), b"s", at) for at in (0, 3600 * 10**9)]
    stop = threading.Event()
    path = write(tmp_path / "hour.mcap", entries)
    assert replay(path, link, on_progress=lambda _: stop.set(), stop=stop) == {SCAN.key(link.robot): 1}


def test_an_unfinished_recording_is_replayed_with_a_warning(tmp_path, link, listening, capsys, monkeypatch):
    monkeypatch.setattr(shell, "LISTENERS_WITHIN", 5.0)
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.write(SCAN, SCAN.key(link.robot), b"s", 1, 1)
    writer.flush()
    assert replay(writer.active, link, rate=0) == {SCAN.key(link.robot): 1}
    assert "run.mcap.active: incomplete" in capsys.readouterr().err
    writer.finish()


def test_a_key_nobody_listens_to_is_named_and_it_ends_all_the_same(tmp_path, link, bus, capsys, monkeypatch):
    monkeypatch.setattr(shell, "LISTENERS_WITHIN", 2.0)
    inbox = Inbox()
    bus.subscribe(ODOM, inbox, keep_all=True)
    scan, odom = SCAN.key(link.robot), ODOM.key(link.robot)
    path = write(tmp_path / "run.mcap", [(SCAN, scan, b"s", 1), (ODOM, odom, b"o", 2)])
    assert replay(path, link) == {scan: 1, odom: 1}
    assert f"warning: nobody listens to {scan}\n" in capsys.readouterr().err
    assert wait_until(lambda: len(inbox) == 1, 10)
