"""Position of a replay by a simulated clock, selection of keys, and conflicts with live services."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.messages.requests import PlayerRequest
from common.messages.topics import BELIEF, CMD_VEL, DRIVE, GOAL, HEALTH, ODOM, SCAN, TOPICS
from services.recorder.replaying.player import (
    LOOP_GAP_S,
    MAX_LAG_S,
    Player,
    find_conflicts,
    key_for_robot,
    select_topics,
    span,
)

TIMES = st.lists(st.floats(0, 100), min_size=1, max_size=30).map(sorted)
RATES = st.floats(0.01, 100)


def play(player, times, now=0.0):
    """Wall times at which messages are published, without any request."""
    published = []
    for at in times:
        now += player.time_until(at, now)
        player.mark_sent(at, now, completes_step=True)
        published.append(now)
    return published


def ask(player, action, value=0.0, now=0.0):
    return player.handle(PlayerRequest(action=action, value=value), now)


@given(TIMES, RATES)
def test_rate(times, rate):
    published = play(Player(0.0, 100.0, rate), times)
    assert published == pytest.approx([at / rate for at in times], abs=1e-6)


@given(TIMES, st.sampled_from([0.0, -1.0, math.inf]))
def test_no_rate(times, rate):
    player = Player(0.0, 100.0, rate)
    assert play(player, times, 5.0) == [5.0] * len(times)
    assert player.position(9.0) == times[-1]


@given(times=TIMES, rate=RATES, at=st.floats(0, 100), length=st.floats(0, 1e4))
def test_pause(times, rate, at, length):
    player = Player(0.0, 100.0, rate)
    now = at / rate
    before = [t for t in times if t <= at]
    play(player, before)
    ask(player, "pause", now=now)
    assert player.time_until(100.0, now) == math.inf
    assert player.position(now + length) == pytest.approx(player.position(now))
    ask(player, "resume", now=now + length)
    after = play(player, [t for t in times if t > at], now + length)
    assert after == pytest.approx([t / rate + length for t in times if t > at], abs=1e-4)


@given(rate=RATES, place=st.floats(-50, 150), now=st.floats(0, 1000))
def test_seek(rate, place, now):
    player = Player(10.0, 90.0, rate)
    reply = ask(player, "seek", place, now)
    there = min(max(place, 10.0), 90.0)
    assert reply.position_s == pytest.approx(there)
    assert player.seek_pending
    assert player.take_seek_target() == there
    assert not player.seek_pending
    assert player.time_until(there, now) == 0.0
    assert player.time_until(there + rate, now) == pytest.approx(1.0)


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(1, 5))
def test_steps(scans, steps):
    """``scans``: for each message, whether it is a scan."""
    player = Player(0.0, 100.0)
    for _ in range(steps):
        ask(player, "step")
    sent = []
    for number, scan in enumerate(scans):
        if player.time_until(float(number), 0.0):
            break
        player.mark_sent(float(number), 0.0, completes_step=scan)
        sent.append(scan)
    assert player.paused
    assert sum(sent) == min(steps, sum(scans))
    assert sent[-1] or sum(scans) < steps  # the last one is the scan, unless there were too few
    assert player.position(99.0) == len(sent) - 1


@given(first=RATES, then=RATES, when=st.floats(0, 10))
def test_changed_rate(first, then, when):
    player = Player(0.0, 1e6, first)
    here = player.position(when)
    assert ask(player, "rate", then, when).position_s == pytest.approx(here)
    assert player.position(when + 1) == pytest.approx(here + then)
    assert not ask(player, "rate", -1.0, when).ok
    assert player.rate == then


def test_long_delay():
    player = Player(0.0, 100.0, 2.0)
    assert play(player, [0.0, 2.0]) == [0.0, 1.0]
    late = 1.0 + MAX_LAG_S * 50
    assert player.time_until(4.0, late) == 0.0
    player.mark_sent(4.0, late, completes_step=True)
    assert player.time_until(6.0, late) == pytest.approx(1.0)


def test_short_delay():
    player = Player(0.0, 100.0)
    player.mark_sent(4.0, 4.0 + MAX_LAG_S / 2, completes_step=True)
    assert player.time_until(5.0, 4.0 + MAX_LAG_S / 2) == pytest.approx(1.0 - MAX_LAG_S / 2)


def test_loop():
    player = Player(3.0, 8.0, loop=True)
    player.restart(50.0)
    assert player.take_seek_target() == 3.0
    assert player.time_until(3.0, 50.0) == pytest.approx(LOOP_GAP_S)
    assert player.state(50.0).position_s == 3.0
    assert player.state(50.0).loop


def test_span():
    assert span(20.0, None, None) == (0.0, 20.0)
    assert span(20.0, 5.0, -5.0) == (5.0, 15.0)
    assert span(20.0, 5.0, 99.0) == (5.0, 20.0)
    with pytest.raises(UserError, match=r"--start 21: the recording lasts 20\.00 s"):
        span(20.0, 21.0, None)
    with pytest.raises(UserError, match="nothing lies between"):
        span(20.0, 10.0, 9.0)


KEYS = {topic.key("r", "estimator"): topic for topic in TOPICS}


def test_selected_topics():
    there = {key: KEYS[key] for key in KEYS if KEYS[key] in (SCAN, ODOM, HEALTH)}
    assert set(select_topics(there, None).values()) == {SCAN, ODOM}
    assert set(select_topics(there, {"odom", "health"}).values()) == {ODOM, HEALTH}
    assert set(select_topics(there, None, {"odom", "belief"}).values()) == {SCAN}
    with pytest.raises(UserError, match="no belief; it has health, odom, scan"):
        select_topics(there, {"belief", "scan"})
    with pytest.raises(UserError, match="no topic smell: choose from belief"):
        select_topics(there, None, {"smell"})


def test_key_for_robot():
    assert key_for_robot("presage/robot/health/estimator", "ghost") == "presage/ghost/health/estimator"
    assert key_for_robot("presage/robot/scan", "") == "presage/robot/scan"


def test_conflicts():
    assert find_conflicts(KEYS, {"r": set()}) == ""
    assert find_conflicts(KEYS, {"other": {"estimator", "simulator"}}) == ""
    assert find_conflicts(KEYS, {"r": {"recorder", "viewer"}}) == ""
    conflict = find_conflicts(
        {key: KEYS[key] for key in KEYS if KEYS[key] is not HEALTH}, {"r": {"estimator", "recorder"}}
    )
    assert "the estimator of 'r' is alive and publishes presage/r/belief, presage/r/prediction" in conflict
    assert "--except belief,prediction" in conflict
    assert "--force" in conflict
    assert "presage/r/health/estimator" in find_conflicts(KEYS, {"r": {"estimator"}})
    assert find_conflicts({SCAN.key("r"): SCAN}, {"r": {"estimator"}}) == ""
    assert "simulator" in find_conflicts({SCAN.key("r"): SCAN}, {"r": {"simulator"}})
    everything = find_conflicts(KEYS, {"r": {"simulator", "estimator", "controller", "recorder"}})
    assert "as another robot with --robot NAME" in everything
    assert "--except" not in everything  # next to nothing would be left
    assert "the replay of 'r'" in find_conflicts({BELIEF.key("r"): BELIEF}, {"r": {"replay"}})


def test_conflicts_of_commands_and_goals():
    for topic, service in (
        (CMD_VEL, "simulator"),
        (CMD_VEL, "bridge_ros2"),
        (GOAL, "controller"),
        (DRIVE, "controller"),
    ):
        both = {topic.key("r"): topic, BELIEF.key("r"): BELIEF}
        conflict = find_conflicts(both, {"r": {service, "viewer"}})
        assert f"{topic.key('r')} would drive the live robot" in conflict
        assert f"--except {topic.name}," in conflict
        assert find_conflicts({topic.key("r"): topic}, {"r": {"estimator", "viewer"}}) == ""
    assert "the bridge_ros2 of 'r'" in find_conflicts({SCAN.key("r"): SCAN}, {"r": {"bridge_ros2"}})
