"""The loop that runs one Service for one robot."""

from __future__ import annotations

import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import nullcontext
from typing import TYPE_CHECKING

from common.bus.bus import Bus
from common.bus.inbox import Inbox, IncomingRequest, RequestResult, Sample
from common.bus.instances import SourceSelector
from common.bus.leader_election import LeaderElection
from common.errors import UserError
from common.log import LogRateLimiter
from common.messages.definitions import Health, Stamped, TopicHealth
from common.messages.requests import ConfigReply, Reply, Request
from common.messages.topics import CONFIG, HEALTH, Query, Topic
from common.messages.wire import DecodeError
from common.runtime.heartbeat import Heartbeat
from common.runtime.protocol_check import ProtocolCheck, build_config_reply
from common.runtime.service_monitor import counts_of

if TYPE_CHECKING:
    from common.runtime.metrics import ServiceMetrics
    from common.runtime.service import Service

HEALTH_PERIOD_S = 1.0
LINK_WARNING_DELAY_S = 2.0  # a router that runs answers sooner
RESTORE_PERIOD_S = 5.0  # after its start, a service keeps querying latched topics for this long until one answers
MAX_REPORTED_KEYS, MAX_KEY_LENGTH = 200, 200  # in a health message
MAX_ERROR_LENGTH = 300  # in the log line of an error that was logged in full before
SOURCE_TIMEOUT_S = 0.3  # a source silent for longer is replaced by another source of the same topic


class ServiceLoop:
    """Runs one service on one session."""

    def __init__(self, service: Service, bus: Bus, inbox: Inbox) -> None:
        """Connects a service with a session; ``inbox`` queues the messages and requests that arrive for it."""
        self.service, self.bus, self.inbox = service, bus, inbox
        self.published: Counter[str] = Counter()  # by key
        self.undecodable: Counter[str] = Counter()  # by key
        self.failed = 0  # steps that raised an exception
        self._known_failures: set[tuple[type, str, int]] = set()  # error, file and line, logged in full
        self._request_number = 0
        self._may_log = LogRateLimiter()
        self._heartbeat = Heartbeat(service.settings.heartbeat, service.name, bus.robot)
        self._stopping = False
        self._checks_link = True  # whether to warn if nothing answers
        self.began = self._next_health = self._last_health = time.monotonic()
        self._totals_at_last_health: Counter[str] = Counter()
        self._sources = SourceSelector(SOURCE_TIMEOUT_S)
        self._restore_until = 0.0
        self._election = LeaderElection(bus, service.name, service.log, inbox.wake) if service.single else None
        self._metrics: ServiceMetrics | None = None
        self._protocol_check = ProtocolCheck(bus, service.name, service.log)
        service._loop = self  # noqa: SLF001 - a service publishes through its loop

    def run(self) -> None:
        """Runs the service until `stop`, and serves its metrics if the settings name an address for them."""
        if not (address := self.service.settings.metrics):
            self._run()
            return
        # Imported here because the Prometheus client is slow to import and rarely used.
        from common.runtime.metrics_server import serve_loop_metrics

        with serve_loop_metrics(self, address) as self._metrics:
            self._run()

    def _run(self) -> None:
        self.open()
        try:
            while not self._stopping and not self.try_start():
                self.inbox.get(HEALTH_PERIOD_S / 2)
                self._beat({}, note="standing by", idle=True)
            while not self._stopping:
                self._step()
        finally:
            self.service.close()

    def open(self) -> None:
        """Opens the service before it receives anything.

        Raises UserError if running services use another protocol version, or if the service itself cannot start.
        """
        self._protocol_check.check_at_start(self._config())
        self.service.open()

    def try_start(self) -> bool:
        """Subscribes, serves queries and declares the service alive; returns False while another instance is active."""
        if self._election is not None and not self._election.try_activate():
            return False
        service, bus = self.service, self.bus
        if not service.keep_all:
            bus.watch_instances(self._sources.update, "*" if service.all_robots else None)
        for latched in service.serves_latched:
            bus.serve_latched(latched)
        self._restore_until = time.monotonic() + RESTORE_PERIOD_S
        self._restore()
        for topic in service.inputs:
            bus.subscribe(topic, self.inbox, keep_all=service.keep_all)
        for query in service.queries:
            bus.serve(query, self.inbox)
        bus.serve(CONFIG, self.inbox, service.name)
        bus.declare_alive(service.name)
        self._protocol_check.watch()
        service.log.info("ready", robot=bus.robot)
        self._next_health = self._last_health = time.monotonic()  # the first health message is due now
        return True

    def _restore(self) -> None:
        """Queries the latched topics until one answers: after a router's restart, sessions first have to reconnect."""
        if (
            self.service.restores_latched
            and time.monotonic() < self._restore_until
            and (found := self._query_latched())
        ):
            self._restore_until = 0.0
            self.run_guarded(lambda: self.service.on_restored(found))

    def _query_latched(self) -> dict[Topic, Stamped]:
        found: dict[Topic, Stamped] = {}
        for topic in self.service.restores_latched:
            if (payload := self.bus.query_latched(topic)) is not None:
                try:
                    found[topic] = topic.message.decode(payload)
                except DecodeError as error:
                    self.reject(topic.key(self.bus.robot), str(error))
        return found

    def stop(self) -> None:
        """Makes `run` return after its current step; safe to call from a signal handler."""
        self._stopping = True
        self.inbox.wake()

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Publishes a message with the next sequence number of its key."""
        key = topic.key(self.bus.robot, self.service.name)
        numbered = message.model_copy(update={"seq": self.published[key]})
        self.bus.put(topic, numbered.encode(), self.service.name)
        self.published[key] += 1
        if self._metrics is not None:
            self._metrics.published(key, numbered)

    def send_request(self, query: Query, request: Request, timeout: float) -> int:
        """Sends a request and returns its number; the reply arrives through the inbox."""
        self._request_number += 1
        self.bus.send_request(query, request, self._request_number, self.inbox, timeout)
        return self._request_number

    def reject(self, key: str, reason: str) -> None:
        """Counts a payload that could not be used, and logs it at most once a second."""
        name = self.inbox.counter_name(key)
        self.undecodable[name] += 1
        if self._may_log(name):
            self.service.log.warning("payload dropped", key=key, reason=reason, so_far=self.undecodable[name])

    def _step(self) -> None:
        due = self.service.due()
        until_health = self._next_health - time.monotonic()
        self.handle(self.inbox.get(max(0.0, min(until_health, 0.5 if due is None else due))))
        due = self.service.due()
        if due is not None and due <= 0:
            self.run_guarded(self.service.on_timer)
        self.publish_health_if_due()

    def handle(self, event: Sample | IncomingRequest | RequestResult | None) -> None:
        """Handles one entry of the inbox; raises UserError if an older instance has become active."""
        if self._election is not None:
            self._election.check_oldest()
        if isinstance(event, Sample):
            if self._accepts(event):
                with nullcontext() if self._metrics is None else self._metrics.step(event):
                    self.run_guarded(lambda: self.service.on_sample(event))
        elif isinstance(event, IncomingRequest):
            self._answer(event)
        elif isinstance(event, RequestResult):
            self.run_guarded(lambda: self.service.on_reply(event.query, event.number, event.reply()))

    def publish_health_if_due(self) -> None:
        """Publishes health and repeats the periodic checks if a second has passed since the last time."""
        if (now := time.monotonic()) >= self._next_health:
            late = now - self._next_health > HEALTH_PERIOD_S  # after a long step, skip the health messages missed
            self._next_health = (now if late else self._next_health) + HEALTH_PERIOD_S
            health = self._health(now)
            self.publish(HEALTH, health)
            self._beat(counts_of(health), note=health.note, idle=health.idle)
            self._protocol_check.poll(self._config)
            if self._election is not None:
                self._election.refresh()
            self._restore()

    def _beat(self, counts: Mapping[str, Mapping[str, int]], *, note: str, idle: bool) -> None:
        """Writes the heartbeat; warns once if nothing has answered at the address to connect to."""
        linked, connect = self.bus.linked(), self.service.settings.connect
        self._heartbeat.beat(counts, linked=linked, note=note, idle=idle)
        if not connect or linked:
            self._checks_link = False
        elif self._checks_link and time.monotonic() - self.began > LINK_WARNING_DELAY_S:
            self._checks_link = False
            problem = f"nothing answers at {connect}"
            advice = "start a session with `presage up`, or name its address with --connect"
            self.service.log.warning(problem, advice=advice)

    def _accepts(self, sample: Sample) -> bool:
        """Whether a sample is from the selected source of its key; samples of a second source are ignored."""
        if sample.topic.multiple_publishers or self.service.keep_all:
            return True
        if self._sources.accepts(sample.key, sample.topic.publisher, sample.source, time.monotonic()):
            return True
        self.service.counters["other_sources"] += 1
        if self._may_log(f"other {sample.key}"):
            self.service.log.warning(
                "message ignored: two sources publish a topic that has one publisher; `presage doctor` lists them",
                key=sample.key,
                session=sample.source,
            )
        return False

    def run_guarded(self, step: Callable[[], None]) -> None:
        """Runs a step; an exception other than UserError is counted and logged, so that no input stops the service."""
        try:
            step()
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001
            self._log_failure("step failed", error)

    def _log_failure(self, event: str, error: Exception, **details: str) -> None:
        """Counts and logs an error: the first time with its traceback, then in one line, at most once a second."""
        self.failed += 1
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        failure = type(error), frame.f_code.co_filename, line
        if failure not in self._known_failures:
            self._known_failures.add(failure)
            self.service.log.error(event, **details, so_far=self.failed, exc_info=error)
        elif self._may_log(event):
            repeated, text = f"{event} (as before)", " ".join(f"{type(error).__name__}: {error}".split())
            self.service.log.error(repeated, **details, so_far=self.failed, error=text[:MAX_ERROR_LENGTH])

    def _answer(self, call: IncomingRequest) -> None:
        try:
            request = call.query.request.decode(call.payload)
        except DecodeError as error:
            self.reject(call.query.name, str(error))
            call.refuse(str(error))
            return

        def result() -> Reply | Future[Reply]:
            return self._config() if call.query is CONFIG else self.service.on_request(call.query, request)

        self._reply(call, result)

    def _reply(self, call: IncomingRequest, result: Callable[[], Reply | Future[Reply]]) -> None:
        """Replies with the ``result``, or why there is none; if it is a future, when that is done."""
        try:
            reply = result()
        except UserError as error:
            reply = call.query.reply(ok=False, reason=str(error))
        except Exception as error:  # noqa: BLE001
            self._log_failure("request failed", error, query=call.query.name)
            call.refuse(f"{self.service.name} failed: {type(error).__name__}: {error}")
            return
        if isinstance(reply, Future):
            reply.add_done_callback(lambda done: self._reply(call, done.result))
        else:
            call.reply(reply.encode())

    def _config(self) -> ConfigReply:
        config = json.dumps(self.service.settings.effective())
        return build_config_reply(self.service.name, config, time.monotonic() - self.began)

    def _health(self, now: float) -> Health:
        received, dropped, oversized = self.inbox.received_counts()
        total = received + self.published
        elapsed, self._last_health = max(now - self._last_health, 1e-3), now
        rows = [
            TopicHealth(
                key=key[:MAX_KEY_LENGTH],
                received=received[key],
                published=self.published[key],
                dropped=dropped[key],
                undecodable=self.undecodable[key] + oversized[key],
                rate=max(0, total[key] - self._totals_at_last_health[key]) / elapsed,
                **self.service.extra_counts(key),
            )
            for key in sorted(total)[:MAX_REPORTED_KEYS]
        ]
        self._totals_at_last_health = total
        counters: dict[str, int] = {**self.service.counters, "failed": self.failed}
        return Health(
            stamp_ns=time.time_ns(),
            service=self.service.name,
            uptime=now - self.began,
            topics=rows,
            counters=counters,
            note=self.service.note,
            instance=self.bus.instance,
            idle=self.service.idle,
        )
