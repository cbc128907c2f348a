"""Connected browsers and their send queues.

Everything runs in the web server's event loop; other threads use `Hub.call_soon`. A slow visitor does not delay others:
each visitor has its own queue, in which a new frame replaces the one that is still waiting.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable

MAX_QUEUED_TEXTS = 200  # a visitor with more waiting texts is disconnected


class TooSlowError(Exception):
    """A visitor does not read the messages sent to it."""


class Visitor:
    """One open page."""

    def __init__(
        self, send_text: Callable[[str], Awaitable[None]], send_bytes: Callable[[bytes], Awaitable[None]]
    ) -> None:
        """``send_text`` and ``send_bytes`` return when the connection has taken the data."""
        self.robot = ""
        self.live_robot = ""  # that was watched before a recording
        self.sent = self.skipped = 0  # frames
        self._send_text, self._send_bytes = send_text, send_bytes
        self._texts: OrderedDict[object, str | bytes] = OrderedDict()
        self._frame: bytes | None = None
        self._serial = itertools.count()
        self._wakeup = asyncio.Event()
        self._overrun = False

    def queue_text(self, text: str | bytes, kind: str = "") -> None:
        """Queues a message. It replaces a waiting message of the same non-empty ``kind``, at its position."""
        if len(self._texts) >= MAX_QUEUED_TEXTS:
            self._overrun = True
        else:
            self._texts[kind or next(self._serial)] = text
        self._wakeup.set()

    def queue_frame(self, frame: bytes) -> None:
        """Queues the newest frame. It replaces a frame that is still waiting."""
        self.skipped += self._frame is not None
        self._frame = frame
        self._wakeup.set()

    def drop_robot_data(self) -> None:
        """Removes the waiting frame and all messages with a kind, which belong to the previous robot."""
        self._frame = None
        for kind in [kind for kind in self._texts if isinstance(kind, str)]:
            del self._texts[kind]

    async def run(self) -> None:
        """Sends until cancelled. Raises TooSlowError if too many messages are waiting."""
        while True:
            await self._wakeup.wait()
            self._wakeup.clear()
            while self._texts or self._frame is not None:
                if self._overrun:
                    raise TooSlowError
                if self._texts:
                    text = self._texts.popitem(last=False)[1]
                    await (self._send_bytes(text) if isinstance(text, bytes) else self._send_text(text))
                elif (frame := self._frame) is not None:
                    self._frame = None
                    await self._send_bytes(frame)
                    self.sent += 1


class Hub:
    """All visitors, and the robots they watch."""

    def __init__(self, changed: Callable[[], None] = lambda: None) -> None:
        """``changed`` is called in the web server's loop when `newcomers` or `watched` changes."""
        self.counters: Counter[str] = Counter()
        self.watched: frozenset[str] = frozenset()  # robots; replaced as a whole, because other threads read it
        self.newcomers: deque[tuple[Visitor, str]] = deque()  # visitors who need the history of a robot
        self._visitors: set[Visitor] = set()
        self._changed = changed
        self._loop: asyncio.AbstractEventLoop | None = None

    def set_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        """Sets the web server's event loop."""
        self._loop = loop

    def call_soon(self, what: Callable[[], None]) -> None:
        """Calls a function in the event loop, from another thread. Does nothing while the loop is not running."""
        if self._loop is None:
            return
        try:
            self._loop.call_soon_threadsafe(what)
        except RuntimeError:  # the loop has just been closed
            self._loop = None

    def __len__(self) -> int:
        return len(self._visitors)

    def watching(self, robot: str) -> list[Visitor]:
        """Visitors who watch the robot."""
        return [visitor for visitor in self._visitors if visitor.robot == robot]

    def all_visitors(self) -> list[Visitor]:
        """All visitors."""
        return list(self._visitors)

    def watch(self, visitor: Visitor, robot: str) -> None:
        """Makes a visitor watch a robot."""
        self._visitors.add(visitor)
        visitor.drop_robot_data()
        visitor.robot = robot
        self.newcomers.append((visitor, robot))
        self._update_watched()

    def remove(self, visitor: Visitor) -> None:
        """Removes a visitor who has disconnected."""
        self._visitors.discard(visitor)
        self.counters["frames_sent"] += visitor.sent
        self.counters["frames_skipped"] += visitor.skipped
        self._update_watched()

    def queue_frame(self, robot: str, frame: bytes) -> None:
        """Queues a frame for all visitors who watch the robot."""
        for visitor in self._visitors:
            if visitor.robot == robot:
                visitor.queue_frame(frame)

    def queue_text(self, robot: str, kind: str, text: str | bytes) -> None:
        """Queues a message for all visitors who watch the robot."""
        for visitor in self.watching(robot):
            visitor.queue_text(text, kind)

    def _update_watched(self) -> None:
        self.watched = frozenset(visitor.robot for visitor in self._visitors)
        self._changed()
