"""Publishes a recording's messages at their times.

The clock of a replay is the recording's: payloads, and so their stamps and sequence numbers, are as recorded. After a
seek backwards or a loop those who hear it see stamps that go back, as after a reset of the simulator.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from common.bus.bus import Bus, Link, open_bus, wait_until
from common.bus.inbox import Call, Inbox
from common.errors import UserError
from common.messages.requests import PlayerReply, PlayerRequest, WorldReply
from common.messages.topics import CONFIG, PLAYER, SCAN, WORLD, Topic
from common.messages.wire import DecodeError
from common.runtime.protocol_check import build_config_reply
from services.recorder.reader import Raw, Recording, read_recording
from services.recorder.replaying.player import (
    Player,
    find_conflicts,
    key_for_robot,
    robots_of_keys,
    select_topics,
    span,
)

NAME = "replay"  # of the liveliness token
SUBSCRIBER_TIMEOUT_S = 2.0  # s; a put before a subscriber is known is lost
DISCOVERY_TIME_S = 0.5  # s in which a session that has just opened hears who is alive
POLL_PERIOD_S = 0.1  # s, the longest wait without a look at whether to stop


@dataclass(frozen=True)
class ReplayOptions:
    """What of a recording is replayed, and how."""

    only: frozenset[str] | None = None  # names of topics; None: all but health
    leave_out: frozenset[str] = frozenset()
    rate: float = 1.0  # times the original timing; 0: as fast as it goes
    start: float | None = None  # s from the recording's beginning
    end: float | None = None  # and of its end; negative: from the end
    loop: bool = False
    robot: str = ""  # instead of the recorded one
    force: bool = False  # beside a live publisher too
    paused: bool = False  # until told otherwise
    stay: bool = False  # paused at the end, until told otherwise


class ReplayControl:
    """For who steers from this process: a keyboard's thread, a test."""

    def __init__(self, player: Player, inbox: Inbox, counts: Counter[str]) -> None:
        """Requests wait in the inbox as those of the bus do; ``counts`` is what was sent so far, by key."""
        self._player, self._inbox = player, inbox
        self.counts = counts
        self.quitting = False

    def send(self, request: PlayerRequest) -> None:
        """Done in order, soon."""
        self._inbox.put(Call(PLAYER, request.encode(), lambda _: None, lambda _: None))

    def state(self) -> PlayerReply:
        """As it stands now."""
        return self._player.state(time.monotonic())

    def quit(self) -> None:
        """End the replay."""
        self.quitting = True
        self._inbox.wake()


Steering = Callable[[ReplayControl], AbstractContextManager[object]]


class Replay:
    """One recording on one session."""

    def __init__(self, recording: Recording, choice: ReplayOptions, bus: Bus) -> None:
        """Raises UserError where there is nothing to replay, or somebody alive publishes the same."""
        self.recording, self.choice, self.bus = recording, choice, bus
        self.topics = select_topics(recording.topics(), choice.only, choice.leave_out)
        if not self.topics:
            raise UserError(f"{recording.path}: nothing to replay")
        self.keys = {key: key_for_robot(key, choice.robot) for key in self.topics}
        duration = (recording.end_ns - recording.start_ns) * 1e-9
        begin, end = span(duration, choice.start, choice.end)
        self.inbox = Inbox()
        self.player = Player(begin, end, choice.rate, loop=choice.loop)
        self.counts: Counter[str] = Counter()  # by key as published
        self.remote = ReplayControl(self.player, self.inbox, self.counts)
        self._stepwise = SCAN if SCAN in self.topics.values() else None

    def announce(self) -> None:
        """Refuse beside live publishers; then be steerable, alive, and heard."""
        alive = self._alive()
        if not self.choice.force and (why := find_conflicts(self._published(), alive)):
            raise UserError(why)
        for key, topic in self._published().items():  # all before the first wait: each asks who listens
            self.bus.publisher(topic, key=key)
        if WORLD.server not in alive.get(self.bus.robot, set()):  # a simulator knows better
            self.bus.serve(WORLD, self.inbox)
        self.bus.serve(PLAYER, self.inbox)
        self.bus.serve(CONFIG, self.inbox, NAME)
        self.bus.declare_alive(NAME)
        deadline = time.monotonic() + SUBSCRIBER_TIMEOUT_S
        unheard = [
            key
            for key, topic in self._published().items()
            if not self.bus.wait_matching(topic, max(0.0, deadline - time.monotonic()), key=key)
        ]
        if unheard:
            print(f"warning: nobody listens to {', '.join(unheard)}", file=sys.stderr)

    def run(self, on_progress: Callable[[PlayerReply], None], stop: threading.Event) -> None:
        """Until the end, `ReplayControl.quit` or ``stop``."""
        player = self.player
        player.seek(player.begin, time.monotonic())
        player.paused = self.choice.paused
        while (place := player.take_seek_target()) is not None:
            for raw in self.recording.payloads(self.topics.keys(), *self._window(place)):
                at = (raw.logged_ns - self.recording.start_ns) * 1e-9
                if not self._until(at, on_progress, stop):
                    break
                self._send(raw, at)
                on_progress(player.state(time.monotonic()))
            if stop.is_set() or self.remote.quitting:
                break
            if player.loop and not player.seek_pending:
                player.restart(time.monotonic())
            elif self.choice.stay and not player.seek_pending:
                self._rest(on_progress, stop)

    def _window(self, place: float) -> tuple[int, int | None]:
        """Of the recording's own times, ns; the end is not part of it, the recording's last message is."""
        start, last = self.recording.start_ns, self.choice.end is not None
        return start + round(place * 1e9), start + round(self.player.end * 1e9) if last else None

    def _until(self, at: float, on_progress: Callable[[PlayerReply], None], stop: threading.Event) -> bool:
        """Wait until a message is due, answering meanwhile; False where it will not be sent."""
        while True:
            wait = self.player.wait(at, time.monotonic())
            entry = self.inbox.get(min(wait, POLL_PERIOD_S))
            if isinstance(entry, Call):
                self._answer(entry)
            if entry is not None or wait > 0:
                on_progress(self.player.state(time.monotonic()))
            if stop.is_set() or self.remote.quitting or self.player.seek_pending:
                return False
            if entry is None and self.player.wait(at, time.monotonic()) <= 0:
                return True

    def _rest(self, on_progress: Callable[[PlayerReply], None], stop: threading.Event) -> None:
        """Paused at the end, until somebody seeks."""
        while not (stop.is_set() or self.remote.quitting or self.player.seek_pending):
            self.player.finish(time.monotonic())
            on_progress(self.player.state(time.monotonic()))
            if isinstance(entry := self.inbox.get(POLL_PERIOD_S), Call):
                self._answer(entry)

    def _send(self, raw: Raw, at: float) -> None:
        topic, key = self.topics[raw.key], self.keys[raw.key]
        self.bus.put(topic, raw.payload, key=key)
        self.counts[key] += 1
        self.player.sent(at, time.monotonic(), whole=self._stepwise in (None, topic))

    def _answer(self, call: Call) -> None:
        if call.query is CONFIG:
            config = {"file": str(self.recording.path), **asdict(self.choice)}
            plain = json.dumps(config, default=sorted)
            call.reply(build_config_reply(NAME, plain).encode())
            return
        if call.query is WORLD:
            call.reply(self._world().encode())
            return
        try:
            request = PlayerRequest.decode(call.payload)
        except DecodeError as error:
            call.refuse(str(error))
            return
        call.reply(self.player.handle(request, time.monotonic()).encode())

    def _world(self) -> WorldReply:
        """As the recording has it."""
        recording, world = self.recording, self.recording.world()
        if world is None:
            return WorldReply(ok=False, reason=f"{recording.path.name} does not hold its world")
        return WorldReply(world=world, scanner=recording.scanner(), robot=recording.robot())

    def _published(self) -> dict[str, Topic]:
        """By the key it is published on."""
        return {self.keys[key]: topic for key, topic in self.topics.items()}

    def _alive(self) -> dict[str, set[str]]:
        """Services by robot; asked until nobody new is heard of, or at once where somebody speaks against it."""
        names = robots_of_keys(self._published())
        alive: dict[str, set[str]] = {robot: set() for robot in names}

        def contested() -> bool:
            for robot in names:
                alive[robot] |= self.bus.alive(timeout=DISCOVERY_TIME_S, robot=robot)
            return bool(find_conflicts(self._published(), alive))

        wait_until(contested, DISCOVERY_TIME_S)
        return alive


def replay(
    path: Path,
    link: Link,
    choice: ReplayOptions | None = None,
    *,
    on_progress: Callable[[PlayerReply], None] = lambda _: None,
    stop: threading.Event | None = None,
    opening: Callable[[Link], AbstractContextManager[Bus]] = open_bus,
    steering: Steering = lambda _: nullcontext(),
) -> Counter[str]:
    """Publish the recording; counts by key. Waits shortly for somebody to listen, and warns of keys nobody wants.

    ``opening`` makes the session, and may insist that somebody is there; ``steering`` runs beside the replay. Raises
    UserError where the file, the choice, or a live publisher of the same keys forbids it.
    """
    choice = choice or ReplayOptions()
    recording = read_recording(path)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    there = robots_of_keys(recording.topics())
    robot = choice.robot or (there[0] if there else link.robot)
    if not math.isfinite(choice.rate):
        choice = replace(choice, rate=0.0)
    with opening(replace(link, robot=robot)) as bus:
        running = Replay(recording, choice, bus)
        running.announce()
        with steering(running.remote):
            running.run(on_progress, stop or threading.Event())
    if recording.problem and recording.indexed:  # found where it was read
        print(f"warning: {recording.warning}", file=sys.stderr)
    return running.counts


def names_of(text: str) -> frozenset[str]:
    """Comma-separated names."""
    return frozenset(part.strip() for part in text.split(",") if part.strip())
