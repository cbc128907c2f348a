"""Publishes and subscribes to messages, and sends and answers requests, over zenoh."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any, TypeVar

import zenoh

from common.bus.endpoints import explain_rejection, refuse_exposure
from common.bus.inbox import Inbox, IncomingRequest, RequestResult, Sample
from common.bus.liveliness import Liveliness, published_ns
from common.bus.security import Credentials, may_put, may_query
from common.bus.session import DEFAULT_ENDPOINT, JOIN_TIMEOUT_S, LOG_FILTER, Link, open_session, wait_until
from common.errors import UserError
from common.messages.requests import Reply, Request
from common.messages.topics import Query, Topic
from common.messages.wire import ENCODING, DecodeError

R = TypeVar("R", bound=Reply)
TIMEOUT_REPLY = "Timeout"  # the text of the error reply that zenoh itself makes when a request expires
JOIN_PAUSE_S = 0.2  # between two attempts to connect to a router that refuses the credentials


class Bus(Liveliness):
    """A zenoh session that publishes, subscribes and queries on the keys of one robot."""

    def __init__(
        self, session: zenoh.Session, robot: str, security: Credentials | None = None, *, lossless: bool = True
    ) -> None:
        """Use `open_bus` instead, which opens and closes the session."""
        super().__init__(session, robot)
        self._security = security
        self._congestion = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._lock = threading.Lock()

    def for_robot(self, robot: str) -> Bus:
        """A bus for the keys of another robot on the same session."""
        lossless = self._congestion == zenoh.CongestionControl.BLOCK
        return Bus(self._session, robot, self._security, lossless=lossless)

    def undeclare_all(self) -> None:
        """Undeclares everything that was declared with this bus, to stop serving its robot."""
        declared: list[Any] = [*self._declared, *self._publishers.values()]
        self._declared.clear()
        self._publishers.clear()
        # Publishers, the liveliness token, then subscriptions: a service that looks alive has all its subscriptions.
        for each in reversed(declared):
            each.undeclare()

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:
        """Publishes bytes on the topic's key, or on ``key`` if given (as in a replay).

        Raises UserError if the role of the credentials may not publish the topic.
        """
        publisher = self.publisher(topic, service, key)
        publisher.put(payload, source_info=zenoh.SourceInfo(publisher.id, 0))

    def publisher(self, topic: Topic, service: str = "*", key: str | None = None) -> zenoh.Publisher:
        """The publisher of a key, which is declared at its first use."""
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
        """Waits until the topic has a subscriber; returns False if it has none within ``timeout`` s.

        Messages that are published earlier may be lost.
        """
        publisher: Any = self.publisher(topic, service, key)  # zenoh's stub declares the wrong type of the status
        return wait_until(lambda: bool(publisher.matching_status.matching), timeout)

    def subscribe(
        self, topic: Topic, inbox: Inbox, *, keep_all: bool = False, robot: str | None = None
    ) -> Callable[[], None]:
        """Puts the payloads of a topic into ``inbox``, by the topic's queue policy or, with ``keep_all``, all of them.

        Returns a function that ends the subscription.
        """
        newest = topic.queue == "newest" and not keep_all

        def on_sample(sample: zenoh.Sample) -> None:
            received, published = time.monotonic_ns(), published_ns(sample)
            source = _source(sample)
            entry = Sample(topic, str(sample.key_expr), sample.payload.to_bytes(), published, received, source)
            inbox.put(entry, newest_only=newest)

        subscriber = self._session.declare_subscriber(topic.key(robot or self.robot), on_sample)
        self._declared.append(subscriber)

        def unsubscribe() -> None:
            self._declared.remove(subscriber)
            subscriber.undeclare()  # type: ignore[no-untyped-call]

        return unsubscribe

    def serve(self, query: Query, inbox: Inbox, service: str = "*") -> None:
        """Puts requests into ``inbox`` as `IncomingRequest`s, which the receiver has to answer."""

        def on_query(call: zenoh.Query) -> None:
            payload = call.payload.to_bytes() if call.payload is not None else b""
            key = query.key(self.robot, service)

            def reply(answer: bytes) -> None:
                with suppress(zenoh.ZError):  # the requester may be gone
                    call.reply(key, answer, encoding=zenoh.Encoding(ENCODING).with_schema(query.reply.__name__))
                call.drop()  # type: ignore[no-untyped-call]

            def refuse(reason: str) -> None:
                with suppress(zenoh.ZError):
                    call.reply_err(reason.encode())
                call.drop()  # type: ignore[no-untyped-call]

            inbox.put(IncomingRequest(query, payload, reply, refuse))

        self._declared.append(self._session.declare_queryable(query.key(self.robot, service), on_query, complete=True))

    def query(
        self,
        query: Query,
        request: Request,
        reply: type[R],
        timeout: float = 5.0,
        service: str = "*",
        robot: str | None = None,
    ) -> R:
        """Sends a request and waits for the first reply.

        Raises UserError if there is no reply within ``timeout`` s, or if it is an error or cannot be decoded.
        """
        key = query.key(robot or self.robot, service)
        if self._security is not None:
            self._security.check(may_query, query, robot or self.robot)
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            answers = list(self._session.get(key, payload=request.encode(), encoding=ENCODING, timeout=left))
            for answer in answers:
                if answer.ok is not None:
                    return _decode_reply(key, reply, answer.ok.payload.to_bytes())
                if answer.err is not None and (error := answer.err.payload.to_string()) != TIMEOUT_REPLY:
                    raise UserError(f"{key}: refused: {error}")
            if answers:
                break
            # A session that has just opened does not know the queryables yet, so the request was not sent: try again.
            time.sleep(0.02)
        server = service if service != "*" else query.server
        raise UserError(
            f"no service answers {key} within {timeout:g} s: is the {server} running? `presage doctor` checks it"
        )

    def send_request(
        self, query: Query, request: Request, number: int, inbox: Inbox, timeout: float = 5.0, service: str = "*"
    ) -> None:
        """Sends a request and returns at once; exactly one `RequestResult` with ``number`` is put into ``inbox``.

        It arrives after about ``timeout`` s at the latest. The request is sent once: if the session has just opened and
        does not know the queryables yet, the result is that there is no service.
        """
        key, first_reply = query.key(self.robot, service), threading.Lock()

        def settle(payload: bytes, refusal: str = "") -> None:
            if first_reply.acquire(blocking=False):  # never released, so only the first reply is used
                inbox.put(RequestResult(query, number, payload, refusal))

        def on_reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                settle(answer.ok.payload.to_bytes())
            elif answer.err is not None and (error := answer.err.payload.to_string()) != TIMEOUT_REPLY:
                settle(b"", f"{key}: refused: {error}")

        def on_end() -> None:
            settle(b"", f"no service answers {key}: is the {service if service != '*' else query.server} running?")

        handler = zenoh.handlers.Callback(on_reply, on_end)
        self._session.get(key, handler, payload=request.encode(), encoding=ENCODING, timeout=timeout)

    def query_all(
        self,
        query: Query,
        request: Request,
        inbox: Inbox,
        timeout: float = 5.0,
        service: str = "*",
        robot: str | None = None,
    ) -> threading.Event:
        """Sends a request to all services that serve the query, including several instances of one service.

        Each reply is put into ``inbox`` as a `RequestResult`. Returns an event that is set when no more replies will
        arrive.
        """
        done, number = threading.Event(), itertools.count()

        def on_reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                inbox.put(
                    RequestResult(query, next(number), answer.ok.payload.to_bytes(), session=str(answer.replier_id))
                )

        self._session.get(
            query.key(robot or self.robot, service),
            zenoh.handlers.Callback(on_reply, done.set),
            payload=request.encode(),
            encoding=ENCODING,
            timeout=timeout,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return done


def _source(sample: zenoh.Sample) -> str:
    """Id of the session that published a sample: from its source info, else from the clock of its timestamp."""
    if (info := sample.source_info) is not None:
        return str(info.source_id.zid)
    return str(sample.timestamp.get_id()) if sample.timestamp is not None else ""


def _decode_reply(key: str, reply: type[R], payload: bytes) -> R:
    try:
        return reply.decode(payload)
    except DecodeError as error:
        raise UserError(f"{key}: the reply cannot be decoded: {error}") from None


@contextmanager
def open_bus(
    link: Link,
    *,
    connect_timeout: float | None = None,
    give_up: Callable[[], bool] = lambda: False,
    log_filter: str = LOG_FILTER,
) -> Iterator[Bus]:
    """Opens a session, and closes it at the end of the ``with`` block.

    With credentials, waits until a router accepts them, for at most ``connect_timeout`` s; None means no limit. Exits
    the process if ``give_up()`` returns true while waiting. Raises UserError if no router accepts the credentials in
    time, if the endpoints cannot be used, or if a session without credentials would be reachable from other machines.
    """
    if link.security is None and not link.insecure:
        refuse_exposure(link.listen)
    zenoh.init_log_from_env_or(log_filter)
    start_s, waiting = time.monotonic(), False
    join_timeout = JOIN_TIMEOUT_S if connect_timeout is None else min(connect_timeout, JOIN_TIMEOUT_S)
    while (session := open_session(link, join_timeout)) is None:
        assert link.security is not None  # noqa: S101 - open_session returns None only with credentials
        rejection = explain_rejection(link.security.member.name, link.connect)
        if give_up():
            raise SystemExit(0)
        if connect_timeout is not None and time.monotonic() - start_s > connect_timeout:
            raise UserError(rejection)
        if connect_timeout is None and not waiting:
            logging.getLogger(__name__).warning("%s; waiting", rejection)
        waiting = True
        time.sleep(JOIN_PAUSE_S)
    with closing(session):  # zenoh's own __exit__ fails while another thread is in a call of the session
        yield Bus(session, link.robot, link.security, lossless=link.lossless)


__all__ = ["DEFAULT_ENDPOINT", "Bus", "Link", "open_bus", "wait_until"]
