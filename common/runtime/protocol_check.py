"""Prevents services with different protocol versions from running together.

A service does not start if another one with a different protocol version is running. The running service logs an error
and continues.
"""

from __future__ import annotations

import platform
import queue
import time
from collections.abc import Callable
from math import inf

from common.bus.bus import Bus, wait_until
from common.bus.inbox import Inbox, RequestResult
from common.errors import UserError
from common.log import Logger
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG
from common.versions import PROTOCOL, versions

COMPARED_PACKAGES = ("presage", "eclipse-zenoh")  # their versions should be the same everywhere
START_TIMEOUT_S = 0.3  # for the first link, and then for replies; `poll` checks later replies
REPLY_TIMEOUT_S = 5.0  # while the service runs
MAX_ATTEMPTS = 3
SIMULTANEOUS_START_S = 1.0  # if two start times are closer than this, their order is uncertain


def build_config_reply(name: str, config: str, uptime: float = 0.0) -> ConfigReply:
    """Builds the reply to the query ``config``: settings as JSON, versions, protocol, host and uptime in s."""
    return ConfigReply(
        service=name, config=config, versions=versions(), protocol=PROTOCOL, host=platform.node()[:200], uptime=uptime
    )


def same_protocol(mine: ConfigReply, other: ConfigReply) -> bool:
    """Whether both speak the same protocol. True if one of them does not state its protocol."""
    return not other.protocol or not mine.protocol or other.protocol == mine.protocol


def started_later(mine: ConfigReply, other: ConfigReply) -> bool:
    """Whether ``mine`` was started after ``other``; of two simultaneous starts, the older protocol counts as later."""
    if abs(mine.uptime - other.uptime) < SIMULTANEOUS_START_S:
        return mine.protocol < other.protocol
    return mine.uptime < other.uptime


def describe_version_differences(mine: ConfigReply, other: ConfigReply) -> str:
    """Package versions that differ, such as ``presage 0.1.0 here, 0.2.0 there``; empty if none does."""
    pairs = [(name, mine.versions.get(name), other.versions.get(name)) for name in COMPARED_PACKAGES]
    return "; ".join(
        f"{name} {here} here, {there} there" for name, here, there in pairs if here and there != here and there
    )


def describe_mismatch(mine: ConfigReply, other: ConfigReply) -> str:
    """Error message that names both protocols and hosts, and what to do."""
    return (
        f"protocol {mine.protocol} here ({_describe_host(mine)}), "
        f"protocol {other.protocol} in the {other.service} ({_describe_host(other)}): "
        "they would misread each other's messages; install the same version of presage on both"
    )


def _describe_host(service: ConfigReply) -> str:
    return f"presage {service.versions.get('presage', 'unknown')} on {service.host or 'an unknown host'}"


class ProtocolCheck:
    """Compares the protocol version and packages of one service with those of the other services."""

    def __init__(self, bus: Bus, service: str, log: Logger) -> None:
        """Checks for ``service``; nothing is queried before `check_at_start`."""
        self._bus, self._service, self._log = bus, service, log
        self._inbox = Inbox(capacity=1000)
        self._arrived: queue.SimpleQueue[str] = queue.SimpleQueue()  # services; filled by zenoh's thread
        self._pending: dict[str, tuple[float, int]] = {}  # by service: time of the last query, number of queries
        self._warned: set[str] = set()

    def check_at_start(self, mine: ConfigReply) -> None:
        """Checks the running services before this one is declared alive.

        Raises UserError if one of them speaks another protocol.
        """
        if not wait_until(self._bus.linked, START_TIMEOUT_S):
            return
        # Repeated because a session that has just opened does not know the other services yet.
        wait_until(self._query_all, START_TIMEOUT_S)
        for other in self._replies():
            if not same_protocol(mine, other):
                raise UserError(describe_mismatch(mine, other))
            self._compare(mine, other)

    def _query_all(self) -> bool:
        """Queries all services; returns whether any replied."""
        self._bus.query_all(CONFIG, Request(), self._inbox, START_TIMEOUT_S).wait(2 * START_TIMEOUT_S)
        return len(self._inbox) > 0

    def watch(self) -> None:
        """Watches for services that are alive or become alive; `poll` checks them."""
        self._bus.watch_alive(lambda name, alive: self._arrived.put(name) if alive else None)

    def poll(self, mine: Callable[[], ConfigReply]) -> None:
        """Queries services that appeared and checks those that replied; to be called about once a second.

        Raises UserError if another protocol is spoken by a service that was started before this one.
        """
        self._query_arrived()
        if not len(self._inbox):
            return
        me = mine()
        for other in self._replies():
            self._pending.pop(other.service, None)
            if not same_protocol(me, other):
                if started_later(me, other):
                    raise UserError(describe_mismatch(me, other))
                self._log.error(describe_mismatch(me, other))
            elif started_later(me, other):
                self._compare(me, other)

    def _query_arrived(self) -> None:
        now = time.monotonic()
        while not self._arrived.empty():
            name = self._arrived.get()
            if name != self._service and len(self._pending) < 1000:  # a hostile peer may invent names
                self._pending[name] = (-inf, 0)
        for name, (last_query, attempts) in list(self._pending.items()):
            if attempts >= MAX_ATTEMPTS:
                del self._pending[name]
            elif now - last_query >= REPLY_TIMEOUT_S:
                self._pending[name] = (now, attempts + 1)
                self._bus.query_all(CONFIG, Request(), self._inbox, REPLY_TIMEOUT_S, name)

    def _replies(self) -> list[ConfigReply]:
        found = []
        while isinstance(answer := self._inbox.get(0), RequestResult):
            reply = answer.reply()
            if isinstance(reply, ConfigReply) and reply.ok and reply.service:
                found.append(reply)
        return found

    def _compare(self, mine: ConfigReply, other: ConfigReply) -> None:
        """Logs different package versions once: they may still work together."""
        if (text := describe_version_differences(mine, other)) and text not in self._warned:
            self._warned.add(text)
            there = f"{other.service} on {other.host or 'an unknown host'}"
            self._log.warning(f"other versions in the {there}: {text}", here=mine.host)
