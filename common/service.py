"""The loop every service runs, written once: open, receive, step, publish, health, end on SIGTERM or Ctrl-C."""

from __future__ import annotations

import json
import signal
import sys
import time
from abc import ABC
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from common.bus import Bus, open_bus
from common.config import ServiceSettings, load_settings
from common.errors import UserError
from common.inbox import Answer, Call, Inbox, Sample
from common.log import Logger, OncePerSecond, logger, set_up_logging
from common.messages import Health, Stamped, TopicHealth
from common.requests import ConfigReply, Reply, Request
from common.running import Runs
from common.topics import CONFIG, HEALTH, Query, Topic
from common.versions import versions
from common.wire import DecodeError

if TYPE_CHECKING:
    from types import FrameType

S = TypeVar("S", bound=ServiceSettings)
HEALTH_PERIOD = 1.0  # s


class Service(ABC):
    """A service's thin shell: what it hears, what it does then. Override what is needed."""

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]] = ()
    queries: ClassVar[tuple[Query, ...]] = ()
    keep_all: ClassVar[bool] = False  # every payload of every input, whatever the queue policy

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

    def counted(self, key: str) -> dict[str, int]:  # noqa: ARG002
        """More fields of this key's row in health."""
        return {}

    def on_message(self, topic: Topic, message: Stamped) -> None:
        """A valid message came."""

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

    def loop_on(self, bus: Bus) -> Runs:
        """What runs this service on a session."""
        return Loop(self, bus, Inbox())

    def request(self, query: Query, request: Request, timeout: float = 5.0) -> int:
        """Ask without waiting: the number under which `on_reply` is called, within ``timeout`` s or so."""
        return self.loop.request(query, request, timeout)


class Loop:
    """Runs one service on one session."""

    def __init__(self, service: Service, bus: Bus, inbox: Inbox) -> None:
        """Subscribe and serve; what arrives from now on waits in ``inbox``."""
        self.service, self.bus, self.inbox = service, bus, inbox
        self.published: Counter[str] = Counter()  # by key
        self.undecodable: Counter[str] = Counter()
        self.failed = 0
        self._asked = 0
        self._may_log = OncePerSecond()
        self._stopping = False
        self._began = self._health_at = self._counted_at = time.monotonic()
        self._before: Counter[str] = Counter()
        service._loop = self  # noqa: SLF001 - the two halves of one thing

    def run(self) -> None:
        """Until `stop`."""
        self.begin()
        try:
            while not self._stopping:
                self._turn()
        finally:
            self.service.close()

    def begin(self) -> None:
        """Open, subscribe, serve, and say that the service is there."""
        service, bus = self.service, self.bus
        service.open()
        for topic in service.inputs:
            bus.subscribe(topic, self.inbox, keep_all=service.keep_all)
        for query in service.queries:
            bus.serve(query, self.inbox)
        bus.serve(CONFIG, self.inbox, service.name)
        bus.declare_alive(service.name)
        service.log.info("ready", robot=bus.robot)

    def stop(self) -> None:
        """End after the current step; safe from a signal handler."""
        self._stopping = True
        self.inbox.wake()

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Send with the key's next sequence number."""
        key = topic.key(self.bus.robot, self.service.name)
        numbered = message.model_copy(update={"seq": self.published[key]})
        self.bus.put(topic, numbered.encode(), self.service.name)
        self.published[key] += 1

    def request(self, query: Query, request: Request, timeout: float) -> int:
        """Ask; the answer comes through the inbox like everything else."""
        self._asked += 1
        self.bus.request(query, request, self._asked, self.inbox, timeout)
        return self._asked

    def reject(self, key: str, why: str) -> None:
        """Count a payload that could not be used; say so once a second at most."""
        name = self.inbox.counted_as(key)
        self.undecodable[name] += 1
        if self._may_log(name):
            self.service.log.warning("payload dropped", key=key, why=why, so_far=self.undecodable[name])

    def _turn(self) -> None:
        due = self.service.due()
        until_health = self._health_at - time.monotonic()
        self.handle(self.inbox.get(max(0.0, min(until_health, 0.5 if due is None else due))))
        due = self.service.due()
        if due is not None and due <= 0:
            self.guard(self.service.on_timer)
        self.pulse()

    def handle(self, event: Sample | Call | Answer | None) -> None:
        """What one entry of the inbox asks for."""
        if isinstance(event, Sample):
            self.guard(lambda: self.service.on_sample(event))
        elif isinstance(event, Call):
            self._answer(event)
        elif isinstance(event, Answer):
            self.guard(lambda: self.service.on_reply(event.query, event.number, event.reply()))

    def pulse(self) -> None:
        """Health, once a second."""
        if (now := time.monotonic()) >= self._health_at:
            late = now - self._health_at > HEALTH_PERIOD  # after a long step one pulse, not all that were missed
            self._health_at = (now if late else self._health_at) + HEALTH_PERIOD
            self.publish(HEALTH, self._health(now))

    def guard(self, step: Callable[[], None]) -> None:
        """No input stops a service: what a step raises is counted and logged with its traceback."""
        try:
            step()
        except UserError:
            raise
        except Exception:
            self.failed += 1
            if self._may_log("failed"):
                self.service.log.exception("step failed", so_far=self.failed)

    def _answer(self, call: Call) -> None:
        try:
            request = call.query.request.decode(call.payload)
        except DecodeError as error:
            self.reject(call.query.name, str(error))
            call.refuse(str(error))
            return
        try:
            reply = self._config() if call.query is CONFIG else self.service.on_request(call.query, request)
        except UserError as error:
            reply = call.query.reply(ok=False, reason=str(error))
        except Exception as error:
            self.failed += 1
            self.service.log.exception("request failed", query=call.query.name)
            call.refuse(f"{self.service.name} failed: {type(error).__name__}: {error}")
            return
        call.reply(reply.encode())

    def _config(self) -> ConfigReply:
        config = json.dumps(self.service.settings.effective())
        return ConfigReply(service=self.service.name, config=config, versions=versions())

    def _health(self, now: float) -> Health:
        inbox, total = self.inbox, Counter[str]()
        total.update(dict(inbox.received))  # a copy: zenoh's threads go on counting
        total.update(self.published)
        elapsed, self._counted_at = max(now - self._counted_at, 1e-3), now
        rows = [
            TopicHealth(
                key=key[:200],
                received=inbox.received[key],
                published=self.published[key],
                dropped=inbox.dropped[key],
                undecodable=self.undecodable[key] + inbox.oversized[key],
                rate=max(0, total[key] - self._before[key]) / elapsed,
                **self.service.counted(key),
            )
            for key in sorted(total)[:200]
        ]
        self._before = total
        counters: dict[str, int] = {**self.service.counters, "failed": self.failed}
        return Health(
            stamp_ns=time.time_ns(),
            service=self.service.name,
            uptime=now - self._began,
            topics=rows,
            counters=counters,
            note=self.service.note,
        )


class _Ending:
    """Signal handler from the first moment on: a signal that comes before the loop ends it as it begins."""

    def __init__(self) -> None:
        self.asked = False
        self.loop: Runs | None = None

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self.loop is not None:
            self.loop.stop()

    def run(self, loop: Runs) -> None:
        self.loop = loop
        if self.asked:
            loop.stop()
        loop.run()


def main(settings_class: type[S], make: Callable[[S], Service], argv: list[str] | None = None) -> None:
    """Run a service as a process; ends it with status 0, or 2 and one line where the user can mend something."""
    ending = _Ending()
    signal.signal(signal.SIGTERM, ending)
    signal.signal(signal.SIGINT, ending)
    try:
        settings = load_settings(settings_class, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json)
        service = make(settings)
        with open_bus(settings.link()) as bus:
            ending.run(service.loop_on(bus))
        service.log.info("ended")
    except UserError as error:
        sys.exit(_fail(settings_class.service, error))


def _fail(service: str, error: Any) -> int:
    print(f"{service}: {error}", file=sys.stderr)
    return 2
