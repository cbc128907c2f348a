"""A replay as the page uses it: begins paused, stays at its end, and answers the query for its world."""

from __future__ import annotations

import threading

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, Sample
from common.messages.requests import PlayerReply, PlayerRequest, Request, WorldReply
from common.messages.topics import BELIEF, PLAYER, SCAN, WORLD
from services.recorder.replaying.replay import ReplayOptions, replay
from tests.recorder import sessions as made


@pytest.fixture
def scrubbed(tmp_path, link, bus):
    """Returns a function that starts a replay and returns its scans and beliefs and a function to control it."""
    stop, threads, heard = threading.Event(), [], Inbox()
    for topic in (SCAN, BELIEF):
        bus.subscribe(topic, heard, keep_all=True)

    def ask(action, value=0.0):
        return bus.ask(PLAYER, PlayerRequest(action=action, value=value), PlayerReply, timeout=20)

    def start(**choice):
        chosen = ReplayOptions(robot=link.robot, only=frozenset({"scan", "belief"}), paused=True, stay=True, **choice)
        threads.append(threading.Thread(target=replay, args=(path, link, chosen), kwargs={"stop": stop}))
        threads[-1].start()
        return heard, ask

    path = made.write(tmp_path / "hall.mcap")
    yield start
    stop.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()


def drain(heard):
    got = []
    while isinstance(sample := heard.get(0), Sample):
        got.append((sample.topic.name, sample.topic.message.decode(sample.payload).stamp_ns // made.PERIOD_NS))
    return sorted(got)


def test_it_begins_paused_and_shows_a_place_in_two_steps(scrubbed):
    heard, ask = scrubbed()
    assert ask("status").paused
    assert len(heard) == 0
    ask("seek", 5.0)
    ask("step", 2)
    assert wait_until(lambda: len(heard) >= 3, 20)
    assert drain(heard) == [("belief", 50), ("scan", 50), ("scan", 51)]


def test_it_stays_at_its_end_until_somebody_seeks(scrubbed):
    heard, ask = scrubbed(rate=0)
    ask("seek", 9.5)
    ask("resume")
    assert wait_until(lambda: ask("status").position_s == pytest.approx(ask("status").duration_s), 20)
    assert wait_until(lambda: ask("status").paused, 20)
    assert wait_until(lambda: len(heard) == 10, 20)
    drain(heard)
    ask("step")
    ask("resume")
    assert wait_until(lambda: ask("status").paused, 20)  # nothing comes after the end
    assert len(heard) == 0
    ask("seek", 9.5)
    ask("resume")
    assert wait_until(lambda: len(heard) == 10, 20)


def test_it_answers_for_the_world_of_its_session(scrubbed, bus):
    _, ask = scrubbed()
    ask("status")
    reply = bus.ask(WORLD, Request(), WorldReply, timeout=20)
    assert (reply.world, reply.scanner, reply.robot.radius) == (made.WORLD, made.SCANNER, 0.3)


def test_it_does_not_where_a_simulator_does(scrubbed, bus, link):
    inbox = Inbox()
    bus.serve(WORLD, inbox)
    bus.declare_alive("simulator")
    _, ask = scrubbed(force=True)
    ask("status")
    inbox_answers = threading.Thread(target=lambda: inbox.get(20).reply(WorldReply(ok=False, reason="me").encode()))
    inbox_answers.start()
    assert bus.ask(WORLD, Request(), WorldReply, timeout=20).reason == "me"
    inbox_answers.join()


def test_a_recording_without_its_world_says_so(tmp_path, link, bus):
    path, stop = made.write(tmp_path / "bare.mcap", world=False), threading.Event()
    choice = ReplayOptions(robot=link.robot, only=frozenset({"scan"}), paused=True)
    thread = threading.Thread(target=replay, args=(path, link, choice), kwargs={"stop": stop})
    thread.start()
    try:
        reply = bus.ask(WORLD, Request(), WorldReply, timeout=20)
        assert (reply.ok, reply.reason) == (False, "bare.mcap does not hold its world")
    finally:
        stop.set()
        thread.join(20)
