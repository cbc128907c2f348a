"""Publishes a recording's messages at their times.

Payloads are published unchanged, so stamps and sequence numbers are those of the recording. After a seek backwards, or
when a loop restarts, subscribers see stamps that go back, as after a reset of the simulator.
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
from common.bus.inbox import Inbox, IncomingRequest
from common.errors import UserError
from common.messages.requests import PlayerReply, PlayerRequest, WorldReply
from common.messages.topics import CONFIG, PLAYER, SCAN, WORLD, Topic
from common.messages.wire import DecodeError
from common.runtime.protocol_check import build_config_reply
from services.recorder.reader import RawMessage, Recording, read_recording
from services.recorder.replaying.player import (
    Player,
    find_conflicts,
    key_for_robot,
    robots_of_keys,
    select_topics,
    span,
)

NAME = "replay"  # service name of the liveliness token
SUBSCRIBER_TIMEOUT_S = 2.0  # how long to wait for subscribers, because messages sent before are lost
DISCOVERY_TIME_S = 0.5  # time for a new session to learn which services are alive
POLL_PERIOD_S = 0.1  # longest wait before checking whether to stop


@dataclass(frozen=True)
class ReplayOptions:
    """Which part of a recording is replayed, and how."""

    only: frozenset[str] | None = None  # topic names; defaults to all except health
    leave_out: frozenset[str] = frozenset()
    rate: float = 1.0  # factor on the original speed; 0 means as fast as possible
    start: float | None = None  # s since the recording's beginning
    end: float | None = None  # s since the recording's beginning; negative: before its end
    loop: bool = False
    robot: str = ""  # replaces the recorded robot's name
    force: bool = False  # publish even beside a live publisher of the same keys
    paused: bool = False  # start paused, and pause at the end instead of ending


class ReplayControl:
    """Controls a replay from another thread of this process, such as the keyboard's."""

    def __init__(self, player: Player, inbox: Inbox, counts: Counter[str]) -> None:
        """Puts requests into ``inbox``, like those from the bus. ``counts``: messages published so far, by key."""
        self._player, self._inbox = player, inbox
        self.counts = counts
        self.quitting = False

    def send(self, request: PlayerRequest) -> None:
        """Queues a request. Requests are executed in order."""
        self._inbox.put(IncomingRequest(PLAYER, request.encode(), lambda _: None, lambda _: None))

    def state(self) -> PlayerReply:
        """Current state of the replay."""
        return self._player.state(time.monotonic())

    def quit(self) -> None:
        """Ends the replay."""
        self.quitting = True
        self._inbox.wake()


ControlContext = Callable[[ReplayControl], AbstractContextManager[object]]


class Replay:
    """Publishes one recording on one bus session."""

    def __init__(self, recording: Recording, options: ReplayOptions, bus: Bus) -> None:
        """Selects the topics; raises UserError if there are none."""
        self.recording, self.options, self.bus = recording, options, bus
        self.topics = select_topics(recording.topics(), options.only, options.leave_out)
        if not self.topics:
            raise UserError(f"{recording.path}: nothing to replay")
        self.keys = {key: key_for_robot(key, options.robot) for key in self.topics}
        duration = (recording.end_ns - recording.start_ns) * 1e-9
        begin, end = span(duration, options.start, options.end)
        self.inbox = Inbox()
        self.player = Player(begin, end, options.rate, loop=options.loop)
        self.counts: Counter[str] = Counter()  # messages by published key
        self.control = ReplayControl(self.player, self.inbox, self.counts)
        # The topic whose messages complete a step; None if every message does.
        self._step_topic = SCAN if SCAN in self.topics.values() else None

    def announce(self) -> None:
        """Declares publishers, queries and liveliness, and waits for subscribers.

        Raises UserError if a live service publishes the same keys, unless forced.
        """
        alive = self._alive()
        if not self.options.force and (conflicts := find_conflicts(self._published(), alive)):
            raise UserError(conflicts)
        for key, topic in self._published().items():  # all declared before the first wait: parallel discovery
            self.bus.publisher(topic, key=key)
        if WORLD.server not in alive.get(self.bus.robot, set()):  # a live simulator answers this query itself
            self.bus.serve(WORLD, self.inbox)
        self.bus.serve(PLAYER, self.inbox)
        self.bus.serve(CONFIG, self.inbox, NAME)
        self.bus.declare_alive(NAME)
        deadline = time.monotonic() + SUBSCRIBER_TIMEOUT_S
        without_subscriber = [
            key
            for key, topic in self._published().items()
            if not self.bus.wait_matching(topic, max(0.0, deadline - time.monotonic()), key=key)
        ]
        if without_subscriber:
            print(f"warning: no subscriber for {', '.join(without_subscriber)}", file=sys.stderr)

    def run(self, on_progress: Callable[[PlayerReply], None], stop: threading.Event) -> None:
        """Publishes messages until the end, `ReplayControl.quit` or ``stop``."""
        player = self.player
        player.seek(player.begin, time.monotonic())
        player.paused = self.options.paused
        while (position := player.take_seek_target()) is not None:
            for raw in self.recording.payloads(self.topics.keys(), *self._window(position)):
                message_position = (raw.logged_ns - self.recording.start_ns) * 1e-9
                if not self._wait_until_due(message_position, on_progress, stop):
                    break
                self._send(raw, message_position)
                on_progress(player.state(time.monotonic()))
            if stop.is_set() or self.control.quitting:
                break
            if player.loop and not player.seek_pending:
                player.restart(time.monotonic())
            elif self.options.paused and not player.seek_pending:
                self._wait_at_end(on_progress, stop)

    def _window(self, position: float) -> tuple[int, int | None]:
        """Wall times in ns between which messages are read.

        The end is exclusive. It is None if the user gave none, so that the last message is included.
        """
        start, has_end = self.recording.start_ns, self.options.end is not None
        return start + round(position * 1e9), start + round(self.player.end * 1e9) if has_end else None

    def _wait_until_due(
        self, position: float, on_progress: Callable[[PlayerReply], None], stop: threading.Event
    ) -> bool:
        """Waits until a message is due and answers requests meanwhile. Returns False if it must not be published."""
        while True:
            wait = self.player.time_until(position, time.monotonic())
            entry = self.inbox.get(min(wait, POLL_PERIOD_S))
            if isinstance(entry, IncomingRequest):
                self._answer(entry)
            if entry is not None or wait > 0:
                on_progress(self.player.state(time.monotonic()))
            if stop.is_set() or self.control.quitting or self.player.seek_pending:
                return False
            if entry is None and self.player.time_until(position, time.monotonic()) <= 0:
                return True

    def _wait_at_end(self, on_progress: Callable[[PlayerReply], None], stop: threading.Event) -> None:
        """Stays paused at the end until a seek is requested."""
        while not (stop.is_set() or self.control.quitting or self.player.seek_pending):
            self.player.finish(time.monotonic())
            on_progress(self.player.state(time.monotonic()))
            if isinstance(entry := self.inbox.get(POLL_PERIOD_S), IncomingRequest):
                self._answer(entry)

    def _send(self, raw: RawMessage, position: float) -> None:
        topic, key = self.topics[raw.key], self.keys[raw.key]
        self.bus.put(topic, raw.payload, key=key)
        self.counts[key] += 1
        self.player.mark_sent(position, time.monotonic(), completes_step=self._step_topic in (None, topic))

    def _answer(self, call: IncomingRequest) -> None:
        if call.query is CONFIG:
            config = {"file": str(self.recording.path), **asdict(self.options)}
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
        """The recorded world or map, or a refusal if there is none."""
        recording, world = self.recording, self.recording.world()
        if world is None:
            return WorldReply(ok=False, reason=f"{recording.path.name} holds neither a world nor a map")
        return WorldReply(world=world, scanner=recording.scanner(), robot=recording.robot())

    def _published(self) -> dict[str, Topic]:
        """Topics by the key on which they are published."""
        return {self.keys[key]: topic for key, topic in self.topics.items()}

    def _alive(self) -> dict[str, set[str]]:
        """Live services by robot. Waits for the discovery time, or until a conflict is found."""
        robots = robots_of_keys(self._published())
        alive: dict[str, set[str]] = {robot: set() for robot in robots}

        def has_conflicts() -> bool:
            for robot in robots:
                alive[robot] |= self.bus.alive(timeout=DISCOVERY_TIME_S, robot=robot)
            return bool(find_conflicts(self._published(), alive))

        wait_until(has_conflicts, DISCOVERY_TIME_S)
        return alive


def replay(
    path: Path,
    link: Link,
    options: ReplayOptions | None = None,
    *,
    on_progress: Callable[[PlayerReply], None] = lambda _: None,
    stop: threading.Event | None = None,
    open_session: Callable[[Link], AbstractContextManager[Bus]] = open_bus,
    control_context: ControlContext = lambda _: nullcontext(),
) -> Counter[str]:
    """Publishes the recording and returns the number of messages by key.

    Waits briefly for subscribers and warns about keys without one. ``open_session`` opens the bus session, and may
    check that the router is reached; ``control_context`` is entered with the replay's control for its duration. Raises
    UserError if the file cannot be read, the options are invalid, or a live service publishes the same keys.
    """
    options = options or ReplayOptions()
    recording = read_recording(path)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    recorded_robots = robots_of_keys(recording.topics())
    robot = options.robot or (recorded_robots[0] if recorded_robots else link.robot)
    if not math.isfinite(options.rate):
        options = replace(options, rate=0.0)
    with open_session(replace(link, robot=robot)) as bus:
        running = Replay(recording, options, bus)
        running.announce()
        with control_context(running.control):
            running.run(on_progress, stop or threading.Event())
    if recording.problem and recording.indexed:  # damage inside a finished file is only found while reading
        print(f"warning: {recording.warning}", file=sys.stderr)
    return running.counts
