"""The only file that imports zenoh: sessions, keys, bytes in and out. It computes nothing."""

from __future__ import annotations

import itertools
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import zenoh

from common.endpoints import not_let_in, over_tls, refuse_exposure
from common.errors import UserError
from common.inbox import Answer, Call, Inbox, Sample
from common.instances import Instance, Instances
from common.messages import Stamped
from common.requests import Reply, Request
from common.security import Credentials, may_ask, may_put
from common.topics import Query, Topic, alive_key, standby_key, topic_of
from common.wire import ENCODING, DecodeError, Message

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
# Both call it an error when something arrives while a session opens or closes.
# The third says at every message that a host's clock is ahead; `presage doctor` says it once.
LOG_FILTER = (
    "error,zenoh::api::session=off,zenoh::net::protocol::gossip=off,zenoh::net::routing::dispatcher::pubsub=off"
)
R = TypeVar("R", bound=Reply)


@dataclass(frozen=True)
class Link:
    """Where a session connects and listens; endpoints as zenoh writes them, such as tcp/127.0.0.1:7447."""

    robot: str = "robot"
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    router: bool = False
    multicast: bool = False
    lossless: bool = True  # who cannot keep up holds the publisher back; else it loses what is too much for it
    security: Credentials | None = None  # then it listens nowhere, unless it is a router
    insecure: bool = False  # may listen beyond loopback without credentials


def _config(link: Link) -> zenoh.Config:
    config: zenoh.Config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "router" if link.router else "peer",
        "connect/endpoints": link.connect,
        "connect/timeout_ms": -1,  # a router that is not there yet is waited for, in the background
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "listen/endpoints": link.listen,
        "scouting/multicast/enabled": link.multicast,
        "transport/shared_memory/enabled": False,  # drops silently when a receiver stalls (zenoh issue 2628)
        "timestamping/enabled": True,
        # Who is gone without a word (frozen, cut off) is known to be gone after this; zenoh's own is 10 s.
        "transport/link/tx/lease": 3000,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 5000,  # us
    }
    if link.security is not None:
        settings |= {**link.security.zenoh(), "mode": "router" if link.router else "client"}
        settings["connect/endpoints"] = [over_tls(each) for each in link.connect]
        settings["listen/endpoints"] = [over_tls(each) for each in link.listen] if link.router else []
        if not link.router:  # opening waits for the router: in pieces, so that it can be given up
            settings |= {"connect/timeout_ms": 1000, "connect/exit_on_failure": True}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Bus:
    """One session, bound to one robot's keys."""

    def __init__(
        self, session: zenoh.Session, robot: str, security: Credentials | None = None, *, lossless: bool = True
    ) -> None:
        """Use `open_bus`."""
        self.robot = robot
        self._security = security
        self._congestion = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self.zid = str(session.zid())
        self.instance = Instance(time.time_ns() // 10**6, socket.gethostname(), os.getpid(), self.zid).name
        self._session = session
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._kept: dict[str, tuple[bytes, zenoh.Timestamp | None]] = {}  # by key, the last payload of kept topics
        self._declared: list[object] = []  # zenoh undeclares what nobody holds
        self._lock = threading.Lock()

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:
        """Publish bytes on the topic's key, or on ``key`` where a replay names it."""
        publisher = self.publisher(topic, service, key)
        publisher.put(payload, source_info=zenoh.SourceInfo(publisher.id, 0))

    def publisher(self, topic: Topic, service: str = "*", key: str | None = None) -> zenoh.Publisher:
        """The publisher of a key, declared once."""
        key = key or topic.key(self.robot, service)
        if self._security is not None:
            self._security.check(may_put, topic, key.split("/")[1])
        with self._lock:
            if key not in self._publishers:
                self._publishers[key] = self._session.declare_publisher(
                    key,
                    encoding=zenoh.Encoding(ENCODING).with_schema(topic.message.__name__),
                    congestion_control=self._congestion,
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
            published = _published_ns(sample)
            source = _source(sample)
            entry = Sample(topic, str(sample.key_expr), sample.payload.to_bytes(), published, time.time_ns(), source)
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
        if self._security is not None:
            self._security.check(may_ask, query, robot or self.robot)
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

    def keep(self, topic: Topic) -> None:
        """From now on hear a kept topic, and tell the last payload to whoever asks with `kept`."""
        key = topic.key(self.robot)

        def move(sample: zenoh.Sample) -> None:
            self._kept[key] = (sample.payload.to_bytes(), sample.timestamp)

        def tell(call: zenoh.Query) -> None:
            if (last := self._kept.get(key)) is not None:
                with suppress(zenoh.ZError):  # the asker may be gone
                    call.reply(key, last[0], encoding=ENCODING, timestamp=last[1])
            call.drop()  # type: ignore[no-untyped-call]

        self._declared += [self._session.declare_subscriber(key, move), self._session.declare_queryable(key, tell)]

    def kept(self, topic: Topic, timeout: float = 0.5) -> bytes | None:
        """The last payload that anybody still knows of a kept topic."""
        answers = self._session.get(
            topic.key(self.robot), target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )  # fmt: skip
        found = [(_published_ns(a.ok), a.ok.payload.to_bytes()) for a in answers if a.ok is not None]
        return max(found, default=(0, None), key=lambda each: each[0])[1]

    def ask_each(
        self, query: Query, request: Request, inbox: Inbox, timeout: float = 5.0, service: str = "*",
        robot: str | None = None,
    ) -> threading.Event:  # fmt: skip
        """Ask all who serve the query, also several of one name: an `Answer` each. Set once no more will come."""
        done, number = threading.Event(), itertools.count()

        def move(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                inbox.put(Answer(query, next(number), answer.ok.payload.to_bytes(), who=str(answer.replier_id)))

        self._session.get(
            query.key(robot or self.robot, service), zenoh.handlers.Callback(move, done.set),
            payload=request.encode(), encoding=ENCODING, timeout=timeout,
            target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
        )  # fmt: skip
        return done

    def declare_alive(self, service: str) -> None:
        """Say that the service is there, until the session ends. Declare it last: order is kept."""
        self._token(alive_key(self.robot, service, self.instance))

    def _token(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def stand_by(self, service: str) -> Callable[[], None]:
        """Say that this instance waits until no other leads; a call ends it."""
        token = self._session.liveliness().declare_token(standby_key(self.robot, service, self.instance))
        self._declared.append(token)

        def end() -> None:
            self._declared.remove(token)
            token.undeclare()  # type: ignore[no-untyped-call]

        return end

    def instances(self, service: str, changed: Callable[[], None], timeout: float = 0.5) -> Instances:
        """Who else does what ``service`` does, kept up to date; ``changed`` is called from another thread."""
        found = Instances(self.instance)

        def move(sample: zenoh.Sample) -> None:
            *_, kind, _, name = str(sample.key_expr).split("/")
            found.change(name, leads=kind == "alive", there=sample.kind == zenoh.SampleKind.PUT)
            changed()

        liveliness, keys = (
            self._session.liveliness(),
            [alive_key(self.robot, service), standby_key(self.robot, service)],
        )
        self._declared += [liveliness.declare_subscriber(key, move, history=True) for key in keys]
        for key in keys:  # an answer, where the subscriber's history may still be on its way
            for reply in liveliness.get(key, timeout=timeout):
                if reply.ok is not None:
                    move(reply.ok)
        return found

    def alive(self, timeout: float = 1.0, robot: str | None = None) -> set[str]:
        """Services of this robot, or another, that are there now."""
        return set(self.alive_instances(timeout, robot))

    def alive_instances(
        self, timeout: float = 1.0, robot: str | None = None, *, standby: bool = False
    ) -> dict[str, list[str]]:
        """Instances by service, by age; those that lead, or those that stand by."""
        key = (standby_key if standby else alive_key)(robot or self.robot)
        found: dict[str, list[str]] = {}
        for reply in self._session.liveliness().get(key, timeout=timeout):
            if reply.ok is not None:
                *_, service, name = str(reply.ok.key_expr).split("/")
                found.setdefault(service, []).append(name)
        return {service: sorted(names) for service, names in found.items()}

    def watch_alive(self, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(service, is_there)`` for those there now and at every change, from another thread."""
        self._watch(self.robot, lambda _, service, there: changed(service, there))

    def watch_robots(self, changed: Callable[[str, str, bool], None]) -> None:
        """The same for every robot: ``changed(robot, service, is_there)``."""
        self._watch("*", changed)

    def _watch(self, robots: str, changed: Callable[[str, str, bool], None]) -> None:
        """A service is gone with its last instance; one that comes beside another is told of as well."""
        instances: dict[tuple[str, str], set[str]] = {}

        def move(robot: str, service: str, name: str, there: bool) -> None:  # noqa: FBT001
            known = instances.setdefault((robot, service), set())
            (known.add if there else known.discard)(name)
            if there or not known:
                changed(robot, service, there)

        self.watch_instances(move, robots)

    def watch_instances(self, changed: Callable[[str, str, str, bool], None], robots: str | None = None) -> None:
        """Call ``changed(robot, service, instance, is_there)`` for all that lead now, and at every change."""

        def move(sample: zenoh.Sample) -> None:
            _, robot, _, service, name = str(sample.key_expr).split("/")
            changed(robot, service, name, sample.kind == zenoh.SampleKind.PUT)

        key = alive_key(robots or self.robot)
        self._declared.append(self._session.liveliness().declare_subscriber(key, move, history=True))

    def linked(self) -> bool:
        """Whether any other session is reached."""
        return self.links() > 0

    def links(self) -> int:
        """How many other sessions are reached directly."""
        return len(list(self._session.info.routers_zid())) + len(list(self._session.info.peers_zid()))


def _published_ns(sample: zenoh.Sample) -> int:
    """Wall time at the publisher, 0 if unknown."""
    stamp = sample.timestamp
    return int(stamp.get_time().timestamp() * 1e9) if stamp is not None else 0


def _source(sample: zenoh.Sample) -> str:
    """Whoever published it: by its own word, else by the clock that stamped it."""
    if (info := sample.source_info) is not None:
        return str(info.source_id.zid)
    return str(sample.timestamp.get_id()) if sample.timestamp is not None else ""


def _decode_reply(key: str, reply: type[R], payload: bytes) -> R:
    try:
        return reply.decode(payload)
    except DecodeError as error:
        raise UserError(f"{key}: the answer makes no sense: {error}") from None


@contextmanager
def open_bus(
    link: Link, *, patience: float | None = None, give_up: Callable[[], bool] = lambda: False,
    log_filter: str = LOG_FILTER,
) -> Iterator[Bus]:  # fmt: skip
    """A session for the block; raises UserError where the endpoints cannot be used, or are open to everybody.

    With credentials it begins once a router has let us in: waited for until ``give_up``, or for ``patience`` s.
    """
    if link.security is None and not link.insecure:
        refuse_exposure(link.listen)
    zenoh.init_log_from_env_or(log_filter)
    began, waiting = time.monotonic(), False
    while (session := _open(link)) is None:
        assert link.security is not None  # noqa: S101 - others do not wait
        why = not_let_in(link.security.member.name, link.connect)
        if give_up():
            raise SystemExit(0)
        if patience is not None and time.monotonic() - began > patience:
            raise UserError(why)
        if patience is None and not waiting:
            logging.getLogger(__name__).warning("%s; waiting", why)
        waiting = True
    with closing(session):  # its own __exit__ fails while another thread is inside one of its calls; close() does not
        yield Bus(session, link.robot, link.security, lossless=link.lossless)


def _open(link: Link) -> zenoh.Session | None:
    """None where a router did not let us in yet."""
    try:
        return zenoh.open(_config(link))
    except zenoh.ZError as error:
        text = str(error)
        if link.security is not None and "Unable to connect" in text:
            return None
        if "in use" in text:
            raise UserError(f"port in use: {' '.join(link.listen)}; choose another with --listen") from None
        # Zenoh appends its own source line, and wraps some messages in the name of a Rust enum.
        why = " ".join(text.split(" at /", maxsplit=1)[0].split()).removeprefix('Json5Err(Message { msg: "')
        asked = f"connect {', '.join(link.connect) or 'none'}, listen {', '.join(link.listen) or 'none'}"
        raise UserError(f"no session with {asked}: {why}; an endpoint is written like {DEFAULT_ENDPOINT}") from None


def wait_until(condition: Callable[[], bool], timeout: float, period: float = 0.02) -> bool:
    """Whether ``condition`` comes true within ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(period)
    return True


__all__ = ["DEFAULT_ENDPOINT", "Bus", "Link", "Message", "Stamped", "open_bus", "topic_of", "wait_until"]
