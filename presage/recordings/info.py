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
from presage.recordings.service_drops import ServiceDrops
from services.recorder.files.message_counts import MessageCounts, from_metadata, is_numbered
from services.recorder.reader import Recording

MAX_CHECKED_BYTES = 64 << 20  # by default, files up to this size are checked, which takes a second or two


@dataclass
class TopicFacts:
    """Facts about one key; None for what was not counted."""

    key: str
    messages: int
    rate_hz: float | None = None
    bytes: int | None = None
    gaps: int | None = None  # places where sequence numbers are missing
    missing: int | None = None  # missing sequence numbers
    restarts: int | None = None  # of the publisher
    reordered: int | None = None
    dropped: int | None = None  # by the recorder, because its queue was full
    undecodable: int | None = None
    counters: dict[str, int] = field(default_factory=dict)  # counted by the recorder, from the metadata


@dataclass
class RecordingFacts:
    """Facts about a recording."""

    file: str
    file_bytes: int
    complete: bool
    checked: bool  # whether all payloads were read and all checksums verified
    warning: str
    robots: list[str]
    world: str | None
    started: str  # wall clock, UTC, ISO 8601
    duration_s: float
    messages: int
    topics: list[TopicFacts]
    versions: dict[str, str]
    metadata: dict[str, list[str]]  # names of the values in each record
    attachments: dict[str, int]  # size in bytes by name
    dropped_by_services: dict[str, int] | None  # messages during the recording, by "service key"; None if not checked

    def as_dict(self) -> dict[str, Any]:
        """The facts as values that JSON can hold."""
        return asdict(self) | {"missing": self.missing}

    @property
    def missing(self) -> int:
        """Number of messages that were sent but are not in the recording."""
        return sum((topic.missing or 0) + (topic.dropped or 0) for topic in self.topics)


class _PayloadCheck:
    """Reads all payloads of a recording and counts what is in them."""

    def __init__(self) -> None:
        self.message_counts = MessageCounts()
        self.bytes: Counter[str] = Counter()
        self.undecodable: Counter[str] = Counter()
        self.first: dict[str, int] = {}  # by key: time of the first message, ns of wall time
        self.last: dict[str, int] = {}
        self.drops = ServiceDrops()

    def read(self, recording: Recording) -> None:
        for raw in recording.payloads():
            self.message_counts.add(raw.key, raw.payload)
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
                self.drops.add(message)


def collect_facts(recording: Recording, check: bool | None = None) -> RecordingFacts:
    """Collects facts about a recording; ``check`` reads all of it, and defaults to True for small files."""
    size = recording.path.stat().st_size
    if check is None:
        check = size <= MAX_CHECKED_BYTES
    checked = None
    if check:
        checked = _PayloadCheck()
        checked.read(recording)
        recording.verify()
    about = recording.metadata.get("presage", {})
    world = recording.world()
    return RecordingFacts(
        file=str(recording.path),
        file_bytes=size,
        complete=recording.complete,
        checked=checked is not None,
        warning=recording.warning,
        robots=robots_of(recording) or ([about["robot"]] if "robot" in about else []),
        world=world.name if world else None,
        started=datetime.fromtimestamp(recording.start_ns * 1e-9, timezone.utc).isoformat(timespec="milliseconds"),
        duration_s=(recording.end_ns - recording.start_ns) * 1e-9,
        messages=recording.counts.total(),
        topics=_topic_facts(recording, checked),
        versions={name: text for name, text in about.items() if name not in {"robot", "command"}},
        metadata={name: list(record) for name, record in recording.metadata.items()},
        attachments={name: len(data) for name, data in recording.attachments.items()},
        dropped_by_services=None
        if checked is None
        else {f"{service} {key}": count for (service, key), count in checked.drops.counts().items()},
    )


def _topic_facts(recording: Recording, checked: _PayloadCheck | None) -> list[TopicFacts]:
    """Facts by key, from the recorder's counts and, if there was a check, from the payloads."""
    counters = from_metadata(recording.metadata.get("counters", {}))
    dropped = {key: int(n) for key, n in recording.metadata.get("dropped", {}).items() if n.isdecimal()}
    counts, duration = recording.counts, (recording.end_ns - recording.start_ns) * 1e-9
    found = []
    for key in sorted(set(counts) | set(counters)):
        facts = TopicFacts(key, counts[key], counts[key] / duration if duration > 0 else None)
        if (count := counters.get(key)) is not None:
            facts.counters = asdict(count)
            facts.gaps, facts.missing, facts.restarts = count.gaps, count.missing, count.restarts
            facts.reordered, facts.dropped = count.reordered, count.dropped
        elif "dropped" in recording.metadata:
            facts.dropped = dropped.get(key, 0)
        if checked is not None:
            _replace_by_checked(facts, checked)
        found.append(facts)
    return found


def _replace_by_checked(facts: TopicFacts, checked: _PayloadCheck) -> None:
    """Replaces the recorder's counts by those from the payloads."""
    key = facts.key
    facts.bytes, facts.undecodable = checked.bytes[key], checked.undecodable[key]
    span = (checked.last.get(key, 0) - checked.first.get(key, 0)) * 1e-9
    facts.rate_hz = (checked.message_counts.written[key] - 1) / span if span > 0 else None
    if is_numbered(key):
        numbers = checked.message_counts.sequence_totals(key)
        facts.gaps, facts.missing, facts.restarts = numbers.gaps, numbers.missing, numbers.restarts
        facts.reordered = numbers.reordered
