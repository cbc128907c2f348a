"""Base class of a service: open, receive, step, publish, report health, end."""

from __future__ import annotations

import signal
import sys
from abc import ABC
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, TypeVar

from common.bus.bus import Bus, open_bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.log import Logger, begin_logging, logger, report_failure, set_up_logging
from common.messages.definitions import Stamped
from common.messages.requests import Reply, Request
from common.messages.topics import Query, Topic
from common.messages.wire import DecodeError
from common.runtime.config import ServiceSettings, load_settings
from common.runtime.runnable import Runnable
from common.runtime.service_loop import Loop

if TYPE_CHECKING:
    from types import FrameType

S = TypeVar("S", bound=ServiceSettings)


class Service(ABC):
    """A service's thin shell: what it hears, what it does then. Override what is needed."""

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]] = ()
    queries: ClassVar[tuple[Query, ...]] = ()
    keep_all: ClassVar[bool] = False  # every payload of every input, whatever the queue policy
    all_robots: ClassVar[bool] = False  # it hears more than its own robot
    single: ClassVar[bool] = False  # one instance leads; others wait until it is gone
    serves_latched: ClassVar[tuple[Topic, ...]] = ()  # kept topics it remembers for those who come later
    restores_latched: ClassVar[tuple[Topic, ...]] = ()  # kept topics whose last message it wants before anything else

    def __init__(self, settings: ServiceSettings) -> None:
        """Keep the settings; whatever may fail belongs in `open`."""
        self.settings = settings
        self.log: Logger = logger(self.name)
        self.counters: Counter[str] = Counter()  # shown in health
        self.note = ""  # shown in health
        self._loop: Loop | None = None

    @property
    def loop(self) -> Loop:
        """The running loop."""
        if self._loop is None:
            raise RuntimeError(f"{self.name} does not run")
        return self._loop

    def open(self) -> None:
        """Before the first message; raise UserError to end with one line."""

    def on_sample(self, sample: Sample) -> None:
        """A payload came; decoded and passed on unless a service wants the bytes."""
        try:
            message = sample.topic.message.decode(sample.payload)
        except DecodeError as error:
            self.loop.reject(sample.key, str(error))
            return
        self.on_message(sample.topic, message)

    def extra_counts(self, key: str) -> dict[str, int]:  # noqa: ARG002
        """More fields of this key's row in health."""
        return {}

    def on_message(self, topic: Topic, message: Stamped) -> None:
        """A valid message came."""

    def on_restored(self, last: dict[Topic, Stamped]) -> None:
        """What others remember of the topics it ``recalls``, once, before anything else comes."""

    def on_request(self, query: Query, request: Request) -> Reply:
        """A valid request came; the answer."""
        return Reply(ok=False, reason=f"{self.name} does not answer {query.name} ({type(request).__name__})")

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:
        """What `request` asked for, or ok false and why there is no answer; each request gets exactly one."""

    def due(self) -> float | None:
        """Seconds until `on_timer` is wanted; None: not."""
        return None

    def on_timer(self) -> None:
        """The time asked for in `due` has come."""

    def close(self) -> None:
        """After the last message."""

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Send a message with the next sequence number of its key."""
        self.loop.publish(topic, message)

    def make_loop(self, bus: Bus) -> Runnable:
        """What runs this service on a session."""
        return Loop(self, bus, Inbox())

    def request(self, query: Query, request: Request, timeout: float = 5.0) -> int:
        """Ask without waiting: the number under which `on_reply` is called, within ``timeout`` s or so."""
        return self.loop.request(query, request, timeout)


class _Ending:
    """Signal handler from the first moment on: a signal that comes before the loop ends it as it begins."""

    def __init__(self) -> None:
        self.asked = False
        self.loop: Runnable | None = None

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self.loop is not None:
            self.loop.stop()

    def run(self, loop: Runnable) -> None:
        self.loop = loop
        if self.asked:
            loop.stop()
        loop.run()


def main(settings_class: type[S], make: Callable[[S], Service], argv: list[str] | None = None) -> None:
    """Run a service as a process; ends it with status 0, or 2 and one line where the user can mend something."""
    ending = _Ending()
    signal.signal(signal.SIGTERM, ending)
    signal.signal(signal.SIGINT, ending)
    begin_logging(settings_class.service, argv)
    try:
        settings = load_settings(settings_class, argv)
        set_up_logging(
            settings.log_level, as_json=settings.log_json, service=settings_class.service, robot=settings.robot
        )
        service = make(settings)
        with open_bus(settings.link(), give_up=lambda: ending.asked) as bus:
            ending.run(service.make_loop(bus))
        service.log.info("ended")
    except UserError as error:
        report_failure(settings_class.service, error)
        sys.exit(2)
