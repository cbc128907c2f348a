"""Observes the bus for a few seconds."""

from __future__ import annotations

import re
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Answer, Inbox, Sample
from common.messages.definitions import Health, Scan
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG, TOPICS
from common.messages.wire import DecodeError
from presage.diagnosis.findings import Finding
from services.recorder.files.message_counts import Sequence

LINK_WITHIN = 3.0  # s
TCP_WITHIN = 2.0  # s; a port that drops what comes is blocked


@dataclass
class Observed:
    """What came within ``seconds`` s; times are ns of this machine's wall clock."""

    robot: str
    seconds: float
    alive: set[str] = field(default_factory=set)
    robots: set[str] = field(default_factory=set)  # all that have a service
    replies: dict[str, list[ConfigReply]] = field(default_factory=dict)  # by service; two: it runs twice
    pulses: dict[str, list[tuple[int, Health]]] = field(default_factory=dict)  # by service, with the time of arrival
    arrivals: Counter[str] = field(default_factory=Counter)  # by key
    sequences: dict[str, Sequence] = field(default_factory=dict)  # by key that one service publishes
    undecodable: dict[str, str] = field(default_factory=dict)  # by key, why
    scan: Scan | None = None  # the last one


def reach(endpoint: str) -> Finding | None:
    """Whether the endpoint's port can be reached at all; None where it can, or where it is no port."""
    found = re.fullmatch(r"\w+/\[?([^\]\s]+?)\]?:(\d{1,5})([?#].*)?", endpoint)
    if found is None or endpoint.startswith(("udp/", "quic/")):
        return None
    try:
        with socket.create_connection((found[1], int(found[2])), TCP_WITHIN):
            return None
    except ConnectionRefusedError:
        advice = "start one with `presage up` or `python -m common.router`, or name its endpoint with --connect"
        return Finding("no_router", False, f"no session at {endpoint}: nothing listens there", endpoint, advice)
    except socket.gaierror:
        return Finding("no_router", False, f"{endpoint}: no such host", endpoint, "is its name right?")
    except (TimeoutError, OSError, OverflowError) as error:
        why = "no answer" if isinstance(error, TimeoutError) else str(error)
        advice = "is that machine on, and does a firewall let the port through?"
        return Finding("blocked", False, f"{endpoint}: the port cannot be reached ({why})", endpoint, advice)


def listen(link: Link, seconds: float) -> Observed | list[Finding]:
    """What is on the bus, or why there is none."""
    with open_bus(link, patience=3.0) as bus:
        if not wait_until(bus.linked, LINK_WITHIN):
            faults = [fault for endpoint in link.connect if (fault := reach(endpoint)) is not None]
            return faults or [_no_zenoh(", ".join(link.connect))]
        seen = Observed(link.robot, seconds)
        inbox, answers = Inbox(capacity=200_000), Inbox()
        bus.watch_robots(lambda robot, _service, there: seen.robots.add(robot) if there else None)
        for topic in TOPICS:
            bus.subscribe(topic, inbox, keep_all=True)
        # A session that has just opened hears of the others one by one, and they of what it subscribes to.
        wait_until(lambda: len(inbox) > 0, 1.0)
        asked = bus.ask_each(CONFIG, Request(), answers, timeout=seconds)
        _receive(inbox, seen)
        seen.alive = bus.alive()
        asked.wait(1.0)
        _take_replies(answers, seen)
        return seen


def _no_zenoh(where: str) -> Finding:
    advice = "another program may use that port, or the router asks for TLS or a password that this tool did not give"
    return Finding(
        "no_router", False, f"no session at {where}: something listens there, but no zenoh answers", where, advice
    )


def _receive(inbox: Inbox, seen: Observed) -> None:
    deadline = time.monotonic() + seen.seconds
    while (left := deadline - time.monotonic()) > 0:
        sample = inbox.get(left)
        if isinstance(sample, Sample):
            _take(sample, seen)


def _take(sample: Sample, seen: Observed) -> None:
    seen.arrivals[sample.key] += 1
    try:
        message = sample.topic.message.decode(sample.payload)
    except DecodeError as error:
        seen.undecodable.setdefault(sample.key, str(error))
        return
    if isinstance(message, Health):
        if sample.key == sample.topic.key(seen.robot, message.service):  # else it speaks for another
            seen.pulses.setdefault(message.service, []).append((sample.received_ns, message))
    elif sample.topic.rate:
        if isinstance(message, Scan) and sample.key == sample.topic.key(seen.robot):
            seen.scan = message
        seen.sequences.setdefault(sample.key, Sequence()).see(message.seq)


def _take_replies(answers: Inbox, seen: Observed) -> None:
    by_service: dict[str, dict[str, ConfigReply]] = defaultdict(dict)
    for answer in _all(answers):
        reply = answer.reply()
        if isinstance(reply, ConfigReply) and reply.ok and reply.service:
            by_service[reply.service][answer.who] = reply
    seen.replies = {service: list(replies.values()) for service, replies in by_service.items()}


def _all(inbox: Inbox) -> Iterator[Answer]:
    while (entry := inbox.get(0)) is not None:
        if isinstance(entry, Answer):
            yield entry
