"""Health messages as rows."""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

from common.bus.bus import DEFAULT_ENDPOINT
from common.messages.definitions import Health, Scan, Stamped
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN, Topic, expected_rate, topic_of

NEEDED = ("simulator", "estimator", "controller")
OPTIONAL = ("recorder", "viewer")
SOURCE = "replay"  # plays what the others would say
STANDS_IN = {"simulator": "bridge_ros2"}  # a robot in ROS takes the simulator's place
SILENT = 2.5  # s without a pulse; one comes each second
BREATH = 1.5  # s; who sent a pulse so lately is there, whatever liveliness says: links are made anew now and then
MOST = 50  # services; somebody may invent names
KEPT = 45  # answers of which a latency is the median: 3 s
SLOW = 0.8  # of the nominal rate
ANSWERS = {"estimator": (SCAN, BELIEF), "controller": (BELIEF, CMD_VEL)}  # what a service makes of what
WATCHED = (HEALTH, SCAN, BELIEF, CMD_VEL)

State = Literal["alive", "begins", "silent", "gone", "missing", "off"]


@dataclass(frozen=True)
class Rate:
    """Of one topic in one service."""

    topic: str
    hz: float
    nominal: float  # Hz; 0: when something happens

    @property
    def slow(self) -> bool:
        """Whether it falls behind the scanner, or the table of topics."""
        return self.hz < SLOW * self.nominal


@dataclass(frozen=True)
class Row:
    """One service."""

    name: str
    state: State
    age: float | None = None  # s since its last pulse
    uptime: float | None = None  # s
    sends: tuple[Rate, ...] = ()
    hears: tuple[Rate, ...] = ()
    dropped: int = 0
    undecodable: int = 0
    failed: int = 0
    latency_ms: float | None = None  # from what it answers to its answer, as published
    note: str = ""  # its own; of one that is not there, how to start it

    @property
    def well(self) -> bool:
        """Whether nothing needs to be done about it."""
        return self.state in {"alive", "begins", "off"}


def replaced(name: str, alive: Container[str]) -> bool:
    """Whether somebody else who is there does what a service would do."""
    return SOURCE in alive or STANDS_IN.get(name, "") in alive


@dataclass
class Board:
    """One robot's services. ``now`` is s of any clock that does not go back."""

    robot: str
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    _alive: dict[str, float] = field(default_factory=dict)  # since when
    _pulses: dict[str, tuple[float, Health]] = field(default_factory=dict)
    _published: dict[str, dict[int, int]] = field(default_factory=dict)  # topic: stamp to ns of wall time
    _latencies: dict[str, deque[float]] = field(default_factory=dict)
    _scan_time: float = 0.0  # s, as the last scan says

    def see_alive(self, names: set[str], now: float) -> None:
        """Who is there."""
        self._alive = {name: self._alive.get(name, now) for name in names}

    def hear(self, topic: Topic, message: Stamped, published_ns: int, now: float) -> None:
        """A message of `WATCHED`; ``published_ns`` of wall time."""
        if isinstance(message, Health):
            if message.service not in self._pulses and len(self._pulses) >= MOST:
                return
            self._pulses[message.service] = (now, message)
            return
        if isinstance(message, Scan):
            self._scan_time = message.scan_time
        seen = self._published.setdefault(topic.name, {})
        first = message.stamp_ns not in seen
        seen.setdefault(message.stamp_ns, published_ns)
        while len(seen) > KEPT:
            del seen[next(iter(seen))]
        for service, (question, answer) in ANSWERS.items():
            asked = self._published.get(question.name, {}).get(message.stamp_ns)
            if answer is topic and asked is not None and first:
                kept = self._latencies.setdefault(service, deque(maxlen=KEPT))
                kept.append(max(0.0, (published_ns - asked) * 1e-6))

    def rows(self, now: float) -> list[Row]:
        """Those every session has, then the others by name."""
        known = [*NEEDED, *OPTIONAL]
        others = sorted((self._alive.keys() | self._pulses.keys()) - set(known))
        return [self._row(name, now) for name in (*known, *others)]

    def heard_of_all(self) -> bool:
        """Whether each that is there has sent a pulse."""
        return self._alive.keys() <= self._pulses.keys()

    def _row(self, name: str, now: float) -> Row:
        if name not in self._alive and name not in self._pulses:
            required = name in NEEDED and not replaced(name, self._alive)
            return Row(name, "missing" if required else "off", note=f"start it: {self.start_command(name)}")
        at, health = self._pulses.get(name, (None, None))
        if at is None or health is None:
            begins = now - self._alive[name] <= SILENT
            return Row(name, "begins" if begins else "silent", note="" if begins else "alive, but its pulse is missing")
        gone = name not in self._alive and now - at > BREATH
        state: State = "gone" if gone else "alive" if now - at <= SILENT else "silent"
        rates = [(row, rate) for row in health.topics if (rate := self._rate(row.key, row.rate)) is not None]
        stale = state != "alive"
        return Row(
            name, state, now - at, health.uptime,
            sends=tuple(rate for row, rate in rates if row.published and not stale),
            hears=tuple(rate for row, rate in rates if not row.published and not stale),
            dropped=sum(row.dropped for row in health.topics),
            undecodable=sum(row.undecodable for row in health.topics),
            failed=health.counters.get("failed", 0),
            latency_ms=None if stale or not (kept := self._latencies.get(name)) else median(kept),
            note=f"start it again: {self.start_command(name)}" if state == "gone" else health.note,
        )  # fmt: skip

    def _rate(self, key: str, hz: float) -> Rate | None:
        """Of a row of health; None where nothing is to be said of it."""
        topic = topic_of(key)
        if topic is None or topic is HEALTH or (not topic.rate and not hz):
            return None
        return Rate(topic.name, hz, expected_rate(topic, self._scan_time))

    def start_command(self, name: str) -> str:
        """What to type so that it comes."""
        robot = "" if self.robot == "robot" else f" --robot {self.robot}"
        connect = "" if self.connect == (DEFAULT_ENDPOINT,) else f" --connect {','.join(self.connect)}"
        return f"python -m services.{name}{robot}{connect}"
