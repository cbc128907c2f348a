"""Asks each service for its configuration, world and model."""

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

ANSWER_TIMEOUT_S = 2.0  # s, for one answer
RETRY_DELAY_S = 5.0  # s, until one that did not answer is asked again
MAX_ATTEMPTS = 5
MODEL_RETRY_DELAY_S = 0.5  # s, until an estimator that has seen no scan is asked again for its model
MODEL_RECHECK_PERIOD_S = 5.0  # s, until the model is looked at again: another scanner may call for other weights
ALL_SERVICES = "*"
MAX_WEIGHTS_BYTES = 16 << 20  # bytes; larger weights are named by their digest alone

DescriptionReply = ConfigReply | WorldReply | ModelReply


@dataclass(frozen=True)
class MetadataRecord:
    """A named map of text for the file."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True)
class AttachmentRecord:
    """A file inside the file."""

    name: str
    data: bytes
    media_type: str


def records_of(service: str, answer: DescriptionReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """What an answer is stored as; what metadata speaks of comes before it. Pure."""
    if isinstance(answer, WorldReply):
        yield from _records_of_world(answer)
    elif isinstance(answer, ModelReply):
        yield from _records_of_model(answer)
    else:
        yield MetadataRecord(f"config:{service}", {"config": answer.config, **answer.versions})


def _records_of_world(reply: WorldReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """The world as a file that `load_world` reads; scanner and robot as JSON."""
    if reply.world is not None:
        yield AttachmentRecord("world.yaml", save_world(reply.world).encode(), "application/yaml")
    described = {"scanner": reply.scanner, "robot": reply.robot}
    yield MetadataRecord("world", {name: d.model_dump_json() for name, d in described.items() if d is not None})


def _records_of_model(reply: ModelReply) -> Iterator[MetadataRecord | AttachmentRecord]:
    """A folder ``model/`` that serves as `--models`, and the estimator's map in it."""
    # The name comes from the bus and will be a file's: nothing that could lead out of a folder.
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
    """Answers wait in a queue, so that recording goes on while a service is slow or silent."""

    def __init__(self, bus: Bus, me: str, log: Logger, *, weights: bool = True) -> None:
        """Begin to watch; ``me`` is not asked. ``weights``: ask for the model's, up to `MAX_WEIGHTS_BYTES`."""
        self._bus, self._me, self._log, self._weights = bus, me, log, weights
        self._seen: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()  # from zenoh's thread
        self._answers: queue.SimpleQueue[tuple[str, DescriptionReply]] = queue.SimpleQueue()
        self._waiting: dict[tuple[str, str], tuple[float, int]] = {}  # service, query: when to ask, attempts before
        self._last: dict[tuple[str, str], DescriptionReply] = {}  # what was said once is not stored again
        self.present: frozenset[str] = frozenset()  # services that are there
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="describer", daemon=True)
        self._thread.start()
        bus.watch_alive(lambda service, there: self._seen.put((service, there)))

    def answers(self) -> Iterator[tuple[str, DescriptionReply]]:
        """Service and answer, of those that came since the last call."""
        while True:
            try:
                yield self._answers.get_nowait()
            except queue.Empty:
                return

    def query_all(self) -> None:
        """Ask everybody once more; an answer that is new is among `answers`."""
        self._seen.put((ALL_SERVICES, True))

    def stop(self) -> None:
        """Ask nobody any more; an answer under way may still come."""
        self._stopping.set()
        self._seen.put(None)

    def join(self) -> None:
        """After `stop`: wait for the thread, which ends within the time-out of an answer."""
        self._thread.join(ANSWER_TIMEOUT_S + 1.0)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._wait_for_event()
            for (service, query), (due, attempts) in list(self._waiting.items()):
                if due > time.monotonic() or self._stopping.is_set():
                    continue
                del self._waiting[service, query]
                self._query_and_reschedule(service, QUERIES[query], attempts)

    def _query_and_reschedule(self, service: str, query: Query, attempts: int) -> None:
        """Ask, and say when to ask again, if at all."""
        try:
            again, attempts = self._query(service, query), 0
        except UserError as error:
            again, attempts = RETRY_DELAY_S if attempts + 1 < MAX_ATTEMPTS else None, attempts + 1
            if not self._stopping.is_set():
                self._log.warning("a service did not describe itself", service=service, why=str(error))
        if again is not None:
            self._waiting[service, query.name] = (time.monotonic() + again, attempts)

    def _wait_for_event(self) -> None:
        """Wait for a service to come or go, or for the next to be asked."""
        due = min((due for due, _ in self._waiting.values()), default=None)
        try:
            seen = self._seen.get(timeout=None if due is None else max(0.0, due - time.monotonic()))
        except queue.Empty:
            return
        if seen is None or seen[0] == self._me:
            return
        service, there = seen
        if service == ALL_SERVICES:
            for each in self.present:
                self._schedule_queries(each)
        elif there:
            self.present |= {service}
            self._schedule_queries(service)
        else:
            self.present -= {service}
            for query in QUERIES:
                self._waiting.pop((service, query), None)

    def _schedule_queries(self, service: str) -> None:
        """It is to be asked now, whatever it can be asked."""
        for query in QUERIES.values():
            if query.per_service or query.server == service:
                self._waiting[service, query.name] = (time.monotonic(), 0)

    def _query(self, service: str, query: Query) -> float | None:
        """Put a new answer into the queue; seconds until the question is worth asking again, or None."""
        if query is CONFIG:
            self._queue_if_new(service, query, self._bus.ask(CONFIG, Request(), ConfigReply, ANSWER_TIMEOUT_S, service))
        elif query is WORLD:
            self._queue_if_new(service, query, self._bus.ask(WORLD, Request(), WorldReply, ANSWER_TIMEOUT_S))
        else:
            return self._query_model(service)
        return None

    def _query_model(self, service: str) -> float:
        reply = self._bus.ask(MODEL, ModelRequest(), ModelReply, ANSWER_TIMEOUT_S)
        if not reply.ok:
            return MODEL_RETRY_DELAY_S
        if reply != self._last.get((service, MODEL.name)):
            whole = reply
            if self._weights and 0 < reply.size <= MAX_WEIGHTS_BYTES:
                whole = self._bus.ask(MODEL, ModelRequest(weights=True), ModelReply, ANSWER_TIMEOUT_S)
                if not whole.ok:
                    self._log.warning("the weights are not stored", why=whole.reason)
                    whole = reply
            self._last[service, MODEL.name] = reply
            self._answers.put((service, whole))
        return MODEL_RECHECK_PERIOD_S

    def _queue_if_new(self, service: str, query: Query, answer: ConfigReply | WorldReply) -> None:
        if answer != self._last.get((service, query.name)):
            self._last[service, query.name] = answer
            self._answers.put((service, answer))


QUERIES = {query.name: query for query in (CONFIG, WORLD, MODEL)}
