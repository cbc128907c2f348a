"""Zenoh liveliness tokens, which show the running services, and the last value of latched topics."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress

import zenoh

from common.bus.instances import Instance, Instances
from common.bus.session import wait_until
from common.messages.topics import Topic, alive_key, standby_key
from common.messages.wire import ENCODING

QUERY_TIMEOUT_S = 0.5  # within which other sessions answer a query for tokens or latched payloads
HISTORY_TIMEOUT_S = 0.3  # within which a new liveliness subscriber receives the tokens that existed before it


class Liveliness:
    """Declares and watches the liveliness tokens of one robot's services, and serves its latched topics."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        """Uses ``session`` for the keys of ``robot``; nothing is declared yet."""
        self.robot = robot
        self.zid = str(session.zid())
        self.instance = Instance(time.time_ns() // 10**6, socket.gethostname(), os.getpid(), self.zid).name
        self._session = session
        self._latched: dict[str, tuple[bytes, zenoh.Timestamp | None]] = {}  # by key: the last payload
        self._alive: dict[str, set[str]] = {}  # tokens by the key expression that is watched
        self._declared: list[object] = []  # zenoh undeclares objects that are garbage-collected

    def serve_latched(self, topic: Topic) -> None:
        """Subscribes to a latched topic, and serves its last payload to sessions that call `query_latched`."""
        key = topic.key(self.robot)

        def store(sample: zenoh.Sample) -> None:
            self._latched[key] = (sample.payload.to_bytes(), sample.timestamp)

        def reply(call: zenoh.Query) -> None:
            if (last := self._latched.get(key)) is not None:
                with suppress(zenoh.ZError):  # the requester may be gone
                    call.reply(key, last[0], encoding=ENCODING, timestamp=last[1])
            call.drop()  # type: ignore[no-untyped-call]

        self._declared += [self._session.declare_subscriber(key, store), self._session.declare_queryable(key, reply)]

    def query_latched(self, topic: Topic) -> bytes | None:
        """The newest payload of a latched topic that any session has stored, or None."""
        answers = self._session.get(
            topic.key(self.robot),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=QUERY_TIMEOUT_S,
        )
        found = [(published_ns(a.ok), a.ok.payload.to_bytes()) for a in answers if a.ok is not None]
        return max(found, default=(0, None), key=lambda each: each[0])[1]

    def declare_alive(self, service: str) -> None:
        """Declares the service alive until the session ends.

        Call it last: others receive declarations in order, so that an alive service has all its subscriptions.
        """
        self._declared.append(self._session.liveliness().declare_token(alive_key(self.robot, service, self.instance)))

    def stand_by(self, service: str) -> Callable[[], None]:
        """Declares that this instance waits until no other is active; returns a function that ends it."""
        token = self._session.liveliness().declare_token(standby_key(self.robot, service, self.instance))
        self._declared.append(token)

        def end() -> None:
            self._declared.remove(token)
            token.undeclare()  # type: ignore[no-untyped-call]

        return end

    def instances(self, service: str, changed: Callable[[], None]) -> Instances:
        """The other instances of ``service``, kept up to date; ``changed`` is called from another thread."""
        found = Instances(self.instance)

        def update(sample: zenoh.Sample) -> None:
            *_, kind, _, name = str(sample.key_expr).split("/")
            found.update(name, leads=kind == "alive", alive=sample.kind == zenoh.SampleKind.PUT)
            changed()

        def handle_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                update(reply.ok)

        liveliness, alive = self._session.liveliness(), alive_key(self.robot, service)
        for key in (alive, standby_key(self.robot, service)):
            self._watch_tokens(key, update, QUERY_TIMEOUT_S)
            for reply in liveliness.get(key, timeout=QUERY_TIMEOUT_S):
                handle_reply(reply)

        def refresh() -> None:
            liveliness.get(alive, zenoh.handlers.Callback(handle_reply), timeout=QUERY_TIMEOUT_S)

        found.refresh = refresh
        return found

    def alive(self, timeout: float = 1.0, robot: str | None = None) -> set[str]:
        """Names of the services that are alive now, of this robot or of ``robot``."""
        return set(self.alive_instances(timeout, robot))

    def robots(self, timeout: float = 1.0) -> list[str]:
        """Names of the robots with live services."""
        return sorted({key.split("/")[1] for key in self._tokens(alive_key("*"), timeout)})

    def alive_instances(
        self, timeout: float = 1.0, robot: str | None = None, *, standby: bool = False
    ) -> dict[str, list[str]]:
        """Names of the active instances, or with ``standby`` of the waiting ones, by service and oldest first."""
        found: dict[str, list[str]] = {}
        for key in self._tokens((standby_key if standby else alive_key)(robot or self.robot), timeout):
            *_, service, name = key.split("/")
            found.setdefault(service, []).append(name)
        return {service: sorted(names) for service, names in found.items()}

    def _tokens(self, key: str, timeout: float) -> set[str]:
        """Keys of the tokens that exist now: a query alone may miss some (see `_watch_tokens`)."""
        alive = self._alive.get(key)
        if alive is None:
            alive = self._alive[key] = set()

            def update(sample: zenoh.Sample) -> None:
                (alive.add if sample.kind == zenoh.SampleKind.PUT else alive.discard)(str(sample.key_expr))

            self._watch_tokens(key, update, timeout)
        return self._query_tokens(key, timeout) | alive

    def _query_tokens(self, key: str, timeout: float) -> set[str]:
        """Keys of the tokens that one query finds."""
        answers = self._session.liveliness().get(key, timeout=timeout)
        return {str(answer.ok.key_expr) for answer in answers if answer.ok is not None}

    def _watch_tokens(self, key: str, changed: Callable[[zenoh.Sample], None], timeout: float) -> None:
        """Calls ``changed`` for every token of ``key``; returns after it was called for the existing ones.

        Zenoh (1.10) does not report when a subscriber has received all existing tokens, so they are queried first and
        then awaited. The query has two faults: it misses some tokens while sessions are still connecting, and, for a
        router's client, all those that a newly declared subscriber has not received yet. It therefore precedes the
        declaration. A token that disappears in between is awaited only for a short time.
        """
        missing = self._query_tokens(key, timeout)

        def receive(sample: zenoh.Sample) -> None:
            changed(sample)
            missing.discard(str(sample.key_expr))

        self._declared.append(self._session.liveliness().declare_subscriber(key, receive, history=True))
        wait_until(lambda: not missing, HISTORY_TIMEOUT_S, period=0.001)

    def watch_alive(self, changed: Callable[[str, bool], None]) -> None:
        """Calls ``changed(service, is_alive)`` for the services alive now and at every change, from another thread."""
        self._watch_services(self.robot, lambda _, service, alive: changed(service, alive))

    def watch_robots(self, changed: Callable[[str, str, bool], None]) -> None:
        """Like `watch_alive` for all robots: calls ``changed(robot, service, is_alive)``."""
        self._watch_services("*", changed)

    def _watch_services(self, robots: str, changed: Callable[[str, str, bool], None]) -> None:
        """Reports every new instance of a service as alive, and the service as gone with its last instance."""
        instances: dict[tuple[str, str], set[str]] = {}

        def update(robot: str, service: str, name: str, alive: bool) -> None:  # noqa: FBT001
            known = instances.setdefault((robot, service), set())
            (known.add if alive else known.discard)(name)
            if alive or not known:
                changed(robot, service, alive)

        self.watch_instances(update, robots)

    def watch_instances(self, changed: Callable[[str, str, str, bool], None], robots: str | None = None) -> None:
        """Calls ``changed(robot, service, instance, is_alive)`` for all active instances, and at every change."""

        def update(sample: zenoh.Sample) -> None:
            _, robot, _, service, name = str(sample.key_expr).split("/")
            changed(robot, service, name, sample.kind == zenoh.SampleKind.PUT)

        key = alive_key(robots or self.robot)
        self._declared.append(self._session.liveliness().declare_subscriber(key, update, history=True))

    def linked(self) -> bool:
        """Whether this session is connected to any other."""
        return self.count_links() > 0

    def count_links(self) -> int:
        """Number of sessions to which this one is directly connected."""
        return len(list(self._session.info.routers_zid())) + len(list(self._session.info.peers_zid()))


def published_ns(sample: zenoh.Sample) -> int:
    """Wall time in ns at which a sample was published, by the publisher's clock; 0 if unknown."""
    stamp = sample.timestamp
    return int(stamp.get_time().timestamp() * 1e9) if stamp is not None else 0
