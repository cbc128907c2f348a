"""Queries each service for its configuration, world and model."""

from __future__ import annotations

import queue
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from common.bus.bus import Bus
from common.errors import UserError
from common.geometry.world import save_world
from common.log import Logger
from common.messages.requests import ConfigReply, ModelReply, ModelRequest, Request, WorldReply
from common.messages.topics import CONFIG, MODEL, WORLD, Query

REPLY_TIMEOUT_S = 2.0  # for one reply
RETRY_DELAY_S = 5.0  # after a service did not reply
MAX_ATTEMPTS = 5
MODEL_RETRY_DELAY_S = 0.5  # while an estimator has no model yet because it has received no scan
MODEL_RECHECK_PERIOD_S = 5.0  # the model can change: another scanner may need other weights
ALL_SERVICES = "*"
MAX_WEIGHTS_BYTES = 16 << 20  # of larger weights only the digest is stored

DescriptionReply = ConfigReply | WorldReply | ModelReply


@dataclass(frozen=True)
class MetadataRecord:
    """A named map of text to be stored in the recording."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True)
class AttachmentRecord:
    """A file to be attached to the recording."""

    name: str
    data: bytes
    media_type: str


def description_records(service: str, reply: DescriptionReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """Yields the records that store a reply. Attachments come before the metadata that refers to them."""
    if isinstance(reply, WorldReply):
        yield from _world_records(reply)
    elif isinstance(reply, ModelReply):
        yield from _model_records(reply)
    else:
        yield MetadataRecord(f"config:{service}", {"config": reply.config, **reply.versions})


def _world_records(reply: WorldReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """The world as a file that `load_world` reads, and scanner and robot as JSON."""
    if reply.world is not None:
        yield AttachmentRecord("world.yaml", save_world(reply.world).encode(), "application/yaml")
    described = {"scanner": reply.scanner, "robot": reply.robot}
    yield MetadataRecord("world", {name: d.model_dump_json() for name, d in described.items() if d is not None})


def _model_records(reply: ModelReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """A folder ``model/`` that can be passed to `--models`, with the estimator's map in it."""
    # The name comes from the bus and becomes a file name, so it must not contain a path.
    named = re.fullmatch(r"[\w.-]+\.safetensors", reply.file) is not None
    stored = "none: nothing was learned" if not reply.file else "not stored"
    if reply.world is not None:
        yield AttachmentRecord("model/world.yaml", save_world(reply.world).encode(), "application/yaml")
    if named:
        card = f"model/{reply.file.removesuffix('.safetensors')}.json"
        yield AttachmentRecord(card, reply.card.encode(), "application/json")
    if named and len(reply.weights):
        yield AttachmentRecord(f"model/{reply.file}", reply.weights.tobytes(), "application/octet-stream")
        stored = "stored"
    about = {"size": str(reply.size), "sha256": reply.sha256} if reply.file else {}
    model = {"estimator": reply.estimator, "card": reply.card, "file": reply.file if named else "", **about}
    yield MetadataRecord("model", {**model, "weights": stored})


class DescriptionCollector:
    """Queries services for their descriptions in a thread, so that a slow service does not hold up the recording."""

    def __init__(self, bus: Bus, own_name: str, log: Logger, *, weights: bool = True) -> None:
        """Starts the thread. The service ``own_name`` is not queried.

        With ``weights``, also fetches the model's weights, up to `MAX_WEIGHTS_BYTES`.
        """
        self._bus, self._own_name, self._log, self._weights = bus, own_name, log, weights
        # Services that came (True) or went (False), from zenoh's thread; None wakes the thread.
        self._events: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[tuple[str, DescriptionReply]] = queue.SimpleQueue()
        # By service and query: due time, and attempts so far.
        self._scheduled: dict[tuple[str, str], tuple[float, int]] = {}
        self._last: dict[tuple[str, str], DescriptionReply] = {}  # an unchanged reply is not stored again
        self.present: frozenset[str] = frozenset()  # services that are alive
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="session-description", daemon=True)
        self._thread.start()
        bus.watch_alive(lambda service, alive: self._events.put((service, alive)))

    def new_replies(self) -> Iterator[tuple[str, DescriptionReply]]:
        """Yields service and reply for each reply since the last call."""
        while True:
            try:
                yield self._replies.get_nowait()
            except queue.Empty:
                return

    def query_all(self) -> None:
        """Queries all services again. Changed replies appear in `new_replies`."""
        self._events.put((ALL_SERVICES, True))

    def stop(self) -> None:
        """Stops querying. A reply that is already on its way may still arrive."""
        self._stopping.set()
        self._events.put(None)

    def join(self) -> None:
        """Waits for the thread after `stop`. It ends within the timeout of one query."""
        self._thread.join(REPLY_TIMEOUT_S + 1.0)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._wait_for_event()
            for (service, query), (due, attempts) in list(self._scheduled.items()):
                if due > time.monotonic() or self._stopping.is_set():
                    continue
                del self._scheduled[service, query]
                self._query_and_reschedule(service, QUERIES[query], attempts)

    def _query_and_reschedule(self, service: str, query: Query, attempts: int) -> None:
        """Sends the query once and schedules the next attempt, if any."""
        try:
            delay, attempts = self._query(service, query), 0
        except UserError as error:
            delay, attempts = RETRY_DELAY_S if attempts + 1 < MAX_ATTEMPTS else None, attempts + 1
            if not self._stopping.is_set() and delay is None:
                self._log.warning("a service did not describe itself", service=service, reason=str(error))
        if delay is not None:
            self._scheduled[service, query.name] = (time.monotonic() + delay, attempts)

    def _wait_for_event(self) -> None:
        """Waits until a service comes or goes, or the next query is due."""
        due = min((due for due, _ in self._scheduled.values()), default=None)
        try:
            event = self._events.get(timeout=None if due is None else max(0.0, due - time.monotonic()))
        except queue.Empty:
            return
        if event is None or event[0] == self._own_name:
            return
        service, alive = event
        if service == ALL_SERVICES:
            for each in self.present:
                self._schedule_queries(each)
        elif alive:
            self.present |= {service}
            self._schedule_queries(service)
        else:
            self.present -= {service}
            for query in QUERIES:
                self._scheduled.pop((service, query), None)

    def _schedule_queries(self, service: str) -> None:
        """Schedules all queries that the service answers, for now."""
        for query in QUERIES.values():
            if query.per_service or query.server == service:
                self._scheduled[service, query.name] = (time.monotonic(), 0)

    def _query(self, service: str, query: Query) -> float | None:
        """Queries the service and queues a changed reply. Returns the delay until the next query in s, or None."""
        if query is CONFIG:
            self._queue_if_new(
                service, query, self._bus.query(CONFIG, Request(), ConfigReply, REPLY_TIMEOUT_S, service)
            )
        elif query is WORLD:
            self._queue_if_new(service, query, self._bus.query(WORLD, Request(), WorldReply, REPLY_TIMEOUT_S))
        else:
            return self._query_model(service)
        return None

    def _query_model(self, service: str) -> float:
        reply = self._bus.query(MODEL, ModelRequest(), ModelReply, REPLY_TIMEOUT_S)
        if not reply.ok:
            return MODEL_RETRY_DELAY_S
        if reply != self._last.get((service, MODEL.name)):
            with_weights = reply
            if self._weights and 0 < reply.size <= MAX_WEIGHTS_BYTES:
                with_weights = self._bus.query(MODEL, ModelRequest(weights=True), ModelReply, REPLY_TIMEOUT_S)
                if not with_weights.ok:
                    self._log.warning("the weights are not stored", reason=with_weights.reason)
                    with_weights = reply
            self._last[service, MODEL.name] = reply
            self._replies.put((service, with_weights))
        return MODEL_RECHECK_PERIOD_S

    def _queue_if_new(self, service: str, query: Query, reply: ConfigReply | WorldReply) -> None:
        if reply != self._last.get((service, query.name)):
            self._last[service, query.name] = reply
            self._replies.put((service, reply))


QUERIES = {query.name: query for query in (CONFIG, WORLD, MODEL)}
