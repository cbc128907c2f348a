"""Liveliness tokens, and the last value of latched topics."""

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

TOLD_WITHIN = 0.3  # s for a subscriber to hear of those who were there before it


class Liveliness:
    """One robot's services on one session."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        """Nothing is declared yet."""
        self.robot = robot
        self.zid = str(session.zid())
        self.instance = Instance(time.time_ns() // 10**6, socket.gethostname(), os.getpid(), self.zid).name
        self._session = session
        self._kept: dict[str, tuple[bytes, zenoh.Timestamp | None]] = {}  # by key, the last payload of kept topics
        self._there: dict[str, set[str]] = {}  # tokens by the key that was asked for
        self._declared: list[object] = []  # zenoh undeclares what nobody holds

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
        found = [(published_ns(a.ok), a.ok.payload.to_bytes()) for a in answers if a.ok is not None]
        return max(found, default=(0, None), key=lambda each: each[0])[1]

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

        def heard(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                move(reply.ok)

        liveliness, alive = self._session.liveliness(), alive_key(self.robot, service)
        for key in (alive, standby_key(self.robot, service)):
            self._follow(key, move, timeout)
            for reply in liveliness.get(key, timeout=timeout):
                heard(reply)

        def look() -> None:
            liveliness.get(alive, zenoh.handlers.Callback(heard), timeout=timeout)

        found.look = look
        return found

    def alive(self, timeout: float = 1.0, robot: str | None = None) -> set[str]:
        """Services of this robot, or another, that are there now."""
        return set(self.alive_instances(timeout, robot))

    def alive_instances(
        self, timeout: float = 1.0, robot: str | None = None, *, standby: bool = False
    ) -> dict[str, list[str]]:
        """Instances by service, by age; those that lead, or those that stand by."""
        found: dict[str, list[str]] = {}
        for key in self._tokens((standby_key if standby else alive_key)(robot or self.robot), timeout):
            *_, service, name = key.split("/")
            found.setdefault(service, []).append(name)
        return {service: sorted(names) for service, names in found.items()}

    def _tokens(self, key: str, timeout: float) -> set[str]:
        """Keys of those there now: a query alone now and then leaves out what is there (see `_follow`)."""
        there = self._there.get(key)
        if there is None:
            there = self._there[key] = set()

            def move(sample: zenoh.Sample) -> None:
                (there.add if sample.kind == zenoh.SampleKind.PUT else there.discard)(str(sample.key_expr))

            self._follow(key, move, timeout)
        return self._asked(key, timeout) | there

    def _asked(self, key: str, timeout: float) -> set[str]:
        """What one query for tokens finds."""
        answers = self._session.liveliness().get(key, timeout=timeout)
        return {str(answer.ok.key_expr) for answer in answers if answer.ok is not None}

    def _follow(self, key: str, move: Callable[[zenoh.Sample], None], timeout: float) -> None:
        """Hear of all tokens from now on; returns once it was told of those that are there.

        Zenoh (1.10) does not say when that is. A query knows, with two faults: it leaves some out while sessions find
        one another, and, of a router's client, all that a subscriber just declared was not told of yet. So it comes
        first, and who is gone in between is not waited for long.
        """
        untold = self._asked(key, timeout)

        def hear(sample: zenoh.Sample) -> None:
            move(sample)
            untold.discard(str(sample.key_expr))

        self._declared.append(self._session.liveliness().declare_subscriber(key, hear, history=True))
        wait_until(lambda: not untold, TOLD_WITHIN, period=0.001)

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
        return self.count_links() > 0

    def count_links(self) -> int:
        """How many other sessions are reached directly."""
        return len(list(self._session.info.routers_zid())) + len(list(self._session.info.peers_zid()))


def published_ns(sample: zenoh.Sample) -> int:
    """Wall time at the publisher, 0 if unknown."""
    stamp = sample.timestamp
    return int(stamp.get_time().timestamp() * 1e9) if stamp is not None else 0
