"""Receives topics and keeps the latest message of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

from common.bus.bus import Bus, Link, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.definitions import Stamped
from common.messages.topics import Topic
from common.messages.wire import DecodeError

CONNECT_TIMEOUT_S = 3.0
M = TypeVar("M", bound=Stamped)


class LatestMessages:
    """Subscribes to topics and keeps the newest message of each."""

    def __init__(self, bus: Bus, *topics: Topic) -> None:
        """Subscribes to ``topics``; messages published before are not received."""
        self.bus, self.inbox = bus, Inbox()
        self.latest: dict[str, Stamped] = {}
        for topic in topics:
            bus.subscribe(topic, self.inbox, keep_all=True)

    def next(self, timeout: float) -> Stamped | None:
        """Returns the next valid message, or None if none comes within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            sample = self.inbox.get(left)
            if isinstance(sample, Sample):
                with suppress(DecodeError):
                    message = sample.topic.message.decode(sample.payload)
                    self.latest[sample.topic.name] = message
                    return message
        return None

    def wait_for(self, kind: type[M], condition: Callable[[M], bool], timeout: float) -> M | None:
        """Returns the next message of type ``kind`` that meets the condition, or None after ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            message = self.next(left)
            if isinstance(message, kind) and condition(message):
                return message
        return None


@contextmanager
def session_bus(link: Link) -> Iterator[Bus]:
    """Opens the bus of a running session.

    Raises UserError if no router answers within `CONNECT_TIMEOUT_S`. An error in the block is replaced by one that
    names the running robots, if this robot is none of them.
    """
    with open_bus(link, connect_timeout=CONNECT_TIMEOUT_S) as bus:
        if link.connect and not wait_until(bus.linked, CONNECT_TIMEOUT_S):
            raise UserError(
                f"nothing answers at {', '.join(link.connect)}: start a session with `presage up`, "
                "or give the endpoint of a running one with `presage --connect`"
            )
        try:
            yield bus
        except UserError:
            # A session that was just opened may not know of any robot yet.
            wait_until(lambda: bool(bus.robots()), CONNECT_TIMEOUT_S)
            if (robots := bus.robots(CONNECT_TIMEOUT_S)) and bus.robot not in robots:
                raise UserError(
                    f"no robot {bus.robot!r} is running: choose one of {', '.join(robots)} with `presage --robot NAME`"
                ) from None
            raise
