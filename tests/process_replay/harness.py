"""Puts a service on a bus that is none: events in, everything it sends, answers and counts out, as plain rows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import BaseModel

from common.bus.inbox import Answer, Call, Inbox, Sample
from common.messages.definitions import Stamped
from common.messages.requests import ModelReply, Reply, Request, SampleReply, WorldReply
from common.messages.topics import Query, Topic
from common.runtime.service import Loop, Service
from tests.process_replay.reference import Row, of_array, of_symmetric

ROBOT = "replayed"
SHORT = 9  # numbers; an array up to it is written in full
# Of these answers what is checked elsewhere and would fill pages is left out.
LEFT_OUT = {WorldReply: {"world"}, SampleReply: {"scanner"}, ModelReply: {"world", "card"}}


@dataclass
class FakeBus:
    """What a service needs of `common.bus.bus.Bus`; keeps what is put."""

    robot: str = ROBOT
    instance: str = "replayed"
    sent: list[tuple[Topic, bytes]] = field(default_factory=list)
    replies: dict[tuple[str, str], Reply] = field(default_factory=dict)  # by service and query, of those beside it
    subscribed: dict[Topic, Inbox] = field(default_factory=dict)

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:
        self.sent.append((topic, payload))

    def subscribe(self, topic: Topic, inbox: Inbox, *, keep_all: bool = False, robot: str | None = None) -> None:
        self.subscribed[topic] = inbox

    def watch_alive(self, changed: Callable[[str, bool], None]) -> None:
        for service in dict.fromkeys(service for service, _ in self.replies):
            changed(service, True)

    def ask(self, query: Query, request: Request, reply: type[Reply], timeout: float = 5.0, service: str = "*") -> Any:
        return self.replies[service if query.per_service else query.server, query.name]

    def request(
        self, query: Query, request: Request, number: int, inbox: Inbox, timeout: float = 5.0, service: str = "*"
    ) -> None:
        reply = self.replies.get((query.server, query.name))
        inbox.put(Answer(query, number, reply.encode() if reply else b"", "" if reply else "nobody answers"))

    def ask_each(self, *args: Any, **rest: Any) -> threading.Event:
        """Nobody answers, at once."""
        done = threading.Event()
        done.set()
        return done

    def linked(self) -> bool:
        return True

    def publisher(self, *args: Any) -> None:
        pass

    serve = declare_alive = publisher


@dataclass(frozen=True)
class Event:
    """One thing that happens to a service: a payload, a request, or its timer."""

    what: Topic | Query | None  # None: the time asked for in `due` has come
    payload: bytes = b""

    @classmethod
    def of(cls, what: Topic | Query, message: Stamped | Request) -> Event:
        return cls(what, message.encode())


TIMER = Event(None)


def sample(topic: Topic, payload: bytes, at_ns: int = 1, service: str = "other") -> Sample:
    return Sample(topic, topic.key(ROBOT, service), payload, at_ns, at_ns)


def drive(service: Service, events: Iterable[Event]) -> list[Row]:
    """Every message and answer in order, with the number of the event that caused it; at the end the counters."""
    bus = FakeBus()
    loop = Loop(service, bus, Inbox())  # type: ignore[arg-type]
    service.open()
    rows: list[Row] = []
    try:
        for number, event in enumerate(events):
            _happen(loop, event, number, rows)
            while isinstance(answer := loop.inbox.get(0), Answer):
                loop.service.on_reply(answer.query, answer.number, answer.reply())
            rows += [
                {"event": number, "topic": topic.name, **row_of(topic.message.decode(payload))}
                for topic, payload in bus.sent
            ]
            bus.sent.clear()
    finally:
        service.close()
    counts = {
        # Times are this machine's.
        "counters": {name: count for name, count in sorted(service.counters.items()) if "_us" not in name},
        "published": dict(sorted(loop.published.items())),
        "undecodable": dict(sorted(loop.undecodable.items())),
        "failed": loop.failed,
        "note": service.note,
    }
    return [*rows, {"end": counts}]


def _happen(loop: Loop, event: Event, number: int, rows: list[Row]) -> None:
    if event.what is None:
        loop.guard(loop.service.on_timer)
    elif isinstance(event.what, Topic):
        loop.guard(lambda: loop.service.on_sample(sample(event.what, event.payload)))
    else:
        query = event.what

        def reply(payload: bytes) -> None:
            answer = query.reply.decode(payload)
            rows.append({"event": number, "reply": query.name, "ok": answer.ok, **row_of(answer)})

        def refuse(why: str) -> None:
            rows.append({"event": number, "reply": query.name, "refused": why})

        loop._answer(Call(query, event.payload, reply, refuse))


def row_of(model: BaseModel) -> Row:
    """Fields by name, less those at their default."""
    row: Row = {}
    for name, about in type(model).model_fields.items():
        value = getattr(model, name)
        if name in LEFT_OUT.get(type(model), ()) or (not isinstance(value, np.ndarray) and value == about.default):
            continue
        if isinstance(value, np.ndarray) and not value.size:
            continue
        row[name] = _plain(value)
    return row


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return row_of(value)
    if isinstance(value, np.ndarray):
        if value.shape == (3, 3) and np.allclose(value, value.T):
            return of_symmetric(value)
        flat = value.astype(float).ravel()
        return flat.tolist() if len(flat) <= SHORT else of_array(flat)
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
