"""Counts received, written, dropped and lost messages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import msgpack

from common.messages.topics import topic_of

MAX_COUNT = 1 << 62  # a count that is larger, by numbers somebody made up, stays there: a message must hold it
MAX_INSTANCES = 100  # of a key; a sender that invents instances must not fill memory
MAX_INSTANCE_LENGTH = 200
MAX_REORDER_DISTANCE = 64  # a number so much below the last is a publisher that began anew, not a late message


@dataclass
class Sequence:
    """A publisher's numbers on one key, as they came: 0, 1, 2 and so on."""

    gaps: int = 0  # places where at least one number was left out
    missing: int = 0  # numbers left out
    restarts: int = 0  # times the publisher began anew
    reordered: int = 0  # numbers that came late or twice, or of a second publisher
    _next: int | None = None  # a recorder that came later has missed nothing it was there for

    def see(self, number: int) -> None:
        """The next one."""
        due = number if self._next is None else self._next
        if number > due:
            self.gaps += 1
            self.missing = min(MAX_COUNT, self.missing + number - due)
        elif number < due:
            if number and due - number <= MAX_REORDER_DISTANCE:
                self.reordered += 1
                return
            self.restarts += 1
        self._next = number + 1


@dataclass
class Count:
    """Of one key."""

    received: int = 0  # by the process, whatever became of it
    written: int = 0  # handed to the file
    dropped: int = 0  # the queue was full
    oversized: int = 0  # longer than the bus allows
    unreadable: int = 0  # written, though no MessagePack map with a sequence number
    gaps: int = 0
    missing: int = 0  # sent by the publisher and never received
    restarts: int = 0
    reordered: int = 0


@dataclass
class Ledger:
    """Counts of all keys."""

    written: dict[str, int] = field(default_factory=dict)
    unreadable: dict[str, int] = field(default_factory=dict)
    # By key and instance: two processes of one service publish under one key, each with numbers of its own.
    sequences: dict[str, dict[str, Sequence]] = field(default_factory=dict)

    def see(self, key: str, payload: bytes) -> None:
        """A payload that was written."""
        self.written[key] = self.written.get(key, 0) + 1
        numbered = sequence_of(payload)
        if numbered is None:
            self.unreadable[key] = self.unreadable.get(key, 0) + 1
        elif is_numbered(key):
            number, instance = numbered
            instances = self.sequences.setdefault(key, {})
            if instance not in instances and len(instances) >= MAX_INSTANCES:
                instance = ""
            instances.setdefault(instance, Sequence()).see(number)

    def lost(self, key: str) -> Sequence:
        """What a key's numbers say, of all instances together."""
        total = Sequence()
        for sequence in self.sequences.get(key, {}).values():
            total.gaps += sequence.gaps
            total.missing = min(MAX_COUNT, total.missing + sequence.missing)
            total.restarts += sequence.restarts
            total.reordered += sequence.reordered
        return total

    def counts(
        self, received: Mapping[str, int], dropped: Mapping[str, int], oversized: Mapping[str, int]
    ) -> dict[str, Count]:
        """By key, with what the queue before the file has counted."""
        keys = sorted(set(received) | set(self.written))
        found = {}
        for key in keys:
            numbers = self.lost(key)
            found[key] = Count(
                received.get(key, 0), self.written.get(key, 0), dropped.get(key, 0), oversized.get(key, 0),
                self.unreadable.get(key, 0), numbers.gaps, numbers.missing, numbers.restarts, numbers.reordered,
            )  # fmt: skip
        return found


def as_metadata(counts: Mapping[str, Count]) -> dict[str, str]:
    """The record `counters` at a file's end: JSON by key."""
    return {key: json.dumps(asdict(count)) for key, count in counts.items()}


def from_metadata(record: Mapping[str, str]) -> dict[str, Count]:
    """Of a recording's metadata `counters`; what is no count is left out."""
    found = {}
    for key, text in record.items():
        try:
            found[key] = Count(**json.loads(text))
        except (ValueError, TypeError):
            continue
    return found


def is_numbered(key: str) -> bool:
    """Whether one service publishes the key and counts its messages; a goal comes from whoever wishes."""
    topic = topic_of(key)
    return topic is not None and topic.rate > 0


def sequence_of(payload: bytes) -> tuple[int, str] | None:
    """The message's `seq` and `instance`; None where the payload is no MessagePack map that could have a `seq`."""
    try:
        message = msgpack.unpackb(payload)
        number, instance = message.get("seq", 0), message.get("instance", "")
    except Exception:  # noqa: BLE001 - msgpack raises many kinds, and the payload may be anything
        return None
    if not isinstance(number, int) or not 0 <= number < 1 << 63:
        return None
    return number, instance[:MAX_INSTANCE_LENGTH] if isinstance(instance, str) else ""
