"""The only file that imports zenoh: sessions, keys, bytes in and out. It computes nothing."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import zenoh

from common.errors import UserError
from common.inbox import Answer, Call, Inbox, Sample
from common.messages import Stamped
from common.requests import Reply, Request
from common.topics import Query, Topic, alive_key, topic_of
from common.wire import ENCODING, DecodeError, Message

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
# Both call it an error when something arrives while a session opens or closes.
LOG_FILTER = "error,zenoh::api::session=off,zenoh::net::protocol::gossip=off"
R = TypeVar("R", bound=Reply)


@dataclass(frozen=True)
class Link:
    """Where a session connects and listens; endpoints as zenoh writes them, such as tcp/127.0.0.1:7447."""

    robot: str = "robot"
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    router: bool = False
    multicast: bool = False


def _config(link: Link) -> zenoh.Config:
    config: zenoh.Config = zenoh.Config()
    settings = {
        "mode": "router" if link.router else "peer",
        "connect/endpoints": link.connect,
        "connect/timeout_ms": -1,  # a router that is not there yet is waited for, in the background
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "listen/endpoints": link.listen,
        "scouting/multicast/enabled": link.multicast,
        "transport/shared_memory/enabled": False,  # drops silently when a receiver stalls (zenoh issue 2628)
        "timestamping/enabled": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Bus:
    """One session, bound to one robot's keys."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        """Use `open_bus`."""
        self.robot = robot
        self._session = session
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[object] = []  # zenoh undeclares what nobody holds
        self._lock = threading.Lock()

    def beside(self, robot: str) -> Bus:
        """Another robot's keys on the same session."""
        return Bus(self._session, robot)

    def withdraw(self) -> None:
        """Undeclare all that was declared here: this robot is served no more."""
        declared: list[Any] = [*self._declared, *self._publishers.values()]
        self._declared.clear()
        self._publishers.clear()
        for each in reversed(declared):  # the liveliness token, which came last, first
            each.undeclare()

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:
        """Publish bytes on the topic's key, or on ``key`` where a replay names it."""
        self.publisher(topic, service, key).put(payload)

    def publisher(self, topic: Topic, service: str = "*", key: str | None = None) -> zenoh.Publisher:
        """The publisher of a key, declared once."""
        key = key or topic.key(self.robot, service)
        with self._lock:
            if key not in self._publishers:
                self._publishers[key] = self._session.declare_publisher(
                    key,
                    encoding=zenoh.Encoding(ENCODING).with_schema(topic.message.__name__),
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
            return self._publishers[key]

    def wait_matching(self, topic: Topic, timeout: float, service: str = "*", key: str | None = None) -> bool:
        """Whether somebody subscribes to the topic within ``timeout`` s; a put before that may be lost."""
        publisher: Any = self.publisher(topic, service, key)  # zenoh's stub has the status wrong
        return wait_until(lambda: bool(publisher.matching_status.matching), timeout)

    def subscribe(
        self, topic: Topic, inbox: Inbox, *, keep_all: bool = False, robot: str | None = None
    ) -> Callable[[], None]:
        """Move the topic's payloads to ``inbox`` by the topic's queue policy, or all of them; a call ends it."""
        newest = topic.queue == "newest" and not keep_all

        def move(sample: zenoh.Sample) -> None:
            stamp = sample.timestamp
            published = int(stamp.get_time().timestamp() * 1e9) if stamp is not None else 0
            entry = Sample(topic, str(sample.key_expr), sample.payload.to_bytes(), published, time.time_ns())
            inbox.put(entry, newest_only=newest)

        subscriber = self._session.declare_subscriber(topic.key(robot or self.robot), move)
        self._declared.append(subscriber)

        def end() -> None:
            self._declared.remove(subscriber)
            subscriber.undeclare()  # type: ignore[no-untyped-call]

        return end

    def serve(self, query: Query, inbox: Inbox, service: str = "*") -> None:
        """Move requests to ``inbox``; the loop answers them."""

        def move(call: zenoh.Query) -> None:
            payload = call.payload.to_bytes() if call.payload is not None else b""
            key = query.key(self.robot, service)

            def reply(answer: bytes) -> None:
                with suppress(zenoh.ZError):  # the asker may be gone
                    call.reply(key, answer, encoding=zenoh.Encoding(ENCODING).with_schema(query.reply.__name__))
                call.drop()  # type: ignore[no-untyped-call]

            def refuse(why: str) -> None:
                with suppress(zenoh.ZError):
                    call.reply_err(why.encode())
                call.drop()  # type: ignore[no-untyped-call]

            inbox.put(Call(query, payload, reply, refuse))

        self._declared.append(self._session.declare_queryable(query.key(self.robot, service), move, complete=True))

    def ask(
        self, query: Query, request: Request, reply: type[R], timeout: float = 5.0, service: str = "*",
        robot: str | None = None,
    ) -> R:  # fmt: skip
        """The first answer; raises UserError where nobody answers, the answer is an error, or makes no sense."""
        key = query.key(robot or self.robot, service)
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            answers = list(self._session.get(key, payload=request.encode(), encoding=ENCODING, timeout=left))
            for answer in answers:
                if answer.ok is not None:
                    return _decode_reply(key, reply, answer.ok.payload.to_bytes())
                if answer.err is not None and (why := answer.err.payload.to_string()) != "Timeout":
                    raise UserError(f"{key}: refused: {why}")
            if answers:
                break
            time.sleep(0.02)  # a session that has just opened does not know yet who is there: nothing was asked
        who = service if service != "*" else query.server
        raise UserError(f"nobody answers {key} within {timeout:g} s: is the {who} running? `presage doctor` looks")

    def request(
        self, query: Query, request: Request, number: int, inbox: Inbox, timeout: float = 5.0, service: str = "*"
    ) -> None:  # fmt: skip
        """Ask and return at once; exactly one `Answer` with ``number`` comes to ``inbox``, within ``timeout`` s or so.

        Nobody is asked twice: a session that has just opened, and does not know yet who is there, hears of nobody.
        """
        key, owed = query.key(self.robot, service), threading.Lock()

        def settle(payload: bytes, refusal: str = "") -> None:
            if owed.acquire(blocking=False):  # the first answer counts, and is never given back
                inbox.put(Answer(query, number, payload, refusal))

        def move(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                settle(answer.ok.payload.to_bytes())
            elif answer.err is not None and (why := answer.err.payload.to_string()) != "Timeout":
                settle(b"", f"{key}: refused: {why}")

        def end() -> None:
            settle(b"", f"nobody answers {key}: is the {service if service != '*' else query.server} running?")

        handler = zenoh.handlers.Callback(move, end)
        self._session.get(key, handler, payload=request.encode(), encoding=ENCODING, timeout=timeout)

    def declare_alive(self, service: str) -> None:
        """Say that the service is there, until the session ends. Declare it last: order is kept."""
        self._declared.append(self._session.liveliness().declare_token(alive_key(self.robot, service)))

    def alive(self, timeout: float = 1.0, robot: str | None = None) -> set[str]:
        """Services of this robot, or another, that are there now."""
        replies = self._session.liveliness().get(alive_key(robot or self.robot), timeout=timeout)
        return {str(r.ok.key_expr).rsplit("/", 1)[-1] for r in replies if r.ok is not None}

    def watch_alive(self, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(service, is_there)`` for those there now and at every change, from another thread."""

        def move(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr).rsplit("/", 1)[-1], sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(alive_key(self.robot), move, history=True)
        self._declared.append(subscriber)

    def watch_robots(self, changed: Callable[[str, str, bool], None]) -> None:
        """The same for every robot: ``changed(robot, service, is_there)``."""

        def move(sample: zenoh.Sample) -> None:
            _, robot, _, service = str(sample.key_expr).split("/")
            changed(robot, service, sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._session.liveliness().declare_subscriber(alive_key("*"), move, history=True))

    def linked(self) -> bool:
        """Whether any other session is reached."""
        return bool(list(self._session.info.routers_zid()) or list(self._session.info.peers_zid()))


def _decode_reply(key: str, reply: type[R], payload: bytes) -> R:
    try:
        return reply.decode(payload)
    except DecodeError as error:
        raise UserError(f"{key}: the answer makes no sense: {error}") from None


@contextmanager
def open_bus(link: Link) -> Iterator[Bus]:
    """A session for the block; raises UserError where the endpoints cannot be used."""
    zenoh.init_log_from_env_or(LOG_FILTER)
    try:
        session = zenoh.open(_config(link))
    except zenoh.ZError as error:
        text = str(error)
        if "in use" in text:
            raise UserError(f"port in use: {' '.join(link.listen)}; choose another with --listen") from None
        # Zenoh appends its own source line, and wraps some messages in the name of a Rust enum.
        why = " ".join(text.split(" at /", maxsplit=1)[0].split()).removeprefix('Json5Err(Message { msg: "')
        asked = f"connect {', '.join(link.connect) or 'none'}, listen {', '.join(link.listen) or 'none'}"
        raise UserError(f"no session with {asked}: {why}; an endpoint is written like {DEFAULT_ENDPOINT}") from None
    with closing(session):  # its own __exit__ fails while another thread is inside one of its calls; close() does not
        yield Bus(session, link.robot)


def wait_until(condition: Callable[[], bool], timeout: float, period: float = 0.02) -> bool:
    """Whether ``condition`` comes true within ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(period)
    return True


__all__ = ["DEFAULT_ENDPOINT", "Bus", "Link", "Message", "Stamped", "open_bus", "topic_of", "wait_until"]
