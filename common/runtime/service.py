"""Base class of a service, and the main function of its process."""

from __future__ import annotations

import signal
import sys
from abc import ABC
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, ClassVar, TypeVar

from common.bus.bus import Bus, open_bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.log import Logger, begin_logging, logger, report_failure, set_up_logging
from common.messages.definitions import Stamped
from common.messages.requests import Reply, Request
from common.messages.topics import Query, Topic
from common.messages.wire import DecodeError
from common.processes import interrupts_to_handle
from common.runtime.config import ServiceSettings, load_settings
from common.runtime.runnable import Runnable
from common.runtime.service_loop import ServiceLoop

if TYPE_CHECKING:
    from types import FrameType

S = TypeVar("S", bound=ServiceSettings)


class Service(ABC):
    """Base class of a service, which declares its inputs and handles their messages. Override the methods you need.

    All ``on_...`` methods are called from one thread, that of the loop.
    """

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]] = ()
    queries: ClassVar[tuple[Query, ...]] = ()
    keep_all: ClassVar[bool] = False  # queue every payload of every input, whatever the topic's queue policy
    all_robots: ClassVar[bool] = False  # subscribes to topics of other robots too
    single: ClassVar[bool] = False  # only one instance is active; others stand by until it is gone
    serves_latched: ClassVar[tuple[Topic, ...]] = ()  # latched topics whose last message it stores for late joiners
    restores_latched: ClassVar[tuple[Topic, ...]] = ()  # latched topics whose last message it needs at its start

    def __init__(self, settings: ServiceSettings) -> None:
        """Stores the settings. Anything that may fail belongs in `open`."""
        self.settings = settings
        self.log: Logger = logger(self.name)
        self.counters: Counter[str] = Counter()  # published in health
        self.note = ""  # published in health
        self.idle = False  # published in health: results are not expected now
        self._loop: ServiceLoop | None = None

    @property
    def loop(self) -> ServiceLoop:
        """The loop that runs this service; raises RuntimeError before it exists."""
        if self._loop is None:
            raise RuntimeError(f"service {self.name!r} is not running")
        return self._loop

    def open(self) -> None:
        """Prepares for the first message. Raise UserError to end the process with a one-line message."""

    def on_sample(self, sample: Sample) -> None:
        """Handles a received payload: by default decodes it and calls `on_message`. Override it to get the bytes."""
        try:
            message = sample.topic.message.decode(sample.payload)
        except DecodeError as error:
            self.loop.reject(sample.key, str(error))
            return
        self.on_message(sample.topic, message)

    def extra_counts(self, key: str) -> dict[str, int]:  # noqa: ARG002
        """Extra counters for the row of ``key`` in the health message."""
        return {}

    def on_message(self, topic: Topic, message: Stamped) -> None:
        """Handles a valid message of one of the inputs."""

    def on_restored(self, last: dict[Topic, Stamped]) -> None:
        """Handles the last messages of ``restores_latched``: called at most once, within 5 s of the start."""

    def on_request(self, query: Query, request: Request) -> Reply | Future[Reply]:
        """Handles a valid request and returns the reply, or its future if another thread does the work.

        A UserError becomes a reply with ok=False.
        """
        return Reply(ok=False, reason=f"{self.name} does not answer {query.name} ({type(request).__name__})")

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:
        """Handles the reply to a request: called once for each `send_request`, with ok=False if the request failed."""

    def due(self) -> float | None:
        """Seconds until `on_timer` is to be called, or None if no timer is set."""
        return None

    def on_timer(self) -> None:
        """Handles the timer: called when the time that `due` returned has passed."""

    def close(self) -> None:
        """Releases resources after the last message."""

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Publishes a message with the next sequence number of its key."""
        self.loop.publish(topic, message)

    def make_loop(self, bus: Bus) -> Runnable:
        """Creates the loop that runs this service on a session."""
        return ServiceLoop(self, bus, Inbox())

    def send_request(self, query: Query, request: Request, timeout: float = 5.0) -> int:
        """Sends a request without waiting.

        Returns the number with which `on_reply` is called, after about ``timeout`` s at the latest.
        """
        return self.loop.send_request(query, request, timeout)


class _SignalHandler:
    """Stops the loop at a signal. A signal that arrives before the loop exists stops it as soon as it starts."""

    def __init__(self) -> None:
        self.stop_requested = False
        self.loop: Runnable | None = None

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        self.stop_requested = True
        if self.loop is not None:
            self.loop.stop()

    def run(self, loop: Runnable) -> None:
        self.loop = loop
        if self.stop_requested:
            loop.stop()
        loop.run()


def main(settings_class: type[S], make: Callable[[S], Service], argv: list[str] | None = None) -> None:
    """Runs a service as a process until SIGTERM, Ctrl-C, or the end of its terminal.

    A UserError ends the process with status 2 and a one-line message.
    """
    handler = _SignalHandler()
    for number in interrupts_to_handle():
        signal.signal(number, handler)
    begin_logging(settings_class.service, argv)
    try:
        settings = load_settings(settings_class, argv)
        set_up_logging(
            settings.log_level, as_json=settings.log_json, service=settings_class.service, robot=settings.robot
        )
        service = make(settings)
        with open_bus(settings.link(), give_up=lambda: handler.stop_requested) as bus:
            handler.run(service.make_loop(bus))
        service.log.info("ended")
    except UserError as error:
        report_failure(settings_class.service, error)
        sys.exit(2)
