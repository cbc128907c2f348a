"""Connected browsers and their send queues.

All of it runs in the web server's loop; other threads come in through `Hub.call_soon`. Nobody waits for anybody: a frame is
offered to all, and whoever has not taken the last one misses it.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable

MAX_QUEUED_TEXTS = 200  # texts for one visitor; who lets more wait is sent away


class TooSlowError(Exception):
    """A visitor who does not take what it is told."""


class Visitor:
    """One open page."""

    def __init__(self, text: Callable[[str], Awaitable[None]], data: Callable[[bytes], Awaitable[None]]) -> None:
        """``text`` and ``data`` send, and take as long as the visitor does."""
        self.robot = ""
        self.sent = self.skipped = 0  # frames
        self._text, self._data = text, data
        self._texts: OrderedDict[object, str | bytes] = OrderedDict()
        self._frame: bytes | None = None
        self._serial = itertools.count()
        self._something = asyncio.Event()
        self._overrun = False

    def queue_text(self, text: str | bytes, kind: str = "") -> None:
        """Something to be sent; what still waits of the same ``kind`` is replaced, in its place."""
        if len(self._texts) >= MAX_QUEUED_TEXTS:
            self._overrun = True
        else:
            self._texts[kind or next(self._serial)] = text
        self._something.set()

    def queue_frame(self, frame: bytes) -> None:
        """The newest frame; one that still waits is gone."""
        self.skipped += self._frame is not None
        self._frame = frame
        self._something.set()

    def drop_robot_data(self) -> None:
        """Frames and news of another robot."""
        self._frame = None
        for kind in [kind for kind in self._texts if isinstance(kind, str)]:
            del self._texts[kind]

    async def run(self) -> None:
        """Send until cancelled; raises TooSlowError where too much waits."""
        while True:
            await self._something.wait()
            self._something.clear()
            while self._texts or self._frame is not None:
                if self._overrun:
                    raise TooSlowError
                if self._texts:
                    said = self._texts.popitem(last=False)[1]
                    await (self._data(said) if isinstance(said, bytes) else self._text(said))
                elif (frame := self._frame) is not None:
                    self._frame = None
                    await self._data(frame)
                    self.sent += 1


class Hub:
    """Visitors by the robot they watch."""

    def __init__(self, changed: Callable[[], None] = lambda: None) -> None:
        """``changed`` is called, in the web server's loop, when `newcomers` or `watched` did."""
        self.counters: Counter[str] = Counter()
        self.watched: frozenset[str] = frozenset()  # robots; replaced as a whole, for readers in other threads
        self.newcomers: deque[tuple[Visitor, str]] = deque()  # who wants to be told what has been
        self._visitors: set[Visitor] = set()
        self._changed = changed
        self._loop: asyncio.AbstractEventLoop | None = None

    def set_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        """The loop of the web server."""
        self._loop = loop

    def call_soon(self, what: Callable[[], None]) -> None:
        """From another thread: do it in the loop, soon. Nothing happens before it runs and after it ended."""
        if self._loop is None:
            return
        try:
            self._loop.call_soon_threadsafe(what)
        except RuntimeError:  # it has just been closed
            self._loop = None

    def __len__(self) -> int:
        return len(self._visitors)

    def watching(self, robot: str) -> list[Visitor]:
        """Who watches it."""
        return [visitor for visitor in self._visitors if visitor.robot == robot]

    def all_visitors(self) -> list[Visitor]:
        """All visitors."""
        return list(self._visitors)

    def watch(self, visitor: Visitor, robot: str) -> None:
        """From now on that robot."""
        self._visitors.add(visitor)
        visitor.drop_robot_data()
        visitor.robot = robot
        self.newcomers.append((visitor, robot))
        self._count()

    def remove(self, visitor: Visitor) -> None:
        """It is gone."""
        self._visitors.discard(visitor)
        self.counters["frames_sent"] += visitor.sent
        self.counters["frames_skipped"] += visitor.skipped
        self._count()

    def queue_frame(self, robot: str, frame: bytes) -> None:
        """To all who watch the robot."""
        for visitor in self._visitors:
            if visitor.robot == robot:
                visitor.queue_frame(frame)

    def queue_text(self, robot: str, kind: str, text: str | bytes) -> None:
        """To all who watch the robot."""
        for visitor in self.watching(robot):
            visitor.queue_text(text, kind)

    def _count(self) -> None:
        self.watched = frozenset(visitor.robot for visitor in self._visitors)
        self._changed()
