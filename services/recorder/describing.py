"""Asks each service that appears what it is: its configuration, and the simulator its world. In a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator

from common.bus import Bus
from common.errors import UserError
from common.log import Logger
from common.messages import ConfigReply, Request, WorldReply
from common.topics import CONFIG, WORLD

TIMEOUT = 2.0  # s, for one answer
RETRY = 5.0  # s, until one that did not answer is asked again
ATTEMPTS = 5

Answer = ConfigReply | WorldReply


class Describer:
    """Answers wait in a queue, so that recording goes on while a service is slow or silent."""

    def __init__(self, bus: Bus, me: str, log: Logger) -> None:
        """Begin to watch; ``me`` is not asked."""
        self._bus, self._me, self._log = bus, me, log
        self._seen: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()  # from zenoh's thread
        self._answers: queue.SimpleQueue[tuple[str, Answer]] = queue.SimpleQueue()
        self._waiting: dict[str, tuple[float, int]] = {}  # service: when to ask, attempts before
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="describer", daemon=True)
        self._thread.start()
        bus.watch_alive(lambda service, there: self._seen.put((service, there)))

    def answers(self) -> Iterator[tuple[str, Answer]]:
        """Service and answer, of those that came since the last call."""
        while True:
            try:
                yield self._answers.get_nowait()
            except queue.Empty:
                return

    def stop(self) -> None:
        """Ask nobody any more; an answer under way may still come."""
        self._stopping.set()
        self._seen.put(None)

    def join(self) -> None:
        """After `stop`: wait for the thread, which ends within the time-out of an answer."""
        self._thread.join(TIMEOUT + 1.0)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._hear()
            for service, (due, attempts) in list(self._waiting.items()):
                if due > time.monotonic() or self._stopping.is_set():
                    continue
                del self._waiting[service]
                if not self._ask(service) and attempts + 1 < ATTEMPTS:
                    self._waiting[service] = (time.monotonic() + RETRY, attempts + 1)

    def _hear(self) -> None:
        """Wait for a service to come or go, or for the next to be asked."""
        due = min((due for due, _ in self._waiting.values()), default=None)
        try:
            seen = self._seen.get(timeout=None if due is None else max(0.0, due - time.monotonic()))
        except queue.Empty:
            return
        if seen is None or seen[0] == self._me:
            return
        service, there = seen
        if there:
            self._waiting[service] = (time.monotonic(), 0)
        else:
            self._waiting.pop(service, None)

    def _ask(self, service: str) -> bool:
        try:
            reply = self._bus.ask(CONFIG, Request(), ConfigReply, timeout=TIMEOUT, service=service)
            self._answers.put((service, reply))
            if service == WORLD.server:
                self._answers.put((service, self._bus.ask(WORLD, Request(), WorldReply, timeout=TIMEOUT)))
        except UserError as error:
            if not self._stopping.is_set():
                self._log.warning("a service did not describe itself", service=service, why=str(error))
            return False
        return True
