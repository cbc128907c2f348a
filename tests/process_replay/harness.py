"""Runs a service on a fake bus: events go in; its messages, answers and counters come out as plain rows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import BaseModel

from common.bus.inbox import Inbox, IncomingRequest, RequestResult, Sample
from common.messages.definitions import Stamped
from common.messages.requests import ModelReply, Reply, Request, SampleReply, WorldReply
from common.messages.topics import Query, Topic
from common.runtime.service import Service, ServiceLoop
from tests.process_replay.reference import Row, of_array, of_symmetric

ROBOT = "replayed"
MAX_FULL_ARRAY = 9  # arrays of up to this many numbers are written in full
# Fields left out of these replies, because they are long and checked elsewhere.
OMITTED_FIELDS = {WorldReply: {"world"}, SampleReply: {"scanner"}, ModelReply: {"world", "card"}}


@dataclass
class FakeBus:
    """The part of `common.bus.bus.Bus` that services use; stores what they publish."""

    robot: str = ROBOT
    instance: str = "replayed"
    sent: list[tuple[Topic, bytes]] = field(default_factory=list)
    replies: dict[tuple[str, str], Reply] = field(default_factory=dict)  # of other services, by service and query
    subscribed: dict[Topic, Inbox] = field(default_factory=dict)

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:
        self.sent.append((topic, payload))

    def subscribe(self, topic: Topic, inbox: Inbox, *, keep_all: bool = False, robot: str | None = None) -> None:
        self.subscribed[topic] = inbox

    def watch_alive(self, changed: Callable[[str, bool], None]) -> None:
        for service in dict.fromkeys(service for service, _ in self.replies):
            changed(service, True)

    def query(
        self, query: Query, request: Request, reply: type[Reply], timeout: float = 5.0, service: str = "*"
    ) -> Any:
        return self.replies[service if query.per_service else query.server, query.name]

    def send_request(
        self, query: Query, request: Request, number: int, inbox: Inbox, timeout: float = 5.0, service: str = "*"
    ) -> None:
        reply = self.replies.get((query.server, query.name))
        inbox.put(RequestResult(query, number, reply.encode() if reply else b"", "" if reply else "no reply"))

    def query_all(self, *args: Any, **rest: Any) -> threading.Event:
        """Completes at once, without answers."""
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
    """An input of a service: a payload, a request, or its timer."""

    what: Topic | Query | None  # None for the timer, at the time returned by `due`
    payload: bytes = b""

    @classmethod
    def of(cls, what: Topic | Query, message: Stamped | Request) -> Event:
        return cls(what, message.encode())


TIMER = Event(None)


def sample(topic: Topic, payload: bytes, at_ns: int = 1, service: str = "other") -> Sample:
    return Sample(topic, topic.key(ROBOT, service), payload, at_ns, at_ns)


def drive(service: Service, events: Iterable[Event]) -> list[Row]:
    """Feeds the events to the service. Returns its messages and answers in order, and finally its counters.

    Each row has the number of the event that caused it.
    """
    bus = FakeBus()
    loop = ServiceLoop(service, bus, Inbox())  # type: ignore[arg-type]
    service.open()
    rows: list[Row] = []
    try:
        for number, event in enumerate(events):
            _feed(loop, event, number, rows)
            while isinstance(answer := loop.inbox.get(0), RequestResult):
                loop.service.on_reply(answer.query, answer.number, answer.reply())
            rows += [
                {"event": number, "topic": topic.name, **row_of(topic.message.decode(payload))}
                for topic, payload in bus.sent
            ]
            bus.sent.clear()
    finally:
        service.close()
    counts = {
        # Times differ between machines.
        "counters": {name: count for name, count in sorted(service.counters.items()) if "_us" not in name},
        "published": dict(sorted(loop.published.items())),
        "undecodable": dict(sorted(loop.undecodable.items())),
        "failed": loop.failed,
        "note": service.note,
    }
    return [*rows, {"end": counts}]


def _feed(loop: ServiceLoop, event: Event, number: int, rows: list[Row]) -> None:
    if event.what is None:
        loop.run_guarded(loop.service.on_timer)
    elif isinstance(event.what, Topic):
        loop.run_guarded(lambda: loop.service.on_sample(sample(event.what, event.payload)))
    else:
        query = event.what

        def reply(payload: bytes) -> None:
            answer = query.reply.decode(payload)
            rows.append({"event": number, "reply": query.name, "ok": answer.ok, **row_of(answer)})

        def refuse(why: str) -> None:
            rows.append({"event": number, "reply": query.name, "refused": why})

        loop._answer(IncomingRequest(query, event.payload, reply, refuse))


def row_of(model: BaseModel) -> Row:
    """The model's fields by name, without those that have their default value."""
    row: Row = {}
    for name, info in type(model).model_fields.items():
        value = getattr(model, name)
        if name in OMITTED_FIELDS.get(type(model), ()) or (not isinstance(value, np.ndarray) and value == info.default):
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
        return flat.tolist() if len(flat) <= MAX_FULL_ARRAY else of_array(flat)
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
