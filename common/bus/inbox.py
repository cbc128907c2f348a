"""Queue between zenoh's threads and a service's loop, with a drop policy for each topic."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

from common.messages.requests import Reply
from common.messages.topics import MAX_BYTES, MAX_REQUEST_BYTES, Query, Topic
from common.messages.wire import DecodeError

MAX_KEYS = 1000  # keys with counters of their own, so that a sender that invents keys cannot fill memory
OTHERS = "others"  # counter of all further keys


@dataclass(frozen=True)
class Sample:
    """A received payload, not yet decoded."""

    topic: Topic
    key: str
    payload: bytes
    published_ns: int  # wall time at the publisher, 0 if unknown
    received_ns: int  # monotonic time here
    source: str = ""  # zenoh session that published it; empty if unknown


@dataclass(frozen=True)
class IncomingRequest:
    """A received request, not yet decoded. The receiver has to call exactly one of ``reply`` and ``refuse``."""

    query: Query
    payload: bytes
    reply: Callable[[bytes], None]
    refuse: Callable[[str], None]  # with the reason


@dataclass(frozen=True)
class RequestResult:
    """The result of a request that this process sent: a reply, not yet decoded, or the reason for its absence."""

    query: Query
    number: int  # of the request
    payload: bytes
    refusal: str = ""  # the reason if there is no reply
    session: str = ""  # the zenoh session that replied, set by `Bus.query_all`

    def reply(self) -> Reply:
        """The decoded reply; one with ok=False and the reason if there is none or it cannot be decoded."""
        if self.refusal:
            return self.query.reply(ok=False, reason=self.refusal)
        try:
            return self.query.reply.decode(self.payload)
        except DecodeError as error:
            return self.query.reply(ok=False, reason=f"the reply cannot be decoded: {error}")


def is_message_counter(name: str) -> bool:
    """Whether a counter of an inbox counts messages: its name is a key, or `OTHERS`. Requests have the query's name."""
    return "/" in name or name == OTHERS


class Inbox:
    """A bounded, thread-safe queue that counts every dropped entry.

    It holds at most one sample of each source for a topic with the queue policy "newest".
    """

    def __init__(
        self, capacity: int = 10_000, max_bytes: int = 1 << 28, changed: threading.Condition | None = None
    ) -> None:
        """Holds at most ``capacity`` entries and ``max_bytes`` bytes of payload.

        ``changed`` is notified of each new entry; several inboxes may share it, so that one loop can wait for all.
        """
        self.capacity, self.max_bytes = capacity, max_bytes
        self.received: Counter[str] = Counter()  # these three by `counter_name`
        self.dropped: Counter[str] = Counter()
        self.oversized: Counter[str] = Counter()
        self._entries: OrderedDict[object, Sample | IncomingRequest | RequestResult] = OrderedDict()
        self._bytes = 0
        self._serial = 0
        self._counted_keys: set[str] = set()
        lock = threading.RLock()  # reentrant, because a signal handler may call `wake` while this thread waits
        self._changed = changed or threading.Condition(lock)
        # Lock with this and not with the condition: its __enter__ is Python code, and Ctrl-C inside it would leave the
        # lock taken for ever.
        self._lock = changed or lock

    def put(self, entry: Sample | IncomingRequest | RequestResult, *, newest_only: bool = False) -> None:
        """Adds an entry. With ``newest_only``, it replaces a waiting sample of the same key and source.

        Entries that are too large or do not fit are dropped and counted; dropped requests are refused.
        """
        size = len(entry.payload)
        key = entry.key if isinstance(entry, Sample) else entry.query.name
        with self._lock:
            counter = self.counter_name(key)
            self.received[counter] += 1
            if size > (MAX_BYTES if isinstance(entry, Sample) else MAX_REQUEST_BYTES):
                self.oversized[counter] += 1
                if isinstance(entry, IncomingRequest):
                    entry.refuse(f"the request of {size} bytes is too large")
                if not isinstance(entry, RequestResult):
                    return
                entry, size = replace(entry, payload=b"", refusal=f"the reply of {size} bytes is too large"), 0
            self._serial += 1
            # One slot for each source, so that a source never replaces the sample of another.
            slot: object = (key, entry.source) if newest_only and isinstance(entry, Sample) else self._serial
            replaced = self._entries.get(slot)
            full = len(self._entries) >= self.capacity or self._bytes + size > self.max_bytes
            if replaced is not None:
                self._bytes -= len(replaced.payload)
                self.dropped[counter] += 1
            elif full and not isinstance(entry, RequestResult):  # always kept: there are no more results than requests
                self.dropped[counter] += 1
                if isinstance(entry, IncomingRequest):
                    entry.refuse("too many requests are waiting")
                return
            self._entries[slot] = entry
            self._bytes += size
            self._changed.notify()

    def counter_name(self, key: str) -> str:
        """Name of the counter of a key: the key itself, or `OTHERS` if there are too many keys."""
        if key not in self._counted_keys and len(self._counted_keys) >= MAX_KEYS:
            return OTHERS
        self._counted_keys.add(key)
        return key

    def received_counts(self) -> tuple[Counter[str], Counter[str], Counter[str]]:
        """Counts of entries that were received, dropped and oversized, by `counter_name`, all at one moment."""
        with self._lock:
            return self.received.copy(), self.dropped.copy(), self.oversized.copy()

    def handled_counts(self) -> tuple[Counter[str], Counter[str], Counter[str]]:
        """Like `received_counts`, but samples that still wait in the queue do not count as received."""
        with self._lock:
            received, dropped, oversized = self.received_counts()
            received.subtract(
                self.counter_name(entry.key) for entry in self._entries.values() if isinstance(entry, Sample)
            )
            return received, dropped, oversized

    def get(self, timeout: float) -> Sample | IncomingRequest | RequestResult | None:
        """Takes the oldest entry, waiting at most ``timeout`` s for one; returns None if there is none."""
        with self._lock:
            if not self._entries and timeout > 0:
                self._changed.wait(timeout)
            if not self._entries:
                return None
            _, entry = self._entries.popitem(last=False)
            self._bytes -= len(entry.payload)
            return entry

    def wake(self) -> None:
        """Makes a waiting `get` return."""
        with self._lock:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._entries)
