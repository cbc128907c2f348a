"""The loop every service runs, written once: open, receive, step, publish, health, end on SIGTERM or Ctrl-C."""

from __future__ import annotations

import json
import signal
import sys
import time
from abc import ABC
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, ClassVar, TypeVar

from common.bus import Bus, open_bus, wait_until
from common.compatibility import Compatibility, this_service
from common.config import ServiceSettings, load_settings
from common.errors import UserError
from common.heartbeat import Heartbeat
from common.inbox import Answer, Call, Inbox, Sample
from common.instances import Instances, OneSource, spoken
from common.log import Logger, OncePerSecond, begin_logging, logger, say_failure, set_up_logging
from common.messages import Health, Stamped, TopicHealth
from common.requests import ConfigReply, Reply, Request
from common.topics import CONFIG, HEALTH, Query, Topic
from common.wire import DecodeError

if TYPE_CHECKING:
    from types import FrameType

    from common.metrics import ServiceMetrics

S = TypeVar("S", bound=ServiceSettings)
HEALTH_PERIOD = 1.0  # s
LINKED_WITHIN = 0.5  # s that a service waits for its first link before it looks who else is there
SOURCE_SILENT = 0.3  # s after which another source of a topic is heard


class Service(ABC):
    """A service's thin shell: what it hears, what it does then. Override what is needed."""

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]] = ()
    queries: ClassVar[tuple[Query, ...]] = ()
    keep_all: ClassVar[bool] = False  # every payload of every input, whatever the queue policy
    all_robots: ClassVar[bool] = False  # it hears more than its own robot
    single: ClassVar[bool] = False  # one instance leads; others wait until it is gone
    keeps: ClassVar[tuple[Topic, ...]] = ()  # kept topics it remembers for those who come later
    recalls: ClassVar[tuple[Topic, ...]] = ()  # kept topics whose last message it wants before anything else

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

    def on_kept(self, last: dict[Topic, Stamped]) -> None:
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
        self._heart = Heartbeat(service.settings.heartbeat, service.name, bus.robot)
        self._stopping = False
        self.began = self._health_at = self._counted_at = time.monotonic()
        self._before: Counter[str] = Counter()
        self._sources = OneSource(SOURCE_SILENT)
        self._rivals: Instances | None = None
        self._metrics: ServiceMetrics | None = None
        self._others = Compatibility(bus, service.name, service.log)
        service._loop = self  # noqa: SLF001 - the two halves of one thing

    def run(self) -> None:
        """Until `stop`; with an endpoint for metrics where one is asked for."""
        if not (address := self.service.settings.metrics):
            self._run()
            return
        from common.metrics_endpoint import measure  # noqa: PLC0415 - Prometheus's client only where it is used

        with measure(self, address) as self._metrics:
            self._run()

    def _run(self) -> None:
        service = self.service
        self._others.at_start(self._config())
        service.open()
        try:
            if service.single:
                self._wait_to_lead()
            if not self._stopping:
                self._begin()
            while not self._stopping:
                self._turn()
        finally:
            service.close()

    def _begin(self) -> None:
        """Be there: hear, answer, and say so last."""
        service, bus = self.service, self.bus
        if not service.keep_all:
            bus.watch_instances(self._sources.change, "*" if service.all_robots else None)
        for kept in service.keeps:
            bus.keep(kept)
        if service.recalls:
            self._guard(lambda: service.on_kept(self._recalled()))
        for topic in service.inputs:
            bus.subscribe(topic, self.inbox, keep_all=service.keep_all)
        for query in service.queries:
            bus.serve(query, self.inbox)
        bus.serve(CONFIG, self.inbox, service.name)
        bus.declare_alive(service.name)
        self._others.watch()
        service.log.info("ready", robot=bus.robot)
        self._health_at = self._counted_at = time.monotonic()  # the first pulse now, and each after it a second on

    def _recalled(self) -> dict[Topic, Stamped]:
        found: dict[Topic, Stamped] = {}
        for topic in self.service.recalls:
            if (payload := self.bus.kept(topic)) is not None:
                try:
                    found[topic] = topic.message.decode(payload)
                except DecodeError as error:
                    self.reject(topic.key(self.bus.robot), str(error))
        return found

    def _wait_to_lead(self) -> None:
        """Until no other instance of the service leads, which at a first start is at once."""
        service, bus = self.service, self.bus
        wait_until(bus.linked, LINKED_WITHIN)  # who is linked to nobody hears of nobody
        self._rivals = rivals = bus.instances(service.name, self.inbox.wake)
        if rivals.may_lead():
            return
        end = bus.stand_by(service.name)
        leads = [spoken(name) for name in rivals.leaders()]
        service.log.warning("standing by: another was there first; this one takes over when it is gone", leads=leads)
        while not self._stopping and not rivals.may_lead():
            self.inbox.get(0.5)
        end()
        if not self._stopping:
            service.log.warning("taking over: the one that led is gone")
            self.began = time.monotonic()

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
        if self._metrics is not None:
            self._metrics.published(key, numbered)

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
        event = self.inbox.get(max(0.0, min(until_health, 0.5 if due is None else due)))
        if self._rivals is not None and self._rivals.must_yield():
            raise UserError(
                f"another {self.service.name} of {self.bus.robot!r}, {spoken(self._rivals.leaders()[0])}, was started "
                f"before this one and leads: this one ends. Started again, it stands by"
            )
        if isinstance(event, Sample) and self._counts(event):
            with nullcontext() if self._metrics is None else self._metrics.step(event):
                self._guard(lambda: self.service.on_sample(event))
        elif isinstance(event, Call):
            self._answer(event)
        elif isinstance(event, Answer):
            self._guard(lambda: self.service.on_reply(event.query, event.number, event.reply()))
        due = self.service.due()
        if due is not None and due <= 0:
            self._guard(self.service.on_timer)
        if (now := time.monotonic()) >= self._health_at:
            late = now - self._health_at > HEALTH_PERIOD  # after a long step one pulse, not all that were missed
            self._health_at = (now if late else self._health_at) + HEALTH_PERIOD
            health = self._health(now)
            self.publish(HEALTH, health)
            counts = {row.key: row.model_dump(include={"received", "published", "written"}) for row in health.topics}
            self._heart.beat(counts, linked=self.bus.linked(), note=health.note)
            self._others.look(self._config)

    def _counts(self, sample: Sample) -> bool:
        """Not where a second source publishes beside the one that is heard."""
        if sample.topic.many or self.service.keep_all:
            return True
        if self._sources.takes(sample.key, sample.topic.publisher, sample.source, time.monotonic()):
            return True
        self.service.counters["other_sources"] += 1
        if self._may_log(f"other {sample.key}"):
            self.service.log.warning(
                "ignored: a second source of what only one should publish; `presage doctor` names them",
                key=sample.key, session=sample.source,
            )  # fmt: skip
        return False

    def _guard(self, step: Callable[[], None]) -> None:
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
        return this_service(self.service.name, config, time.monotonic() - self.began)

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
            uptime=now - self.began,
            topics=rows,
            counters=counters,
            note=self.service.note,
        )


class _Ending:
    """Signal handler from the first moment on: a signal that comes before the loop ends it as it begins."""

    def __init__(self) -> None:
        self.asked = False
        self.loop: Loop | None = None

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self.loop is not None:
            self.loop.stop()

    def run(self, loop: Loop) -> None:
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
            ending.run(Loop(service, bus, Inbox()))
        service.log.info("ended")
    except UserError as error:
        say_failure(settings_class.service, error)
        sys.exit(2)
