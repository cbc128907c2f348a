"""`presage info`: contents and completeness."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from typing import Any

from common.messages.definitions import Health
from common.messages.topics import topic_of
from common.messages.wire import DecodeError
from presage.recordings.selection import robots_of
from services.recorder.files.message_counts import Ledger, from_metadata, is_numbered
from services.recorder.reader import Recording

SMALL = 64 << 20  # bytes; up to here a file is read through unasked: a second or two


@dataclass
class TopicFacts:
    """Of one key; None where it was not counted."""

    key: str
    messages: int
    rate_hz: float | None = None
    bytes: int | None = None
    gaps: int | None = None  # places where the publisher's numbers jump
    missing: int | None = None  # numbers that were left out
    restarts: int | None = None  # of the publisher
    reordered: int | None = None
    dropped: int | None = None  # by the recorder, whose queue was full
    undecodable: int | None = None
    counters: dict[str, int] = field(default_factory=dict)  # the recorder's own, as it wrote them at the end


@dataclass
class Facts:
    """Of a file."""

    file: str
    file_bytes: int
    complete: bool
    checked: bool  # every payload was read, and every checksum compared as far as the file is whole
    warning: str
    robots: list[str]
    world: str | None
    started: str  # wall clock, UTC, ISO 8601
    duration_s: float
    messages: int
    topics: list[TopicFacts]
    versions: dict[str, str]
    metadata: dict[str, list[str]]  # the names in each record
    attachments: dict[str, int]  # bytes
    dropped_by_services: dict[str, int] | None  # "service key": by their last counts; None: not looked at

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"missing": self.missing}

    @property
    def missing(self) -> int:
        """Messages that were sent and are not in it: by the publishers' numbers, or dropped by the recorder."""
        return sum((topic.missing or 0) + (topic.dropped or 0) for topic in self.topics)


class _Pass:
    """One reading of all payloads."""

    def __init__(self) -> None:
        self.ledger = Ledger()
        self.bytes: Counter[str] = Counter()
        self.undecodable: Counter[str] = Counter()
        self.first: dict[str, int] = {}  # ns, wall clock
        self.last: dict[str, int] = {}
        self.healths: dict[tuple[str, str], Health] = {}  # by service and instance, the last

    def read(self, recording: Recording) -> None:
        for raw in recording.payloads():
            self.ledger.see(raw.key, raw.payload)
            self.bytes[raw.key] += len(raw.payload)
            self.first.setdefault(raw.key, raw.logged_ns)
            self.last[raw.key] = raw.logged_ns
            topic = topic_of(raw.key)
            if topic is None:
                continue
            try:
                message = topic.message.decode(raw.payload)
            except DecodeError:
                self.undecodable[raw.key] += 1
                continue
            if isinstance(message, Health):
                self.healths[message.service, message.instance] = message

    def dropped(self) -> dict[str, int]:
        """What services received and did not use, by their last counts."""
        dropped = Counter[str]()
        for health in self.healths.values():
            for row in health.topics:
                dropped[f"{health.service} {row.key}"] += row.dropped
        return dict(+dropped)


def survey(recording: Recording, check: bool | None = None) -> Facts:
    """Facts of a recording; ``check`` reads all of it (None: where that is soon done)."""
    size = recording.path.stat().st_size
    seen = None
    if check if check is not None else size <= SMALL:
        seen = _Pass()
        seen.read(recording)
        recording.verify()
    about = recording.metadata.get("presage", {})
    world = recording.world()
    return Facts(
        file=str(recording.path),
        file_bytes=size,
        complete=recording.complete,
        checked=seen is not None,
        warning=recording.warning,
        robots=robots_of(recording) or ([about["robot"]] if "robot" in about else []),
        world=world.name if world else None,
        started=datetime.fromtimestamp(recording.start_ns * 1e-9, timezone.utc).isoformat(timespec="milliseconds"),
        duration_s=(recording.end_ns - recording.start_ns) * 1e-9,
        messages=recording.counts().total(),
        topics=_topics(recording, seen),
        versions={name: text for name, text in about.items() if name not in {"robot", "command"}},
        metadata={name: list(record) for name, record in recording.metadata.items()},
        attachments={name: len(data) for name, data in recording.attachments.items()},
        dropped_by_services=None if seen is None else seen.dropped(),
    )


def _topics(recording: Recording, seen: _Pass | None) -> list[TopicFacts]:
    """By key, with what the recorder counted and what was counted now."""
    counters = from_metadata(recording.metadata.get("counters", {}))
    dropped = {key: int(n) for key, n in recording.metadata.get("dropped", {}).items() if n.isdecimal()}
    counts, duration = recording.counts(), (recording.end_ns - recording.start_ns) * 1e-9
    found = []
    for key in sorted(set(counts) | set(counters)):
        facts = TopicFacts(key, counts[key], counts[key] / duration if duration > 0 else None)
        if (count := counters.get(key)) is not None:
            facts.counters = asdict(count)
            facts.gaps, facts.missing, facts.restarts = count.gaps, count.missing, count.restarts
            facts.reordered, facts.dropped = count.reordered, count.dropped
        elif "dropped" in recording.metadata:
            facts.dropped = dropped.get(key, 0)
        if seen is not None:
            _checked(facts, seen)
        found.append(facts)
    return found


def _checked(facts: TopicFacts, seen: _Pass) -> None:
    """What the payloads themselves say goes before what the recorder wrote."""
    key = facts.key
    facts.bytes, facts.undecodable = seen.bytes[key], seen.undecodable[key]
    span = (seen.last.get(key, 0) - seen.first.get(key, 0)) * 1e-9
    facts.rate_hz = (seen.ledger.written[key] - 1) / span if span > 0 else None
    if is_numbered(key):
        numbers = seen.ledger.lost(key)
        facts.gaps, facts.missing, facts.restarts = numbers.gaps, numbers.missing, numbers.restarts
        facts.reordered = numbers.reordered
