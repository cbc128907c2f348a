"""The services of one robot as rows of `presage top`."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median

from common.messages.definitions import Health, Scan, Stamped
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN, Topic, expected_rate, topic_of
from common.runtime.service_monitor import ServiceMonitor, ServiceStatus
from common.runtime.session_files import RunningSession, is_left_out, session_of, start_command

LATENCY_WINDOW = 45  # number of messages whose median latency is shown: 3 s
MIN_RATE_SHARE = 0.8  # share of the nominal rate below which a topic counts as slow
INPUT_AND_OUTPUT = {"estimator": (SCAN, BELIEF), "controller": (BELIEF, CMD_VEL)}  # for the latency of a service
WATCHED = (HEALTH, SCAN, BELIEF, CMD_VEL)


@dataclass(frozen=True)
class TopicRate:
    """The rate of one topic, as counted by one service."""

    topic: str
    hz: float
    nominal: float  # Hz; 0 for a topic without a fixed rate

    @property
    def slow(self) -> bool:
        """Whether the rate is clearly below the nominal rate."""
        return self.hz < MIN_RATE_SHARE * self.nominal


@dataclass(frozen=True)
class ServiceRow:
    """State of one service."""

    service: ServiceStatus
    state: str  # a word for the user
    published: tuple[TopicRate, ...] = ()
    received: tuple[TopicRate, ...] = ()
    latency_ms: float | None = None  # between the publication of its input and of its output
    note: str = ""  # its problem and note; for an absent service, how to start it


class HealthBoard:
    """Collects the messages of one robot. ``now`` is the time of a monotonic clock, s."""

    def __init__(self, robot: str, connect: str = "") -> None:
        """``connect``: endpoints for the start commands of absent services; empty for the default."""
        self.robot, self.connect = robot, connect
        self.monitor = ServiceMonitor(robot)
        self._published: dict[str, dict[int, int]] = {}  # topic: {stamp: ns of wall time}
        self._latencies: dict[str, deque[float]] = {}  # service: ms
        self._scan_time = 0.0  # s, of the last scan

    def add_message(self, topic: Topic, message: Stamped, published_ns: int, now: float) -> None:
        """Takes a message of a topic in `WATCHED`; ``published_ns`` is wall time."""
        if isinstance(message, Health):
            self.monitor.add_health(message, now)
            return
        if isinstance(message, Scan):
            self.monitor.add_scan(now)
            self._scan_time = message.scan_time
        published = self._published.setdefault(topic.name, {})
        first = message.stamp_ns not in published
        published.setdefault(message.stamp_ns, published_ns)
        while len(published) > LATENCY_WINDOW:
            del published[next(iter(published))]
        for service, (input_topic, output_topic) in INPUT_AND_OUTPUT.items():
            input_ns = self._published.get(input_topic.name, {}).get(message.stamp_ns)
            if output_topic is topic and input_ns is not None and first:
                latencies = self._latencies.setdefault(service, deque(maxlen=LATENCY_WINDOW))
                latencies.append(max(0.0, (published_ns - input_ns) * 1e-6))

    def rows(self, now: float) -> list[ServiceRow]:
        """One row for each service: first those that every session has, then the others by name."""
        services = self.monitor.services(now)
        absent = any(service.state == "absent" for service in services)
        session = session_of(self.robot, self.connect) if absent else None
        return [self._row(service, session) for service in services if not self._is_left_out(service, session)]

    def _is_left_out(self, service: ServiceStatus, session: RunningSession | None) -> bool:
        """Whether the session was started without a service that the robot does not need."""
        never_seen = service.state == "absent" and service.since is None and not service.problem
        return never_seen and is_left_out(service.name, self.robot, session)

    def _row(self, service: ServiceStatus, session: RunningSession | None) -> ServiceRow:
        if service.state == "absent":
            word = "gone" if service.since is not None else "missing" if service.problem else "not running"
            start = f"start it: {start_command(service.name, self.robot, self.connect, session)}"
            return ServiceRow(service, word, note=start)
        if service.state == "silent":
            return ServiceRow(service, "silent", note=service.text)
        if service.health is None:
            return ServiceRow(service, "alive" if service.has_started else "starting", note=service.text)
        rows = [(row, rate) for row in service.health.topics if (rate := self._rate(row.key, row.rate)) is not None]
        latencies = self._latencies.get(service.name)
        return ServiceRow(
            service,
            "alive",
            published=tuple(rate for row, rate in rows if row.published),
            received=tuple(rate for row, rate in rows if not row.published),
            latency_ms=median(latencies) if latencies else None,
            note=service.text,
        )

    def _rate(self, key: str, hz: float) -> TopicRate | None:
        """The rate of a topic in a health message; None for other keys and topics that need not be shown."""
        topic = topic_of(key)
        if topic is None or topic is HEALTH or (not topic.rate and not hz):
            return None
        return TopicRate(topic.name, hz, expected_rate(topic, self._scan_time))
