"""The loop that runs one Service for one robot."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING

from common.bus.bus import Bus
from common.bus.inbox import Answer, Call, Inbox, Sample
from common.bus.instances import SourceSelector
from common.bus.leader_election import LeaderElection
from common.errors import UserError
from common.log import LogRateLimiter
from common.messages.definitions import Health, Stamped, TopicHealth
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG, HEALTH, Query, Topic
from common.messages.wire import DecodeError
from common.runtime.heartbeat import Heartbeat
from common.runtime.protocol_check import ProtocolCheck, build_config_reply

if TYPE_CHECKING:
    from common.runtime.metrics import ServiceMetrics
    from common.runtime.service import Service

HEALTH_PERIOD = 1.0  # s
RECALL_WITHIN = 5.0  # s after its start in which a service asks what others remember
SOURCE_SILENT = 0.3  # s after which another source of a topic is heard


class Loop:
    """Runs one service on one session."""

    def __init__(self, service: Service, bus: Bus, inbox: Inbox) -> None:
        """What arrives once it has begun waits in ``inbox``."""
        self.service, self.bus, self.inbox = service, bus, inbox
        self.published: Counter[str] = Counter()  # by key
        self.undecodable: Counter[str] = Counter()
        self.failed = 0
        self._asked = 0
        self._may_log = LogRateLimiter()
        self._heart = Heartbeat(service.settings.heartbeat, service.name, bus.robot)
        self._stopping = False
        self.began = self._health_at = self._counted_at = time.monotonic()
        self._before: Counter[str] = Counter()
        self._sources = SourceSelector(SOURCE_SILENT)
        self._recall_until = 0.0
        self._lead = LeaderElection(bus, service.name, service.log, inbox.wake) if service.single else None
        self._metrics: ServiceMetrics | None = None
        self._others = ProtocolCheck(bus, service.name, service.log)
        service._loop = self  # noqa: SLF001 - the two halves of one thing

    def run(self) -> None:
        """Until `stop`; with an endpoint for metrics where one is asked for."""
        if not (address := self.service.settings.metrics):
            self._run()
            return
        from common.runtime.metrics_server import measure  # noqa: PLC0415 - Prometheus's client only where it is used

        with measure(self, address) as self._metrics:
            self._run()

    def _run(self) -> None:
        self.open()
        try:
            while not self._stopping and not self.try_start():
                self.inbox.get(HEALTH_PERIOD / 2)
                self._heart.beat({}, linked=self.bus.linked(), note="standing by")
            while not self._stopping:
                self._turn()
        finally:
            self.service.close()

    def open(self) -> None:
        """Before anything is heard; raises UserError where others speak another protocol, or the service cannot."""
        self._others.check_at_start(self._config())
        self.service.open()

    def try_start(self) -> bool:
        """Hear, answer, and say last that the service is there; False while another instance leads."""
        if self._lead is not None and not self._lead.takes():
            return False
        service, bus = self.service, self.bus
        if not service.keep_all:
            bus.watch_instances(self._sources.change, "*" if service.all_robots else None)
        for kept in service.serves_latched:
            bus.keep(kept)
        self._recall_until = time.monotonic() + RECALL_WITHIN
        self._recall()
        for topic in service.inputs:
            bus.subscribe(topic, self.inbox, keep_all=service.keep_all)
        for query in service.queries:
            bus.serve(query, self.inbox)
        bus.serve(CONFIG, self.inbox, service.name)
        bus.declare_alive(service.name)
        self._others.watch()
        service.log.info("ready", robot=bus.robot)
        self._health_at = self._counted_at = time.monotonic()  # the first pulse now, and each after it a second on
        return True

    def _recall(self) -> None:
        """Once somebody knows: after a router's death all have to find one another first."""
        if self.service.restores_latched and time.monotonic() < self._recall_until and (found := self._recalled()):
            self._recall_until = 0.0
            self.guard(lambda: self.service.on_restored(found))

    def _recalled(self) -> dict[Topic, Stamped]:
        found: dict[Topic, Stamped] = {}
        for topic in self.service.restores_latched:
            if (payload := self.bus.kept(topic)) is not None:
                try:
                    found[topic] = topic.message.decode(payload)
                except DecodeError as error:
                    self.reject(topic.key(self.bus.robot), str(error))
        return found

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
        self.handle(self.inbox.get(max(0.0, min(until_health, 0.5 if due is None else due))))
        due = self.service.due()
        if due is not None and due <= 0:
            self.guard(self.service.on_timer)
        self.pulse()

    def handle(self, event: Sample | Call | Answer | None) -> None:
        """What one entry of the inbox asks for; raises UserError where another instance leads by now."""
        if self._lead is not None:
            self._lead.check()
        if isinstance(event, Sample):
            if self._counts(event):
                with nullcontext() if self._metrics is None else self._metrics.step(event):
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
            health = self._health(now)
            self.publish(HEALTH, health)
            counts = {row.key: row.model_dump(include={"received", "published", "written"}) for row in health.topics}
            self._heart.beat(counts, linked=self.bus.linked(), note=health.note)
            self._others.look(self._config)
            if self._lead is not None:
                self._lead.look()
            self._recall()

    def _counts(self, sample: Sample) -> bool:
        """Not where a second source publishes beside the one that is heard."""
        if sample.topic.multiple_publishers or self.service.keep_all:
            return True
        if self._sources.accepts(sample.key, sample.topic.publisher, sample.source, time.monotonic()):
            return True
        self.service.counters["other_sources"] += 1
        if self._may_log(f"other {sample.key}"):
            self.service.log.warning(
                "ignored: a second source of what only one should publish; `presage doctor` names them",
                key=sample.key, session=sample.source,
            )  # fmt: skip
        return False

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
        return build_config_reply(self.service.name, config, time.monotonic() - self.began)

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
                **self.service.extra_counts(key),
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
            instance=self.bus.instance,
        )
