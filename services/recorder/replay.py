"""Replay: a recording's bytes back on their keys, in their own time or another."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from common.bus import Bus, Link, open_bus
from common.errors import UserError
from common.topics import HEALTH, topic_of
from services.recorder.reader import Raw, read_recording

LISTENERS_WITHIN = 2.0  # s; a put before a subscriber is known is lost


def schedule(messages: Iterable[Raw], rate: float) -> Iterator[tuple[float, Raw]]:
    """Each message with the seconds after the first at which it is due; ``rate`` 0 or inf is as fast as it goes."""
    first: int | None = None
    for raw in messages:
        first = raw.logged_ns if first is None else first
        yield ((raw.logged_ns - first) * 1e-9 / rate if rate > 0 else 0.0), raw


def select(messages: list[Raw], only: set[str] | None) -> list[Raw]:
    """Messages of the topics named, or of all but health, a live service's pulse; UserError for an unknown name."""
    names = {raw.key: topic.name for raw in messages if (topic := topic_of(raw.key)) is not None}
    if only is not None and (unknown := only - set(names.values())):
        there = ", ".join(sorted(set(names.values()))) or "nothing"
        raise UserError(f"the recording has no {', '.join(sorted(unknown))}; it has {there}")
    wanted = only if only is not None else set(names.values()) - {HEALTH.name}
    return [raw for raw in messages if names.get(raw.key) in wanted]


def replay(
    path: Path,
    link: Link,
    *,
    only: set[str] | None = None,
    rate: float = 1.0,
    on_progress: Callable[[float], None] = lambda _: None,
    stop: threading.Event | None = None,
    opening: Callable[[Link], AbstractContextManager[Bus]] = open_bus,
) -> Counter[str]:
    """Publish the recording; counts by key. Waits shortly for somebody to listen, and warns of keys nobody wants.

    ``on_progress`` gets 0 to 1; ``opening`` makes the session, and may insist that somebody is there.
    """
    stop = stop or threading.Event()
    recording = read_recording(path)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    chosen = select(recording.raw, only)
    counts: Counter[str] = Counter()
    with opening(link) as bus:
        topics = {
            key: topic for key in dict.fromkeys(raw.key for raw in chosen) if (topic := topic_of(key)) is not None
        }
        for key, topic in topics.items():  # all before the first wait: each asks who listens
            bus.publisher(topic, key=key)
        deadline = time.monotonic() + LISTENERS_WITHIN
        unheard = [
            k for k, t in topics.items() if not bus.wait_matching(t, max(0.0, deadline - time.monotonic()), key=k)
        ]
        if unheard:
            print(f"warning: nobody listens to {', '.join(unheard)}", file=sys.stderr)
        began = time.monotonic()
        for number, (due, raw) in enumerate(schedule(chosen, rate)):
            if stop.wait(max(0.0, began + due - time.monotonic())):
                break
            bus.put(topics[raw.key], raw.payload, key=raw.key)
            counts[raw.key] += 1
            on_progress((number + 1) / len(chosen))
    return counts
