"""Counts received, written, dropped and lost messages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import msgpack

from common.messages.topics import topic_of

MAX_COUNT = 1 << 62  # counts saturate here, so that forged sequence numbers cannot overflow a message field
MAX_INSTANCES = 100  # per key, so that a sender with ever new instance names cannot fill the memory
MAX_INSTANCE_LENGTH = 200
MAX_REORDER_DISTANCE = 64  # a larger step back means that the publisher restarted, not that a message was late


@dataclass
class SequenceNumbers:
    """Counts gaps and restarts in the sequence numbers (0, 1, 2, ...) of one publisher on one key."""

    gaps: int = 0  # places where at least one number is missing
    missing: int = 0  # missing numbers
    restarts: int = 0  # times the publisher restarted
    reordered: int = 0  # numbers that came late or twice, or from a second publisher
    _next: int | None = None  # None before the first number: earlier messages do not count as missing

    def add(self, number: int) -> None:
        """Counts the next received number."""
        expected = number if self._next is None else self._next
        if number > expected:
            self.gaps += 1
            self.missing = min(MAX_COUNT, self.missing + number - expected)
        elif number < expected:
            if number and expected - number <= MAX_REORDER_DISTANCE:
                self.reordered += 1
                return
            self.restarts += 1
        self._next = number + 1


@dataclass
class KeyCounts:
    """Messages of one key, as stored in a recording's metadata `counters`."""

    received: int = 0  # by the recorder process
    written: int = 0  # to the file
    dropped: int = 0  # because the queue was full
    oversized: int = 0  # longer than the bus allows
    unreadable: int = 0  # written, but without a readable sequence number
    gaps: int = 0
    missing: int = 0  # published but never received
    restarts: int = 0
    reordered: int = 0


@dataclass
class MessageCounts:
    """Counts the messages of all keys."""

    written: dict[str, int] = field(default_factory=dict)
    unreadable: dict[str, int] = field(default_factory=dict)
    # By key and instance: several processes of one service publish under one key, each with its own numbers.
    sequences: dict[str, dict[str, SequenceNumbers]] = field(default_factory=dict)

    def add(self, key: str, payload: bytes) -> None:
        """Counts a payload that is written."""
        self.written[key] = self.written.get(key, 0) + 1
        numbered = sequence_of(payload)
        if numbered is None:
            self.unreadable[key] = self.unreadable.get(key, 0) + 1
        elif is_numbered(key):
            number, instance = numbered
            instances = self.sequences.setdefault(key, {})
            if instance not in instances and len(instances) >= MAX_INSTANCES:
                instance = ""
            instances.setdefault(instance, SequenceNumbers()).add(number)

    def sequence_totals(self, key: str) -> SequenceNumbers:
        """Gaps, missing messages and restarts of a key, summed over all instances."""
        total = SequenceNumbers()
        for sequence in self.sequences.get(key, {}).values():
            total.gaps += sequence.gaps
            total.missing = min(MAX_COUNT, total.missing + sequence.missing)
            total.restarts += sequence.restarts
            total.reordered += sequence.reordered
        return total

    def counts(
        self, received: Mapping[str, int], dropped: Mapping[str, int], oversized: Mapping[str, int]
    ) -> dict[str, KeyCounts]:
        """Counts by key, combined with the given counts of the receiving queue."""
        keys = sorted(set(received) | set(self.written))
        found = {}
        for key in keys:
            numbers = self.sequence_totals(key)
            found[key] = KeyCounts(
                received=received.get(key, 0),
                written=self.written.get(key, 0),
                dropped=dropped.get(key, 0),
                oversized=oversized.get(key, 0),
                unreadable=self.unreadable.get(key, 0),
                gaps=numbers.gaps,
                missing=numbers.missing,
                restarts=numbers.restarts,
                reordered=numbers.reordered,
            )
        return found


def as_metadata(counts: Mapping[str, KeyCounts]) -> dict[str, str]:
    """The metadata record `counters` at the end of a file: counts as JSON, by key."""
    return {key: json.dumps(asdict(count)) for key, count in counts.items()}


def from_metadata(record: Mapping[str, str]) -> dict[str, KeyCounts]:
    """Counts by key from a recording's metadata `counters`. Leaves out invalid entries."""
    found = {}
    for key, text in record.items():
        try:
            found[key] = KeyCounts(**json.loads(text))
        except (ValueError, TypeError):
            continue
    return found


def is_numbered(key: str) -> bool:
    """Whether messages of this key are numbered by one publisher. Topics such as `goal` have several publishers."""
    topic = topic_of(key)
    return topic is not None and (topic.per_service or not topic.multiple_publishers)


def sequence_of(payload: bytes) -> tuple[int, str] | None:
    """The message's `seq` and `instance`. Returns None if the payload is not a MessagePack map with a valid `seq`."""
    try:
        message = msgpack.unpackb(payload)
        number, instance = message.get("seq", 0), message.get("instance", "")
    except Exception:  # noqa: BLE001 - msgpack raises many error types on arbitrary bytes
        return None
    if not isinstance(number, int) or not 0 <= number < 1 << 63:
        return None
    return number, instance[:MAX_INSTANCE_LENGTH] if isinstance(instance, str) else ""
