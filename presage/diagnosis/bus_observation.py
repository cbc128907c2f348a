"""Observes the bus for a few seconds."""

from __future__ import annotations

import re
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, RequestResult, Sample
from common.messages.definitions import Health, Scan
from common.messages.requests import ConfigReply, Request
from common.messages.topics import BELIEF, CONFIG, TOPICS
from common.messages.wire import DecodeError
from common.runtime.service_monitor import ServiceMonitor
from presage.diagnosis.findings import Finding
from services.recorder.files.message_counts import SequenceNumbers

ZENOH_TIMEOUT_S = 3.0
TCP_TIMEOUT_S = 2.0  # a port that does not answer within this time is taken to be blocked


@dataclass
class BusObservation:
    """What was received within ``seconds`` s; times are ns of this machine's wall clock."""

    robot: str
    seconds: float
    monitor: ServiceMonitor  # from 0 s to ``seconds``
    connect: str = ""  # endpoints for the start commands of missing services; empty for the default
    robots: set[str] = field(default_factory=set)  # all robots with a service at the end
    replies: dict[str, list[ConfigReply]] = field(default_factory=dict)  # by service; several if it runs several times
    health: dict[str, list[tuple[int, Health]]] = field(default_factory=dict)  # by service, with the time of arrival
    arrivals: Counter[str] = field(default_factory=Counter)  # number of messages, by key
    sequences: dict[str, SequenceNumbers] = field(default_factory=dict)  # sequence numbers, by key with one publisher
    undecodable: dict[str, str] = field(default_factory=dict)  # first decoding error, by key
    scan: Scan | None = None  # the last one
    scan_stamps: list[tuple[int, int]] = field(default_factory=list)  # ns of arrival on a monotonic clock, and stamp
    belief_stamps: list[int] = field(default_factory=list)


def check_endpoint(endpoint: str) -> Finding | None:
    """Returns a finding if no TCP connection to the endpoint is possible, else None; skips other protocols."""
    found = re.fullmatch(r"\w+/\[?([^\]\s]+?)\]?:(\d{1,5})([?#].*)?", endpoint)
    if found is None or endpoint.startswith(("udp/", "quic/")):
        return None
    try:
        with socket.create_connection((found[1], int(found[2])), TCP_TIMEOUT_S):
            return None
    except ConnectionRefusedError:
        advice = (
            "start one with `presage up` or `python -m common.router`, or name its endpoint with `presage --connect`"
        )
        return Finding("no_router", False, f"no session at {endpoint}: nothing listens there", endpoint, advice)
    except socket.gaierror:
        return Finding("no_router", False, f"{endpoint}: no such host", endpoint, "check the host name")
    except (TimeoutError, OSError, OverflowError) as error:
        reason = "no answer" if isinstance(error, TimeoutError) else str(error)
        advice = "is that machine on, and does a firewall let the port through?"
        return Finding("blocked", False, f"{endpoint}: the port cannot be reached ({reason})", endpoint, advice)


def observe_bus(link: Link, seconds: float) -> BusObservation | list[Finding]:
    """Observes the bus for ``seconds`` s; returns findings that say why if there is no session."""
    with open_bus(link, connect_timeout=3.0) as bus:
        if not wait_until(bus.linked, ZENOH_TIMEOUT_S):
            problems = [problem for endpoint in link.connect if (problem := check_endpoint(endpoint)) is not None]
            return problems or [_no_zenoh(", ".join(link.connect))]
        observation = BusObservation(link.robot, seconds, ServiceMonitor(link.robot), link.connect_option)
        inbox, answers = Inbox(capacity=200_000), Inbox()
        tokens: set[tuple[str, str]] = set()  # robot and service; filled by zenoh's thread
        bus.watch_robots(lambda robot, service, alive: (tokens.add if alive else tokens.discard)((robot, service)))
        for topic in TOPICS:
            bus.subscribe(topic, inbox, keep_all=True)
        # A new zenoh session discovers the others one by one: measure from the first message on, or after 1 s.
        wait_until(lambda: len(inbox) > 0, 1.0)
        query = bus.query_all(CONFIG, Request(), answers, timeout=seconds)
        _receive(inbox, tokens, observation)
        observation.robots = {robot for robot, _ in tokens.copy()}
        observation.monitor.set_alive(bus.alive(), seconds)
        query.wait(1.0)
        _add_replies(answers, observation)
        return observation


def _no_zenoh(where: str) -> Finding:
    advice = "another program may use that port, or the router requires TLS or a password: set PRESAGE_SECURITY"
    return Finding(
        "no_router", False, f"no session at {where}: something listens there, but no zenoh answers", where, advice
    )


def _receive(inbox: Inbox, tokens: set[tuple[str, str]], observation: BusObservation) -> None:
    began = time.monotonic()
    while (now := time.monotonic() - began) < observation.seconds:
        alive = {service for robot, service in tokens.copy() if robot == observation.robot}
        observation.monitor.set_alive(alive, now)
        sample = inbox.get(min(observation.seconds - now, 0.5))
        if isinstance(sample, Sample):
            _add_sample(sample, observation, time.monotonic() - began)


def _add_sample(sample: Sample, observation: BusObservation, now: float) -> None:
    observation.arrivals[sample.key] += 1
    try:
        message = sample.topic.message.decode(sample.payload)
    except DecodeError as error:
        observation.undecodable.setdefault(sample.key, str(error))
        return
    if isinstance(message, Health):
        # Health messages on the key of another service are ignored.
        if sample.key == sample.topic.key(observation.robot, message.service):
            received_ns = sample.received_ns + time.time_ns() - time.monotonic_ns()
            observation.health.setdefault(message.service, []).append((received_ns, message))
            observation.monitor.add_health(message, now)
    elif sample.topic.rate:
        if isinstance(message, Scan) and sample.key == sample.topic.key(observation.robot):
            observation.scan = message
            observation.scan_stamps.append((sample.received_ns, message.stamp_ns))
            observation.monitor.add_scan(now)
        elif sample.key == BELIEF.key(observation.robot):
            observation.belief_stamps.append(message.stamp_ns)
        observation.sequences.setdefault(sample.key, SequenceNumbers()).add(message.seq)


def _add_replies(answers: Inbox, observation: BusObservation) -> None:
    by_service: dict[str, dict[str, ConfigReply]] = defaultdict(dict)
    for answer in _drain(answers):
        reply = answer.reply()
        if isinstance(reply, ConfigReply) and reply.ok and reply.service:
            by_service[reply.service][answer.session] = reply
    observation.replies = {service: list(replies.values()) for service, replies in by_service.items()}


def _drain(inbox: Inbox) -> Iterator[RequestResult]:
    while (entry := inbox.get(0)) is not None:
        if isinstance(entry, RequestResult):
            yield entry
