"""Queue between zenoh's threads and a service's loop, with a drop policy for each topic."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

from common.messages.requests import Reply
from common.messages.topics import MAX_BYTES, Query, Topic
from common.messages.wire import DecodeError

MAX_KEYS = 1000  # counted by name; a sender that invents keys must not fill memory
OTHERS = "others"  # what the rest is counted under


@dataclass(frozen=True)
class Sample:
    """One payload as it came."""

    topic: Topic
    key: str
    payload: bytes
    published_ns: int  # wall time at the publisher, 0 if unknown
    received_ns: int  # wall time here
    source: str = ""  # zenoh session that published it; empty if unknown


@dataclass(frozen=True)
class Call:
    """One request as it came; exactly one of the two answers is owed."""

    query: Query
    payload: bytes
    reply: Callable[[bytes], None]
    refuse: Callable[[str], None]


@dataclass(frozen=True)
class Answer:
    """What became of a request of ours: an answer as it came, or why there is none."""

    query: Query
    number: int  # of the request
    payload: bytes
    refusal: str = ""  # why there is no payload
    who: str = ""  # the session that answered, where each was asked

    def reply(self) -> Reply:
        """The answer decoded; where there is none that makes sense, one with ok false that says why."""
        if self.refusal:
            return self.query.reply(ok=False, reason=self.refusal)
        try:
            return self.query.reply.decode(self.payload)
        except DecodeError as error:
            return self.query.reply(ok=False, reason=f"the answer makes no sense: {error}")


class Inbox:
    """A bounded queue in which a newest-only key takes one place, and every drop is counted."""

    def __init__(
        self, capacity: int = 10_000, max_bytes: int = 1 << 28, changed: threading.Condition | None = None
    ) -> None:
        """Hold at most ``capacity`` entries and ``max_bytes`` bytes of payload.

        ``changed`` is notified of each entry: one for several inboxes lets one loop wait for all of them.
        """
        self.capacity, self.max_bytes = capacity, max_bytes
        self.received: Counter[str] = Counter()  # by key
        self.dropped: Counter[str] = Counter()
        self.oversized: Counter[str] = Counter()
        self._entries: OrderedDict[object, Sample | Call | Answer] = OrderedDict()
        self._bytes = 0
        self._serial = 0
        self._counted: set[str] = set()
        lock = threading.RLock()  # reentrant: a signal handler may wake us inside wait
        self._changed = changed or threading.Condition(lock)
        # Not entered through the condition: Ctrl-C in its __enter__, which is Python, would leave it locked for ever.
        self._lock = changed or lock

    def put(self, entry: Sample | Call | Answer, *, newest_only: bool = False) -> None:
        """Add an entry; where a newest-only key still waits, the new one takes the old one's place."""
        size = len(entry.payload)
        full_key = entry.key if isinstance(entry, Sample) else entry.query.name
        with self._lock:
            key = self.counted_as(full_key)
            self.received[key] += 1
            if size > (MAX_BYTES if isinstance(entry, Sample) else 64 * MAX_BYTES):
                self.oversized[key] += 1
                if isinstance(entry, Call):
                    entry.refuse(f"{size} bytes are too many")
                if not isinstance(entry, Answer):
                    return
                entry, size = replace(entry, payload=b"", refusal=f"the answer's {size} bytes are too many"), 0
            self._serial += 1
            # Of each source: nobody's newest takes the place of somebody else's.
            slot: object = (full_key, entry.source) if newest_only and isinstance(entry, Sample) else self._serial
            old = self._entries.get(slot)
            if old is not None:
                self._bytes -= len(old.payload)
                self.dropped[key] += 1
            elif not isinstance(entry, Answer) and (  # of those come no more than were asked for
                len(self._entries) >= self.capacity or self._bytes + size > self.max_bytes
            ):
                self.dropped[key] += 1
                if isinstance(entry, Call):
                    entry.refuse("too many requests wait")
                return
            self._entries[slot] = entry
            self._bytes += size
            self._changed.notify()

    def counted_as(self, key: str) -> str:
        """The name a key is counted under: its own, or `OTHERS` when there are too many."""
        if key not in self._counted and len(self._counted) >= MAX_KEYS:
            return OTHERS
        self._counted.add(key)
        return key

    def tally(self) -> tuple[Counter[str], Counter[str], Counter[str]]:
        """By key and as of one moment: received and no longer waiting, dropped, oversized."""
        with self._lock:
            taken = self.received.copy()
            taken.subtract(self.counted_as(entry.key) for entry in self._entries.values() if isinstance(entry, Sample))
            return taken, self.dropped.copy(), self.oversized.copy()

    def arrivals(self) -> tuple[Counter[str], Counter[str], Counter[str]]:
        """By key and as of one moment: received, those that wait included, dropped, oversized."""
        with self._lock:
            return self.received.copy(), self.dropped.copy(), self.oversized.copy()

    def get(self, timeout: float) -> Sample | Call | Answer | None:
        """The oldest entry, waiting at most ``timeout`` s for one; None when none came."""
        with self._lock:
            if not self._entries and timeout > 0:
                self._changed.wait(timeout)
            if not self._entries:
                return None
            _, entry = self._entries.popitem(last=False)
            self._bytes -= len(entry.payload)
            return entry

    def wake(self) -> None:
        """End a wait early."""
        with self._lock:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._entries)
