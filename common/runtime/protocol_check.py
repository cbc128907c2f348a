"""Refuses to start beside services that speak another protocol version.

Who comes to others of another protocol does not start; who is there already says so and goes on.
"""

from __future__ import annotations

import platform
import queue
import time
from collections.abc import Callable
from math import inf

from common.bus.bus import Bus, wait_until
from common.bus.inbox import Answer, Inbox
from common.errors import UserError
from common.log import Logger
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG
from common.versions import PROTOCOL, versions

COMPARED = ("presage", "eclipse-zenoh")  # packages whose versions should be the same everywhere
WITHIN = 0.3  # s, that a start waits for a link, and then for answers; who answers later is judged later
ANSWER = 5.0  # s, for an answer to come while the service works
ATTEMPTS = 3
SIMULTANEOUS_START_S = 1.0  # s between two starts of which nobody can say which was first


def build_config_reply(name: str, config: str, uptime: float = 0.0) -> ConfigReply:
    """What a service says of itself; ``config`` is JSON, ``uptime`` s."""
    return ConfigReply(
        service=name, config=config, versions=versions(), protocol=PROTOCOL, host=platform.node()[:200], uptime=uptime
    )


def same_protocol(mine: ConfigReply, other: ConfigReply) -> bool:
    """Whether both speak the same protocol; who does not say is believed to."""
    return not other.protocol or not mine.protocol or other.protocol == mine.protocol


def started_later(mine: ConfigReply, other: ConfigReply) -> bool:
    """Whether we are the one that came to the other; the older protocol where both came at once."""
    if abs(mine.uptime - other.uptime) < SIMULTANEOUS_START_S:
        return mine.protocol < other.protocol
    return mine.uptime < other.uptime


def describe_version_differences(mine: ConfigReply, other: ConfigReply) -> str:
    """Both sides' packages where they differ: ``presage 0.1.0 here, 0.2.0 there``; empty: they do not."""
    pairs = [(name, mine.versions.get(name), other.versions.get(name)) for name in COMPARED]
    return "; ".join(
        f"{name} {here} here, {there} there" for name, here, there in pairs if here and there != here and there
    )


def describe_mismatch(mine: ConfigReply, other: ConfigReply) -> str:
    """One line that names both protocols and hosts, and what to do."""
    return (
        f"protocol {mine.protocol} here ({_at(mine)}), "
        f"protocol {other.protocol} in the {other.service} ({_at(other)}): "
        "they would misread each other's messages; install the same version of presage on both"
    )


def _at(service: ConfigReply) -> str:
    return f"presage {service.versions.get('presage', 'unknown')} on {service.host or 'an unknown host'}"


class ProtocolCheck:
    """One service's look at the others."""

    def __init__(self, bus: Bus, me: str, log: Logger) -> None:
        """Nothing is asked yet."""
        self._bus, self._me, self._log = bus, me, log
        self._inbox = Inbox(capacity=1000)
        self._came: queue.SimpleQueue[str] = queue.SimpleQueue()  # from zenoh's thread
        self._asked: dict[str, tuple[float, int]] = {}  # who owes an answer: when asked, how often
        self._warned: set[str] = set()

    def check_at_start(self, mine: ConfigReply) -> None:
        """Before we are there for others; raises UserError where one that is there speaks another protocol."""
        if not wait_until(self._bus.linked, WITHIN):
            return
        wait_until(self._asked_somebody, WITHIN)  # a session that has just opened does not know yet who is there
        for other in self._answers():
            if not same_protocol(mine, other):
                raise UserError(describe_mismatch(mine, other))
            self._compare(mine, other)

    def _asked_somebody(self) -> bool:
        self._bus.ask_each(CONFIG, Request(), self._inbox, WITHIN).wait(2 * WITHIN)
        return len(self._inbox) > 0

    def watch(self) -> None:
        """From now on hear of who comes, and of who is there."""
        self._bus.watch_alive(lambda name, there: self._came.put(name) if there else None)

    def look(self, mine: Callable[[], ConfigReply]) -> None:
        """Now and then: ask who came, judge who answered; raises UserError as `check_at_start` where we came later."""
        self._ask()
        if not len(self._inbox):
            return
        me = mine()
        for other in self._answers():
            self._asked.pop(other.service, None)
            if not same_protocol(me, other):
                if started_later(me, other):
                    raise UserError(describe_mismatch(me, other))
                self._log.error(describe_mismatch(me, other))
            elif started_later(me, other):
                self._compare(me, other)

    def _ask(self) -> None:
        now = time.monotonic()
        while not self._came.empty():
            name = self._came.get()
            if name != self._me and len(self._asked) < 1000:  # somebody may invent names
                self._asked[name] = (-inf, 0)
        for name, (at, times) in list(self._asked.items()):
            if times >= ATTEMPTS:
                del self._asked[name]
            elif now - at >= ANSWER:
                self._asked[name] = (now, times + 1)
                self._bus.ask_each(CONFIG, Request(), self._inbox, ANSWER, name)

    def _answers(self) -> list[ConfigReply]:
        found = []
        while isinstance(answer := self._inbox.get(0), Answer):
            reply = answer.reply()
            if isinstance(reply, ConfigReply) and reply.ok and reply.service:
                found.append(reply)
        return found

    def _compare(self, mine: ConfigReply, other: ConfigReply) -> None:
        """Other packages may work; it is worth one line."""
        if (text := describe_version_differences(mine, other)) and text not in self._warned:
            self._warned.add(text)
            there = f"{other.service} on {other.host or 'an unknown host'}"
            self._log.warning(f"other versions in the {there}: {text}", here=mine.host)
