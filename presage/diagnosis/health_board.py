"""Health messages as rows of a table."""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

from common.bus.bus import DEFAULT_ENDPOINT
from common.messages.definitions import Health, Scan, Stamped
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN, Topic, expected_rate, topic_of

REQUIRED_SERVICES = ("simulator", "estimator", "controller")
OPTIONAL_SERVICES = ("recorder", "viewer")
REPLAY = "replay"  # publishes the messages of all other services
SUBSTITUTES = {"simulator": "bridge_ros2"}  # a ROS robot takes the place of the simulator
HEALTH_TIMEOUT_S = 2.5  # a service without health messages for so long is silent; they come once a second
# A service with such a recent health message is alive although its liveliness token is missing: tokens disappear for a
# moment when a link is re-established.
LIVELINESS_GRACE_S = 1.5
MAX_SERVICES = 50  # limits the memory if a program publishes health messages with made-up names
LATENCY_WINDOW = 45  # number of messages whose median latency is shown: 3 s
MIN_RATE_SHARE = 0.8  # of the nominal rate; a topic below is slow
INPUT_AND_OUTPUT = {"estimator": (SCAN, BELIEF), "controller": (BELIEF, CMD_VEL)}  # for the latency of a service
WATCHED = (HEALTH, SCAN, BELIEF, CMD_VEL)

State = Literal["alive", "starting", "silent", "gone", "missing", "off"]


@dataclass(frozen=True)
class Rate:
    """The rate of one topic, as counted by one service."""

    topic: str
    hz: float
    nominal: float  # Hz; 0 for a topic without a fixed rate

    @property
    def slow(self) -> bool:
        """Whether the rate is clearly below the nominal rate."""
        return self.hz < MIN_RATE_SHARE * self.nominal


@dataclass(frozen=True)
class Row:
    """State of one service."""

    name: str
    state: State
    age: float | None = None  # s since its last health message
    uptime: float | None = None  # s
    published: tuple[Rate, ...] = ()
    received: tuple[Rate, ...] = ()
    dropped: int = 0
    undecodable: int = 0
    failed: int = 0
    latency_ms: float | None = None  # between the publication of its input and of its output
    note: str = ""  # the note of its health; for a service that is not running, how to start it

    @property
    def ok(self) -> bool:
        """Whether the service needs no attention."""
        return self.state in {"alive", "starting", "off"}


def is_replaced(name: str, alive: Container[str]) -> bool:
    """Whether another running service takes the place of the service ``name``."""
    return REPLAY in alive or SUBSTITUTES.get(name, "") in alive


@dataclass
class HealthBoard:
    """The services of one robot. ``now`` is the time of a monotonic clock, s."""

    robot: str
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    _alive: dict[str, float] = field(default_factory=dict)  # service: time when its token was first seen
    _health: dict[str, tuple[float, Health]] = field(default_factory=dict)  # service: time of arrival, last message
    _published: dict[str, dict[int, int]] = field(default_factory=dict)  # topic: {stamp: ns of wall time}
    _latencies: dict[str, deque[float]] = field(default_factory=dict)  # service: ms
    _scan_time: float = 0.0  # s, of the last scan

    def update_alive(self, names: set[str], now: float) -> None:
        """Takes the names of all services that have a liveliness token."""
        self._alive = {name: self._alive.get(name, now) for name in names}

    def add_message(self, topic: Topic, message: Stamped, published_ns: int, now: float) -> None:
        """Takes a message of a topic in `WATCHED`; ``published_ns`` is wall time."""
        if isinstance(message, Health):
            if message.service not in self._health and len(self._health) >= MAX_SERVICES:
                return
            self._health[message.service] = (now, message)
            return
        if isinstance(message, Scan):
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

    def rows(self, now: float) -> list[Row]:
        """One row for each service: first those that every session has, then the others by name."""
        known = [*REQUIRED_SERVICES, *OPTIONAL_SERVICES]
        others = sorted((self._alive.keys() | self._health.keys()) - set(known))
        return [self._row(name, now) for name in (*known, *others)]

    def all_reported(self) -> bool:
        """Whether a health message of each live service has come."""
        return self._alive.keys() <= self._health.keys()

    def _row(self, name: str, now: float) -> Row:
        if name not in self._alive and name not in self._health:
            missing = name in REQUIRED_SERVICES and not is_replaced(name, self._alive)
            return Row(name, "missing" if missing else "off", note=f"start it: {self.start_command(name)}")
        arrival, health = self._health.get(name, (None, None))
        if arrival is None or health is None:
            if now - self._alive[name] <= HEALTH_TIMEOUT_S:
                return Row(name, "starting")
            return Row(name, "silent", note="alive, but it sends no health messages")
        age = now - arrival
        gone = name not in self._alive and age > LIVELINESS_GRACE_S
        state: State = "gone" if gone else "alive" if age <= HEALTH_TIMEOUT_S else "silent"
        rates = [(row, rate) for row in health.topics if (rate := self._rate(row.key, row.rate)) is not None]
        stale = state != "alive"
        latencies = self._latencies.get(name)
        return Row(
            name,
            state,
            age,
            health.uptime,
            published=tuple(rate for row, rate in rates if row.published and not stale),
            received=tuple(rate for row, rate in rates if not row.published and not stale),
            dropped=sum(row.dropped for row in health.topics),
            undecodable=sum(row.undecodable for row in health.topics),
            failed=health.counters.get("failed", 0),
            latency_ms=median(latencies) if latencies and not stale else None,
            note=f"start it again: {self.start_command(name)}" if state == "gone" else health.note,
        )

    def _rate(self, key: str, hz: float) -> Rate | None:
        """The rate of a topic in a health message; None for other keys and topics that need not be shown."""
        topic = topic_of(key)
        if topic is None or topic is HEALTH or (not topic.rate and not hz):
            return None
        return Rate(topic.name, hz, expected_rate(topic, self._scan_time))

    def start_command(self, name: str) -> str:
        """The shell command that starts the service."""
        robot = "" if self.robot == "robot" else f" --robot {self.robot}"
        connect = "" if self.connect == (DEFAULT_ENDPOINT,) else f" --connect {','.join(self.connect)}"
        return f"python -m services.{name}{robot}{connect}"
