"""The recorder's thin shell: whatever is on the bus goes into the file; what describes the session too."""

from __future__ import annotations

import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone
from typing import ClassVar

from common.errors import UserError
from common.inbox import Sample
from common.messages import ConfigReply, Request, WorldReply
from common.service import Service
from common.topics import CONFIG, TOPICS, WORLD, Topic
from common.versions import versions
from common.world import save_world
from services.recorder.settings import RecorderSettings
from services.recorder.writer import RecordingWriter

FLUSH_PERIOD = 1.0  # s
ASK_TIMEOUT = 2.0  # s


class RecorderService(Service):
    """Recording as a process."""

    name: ClassVar[str] = "recorder"
    inputs: ClassVar[tuple[Topic, ...]] = tuple(topic for topic in TOPICS if topic.recorded)
    keep_all: ClassVar[bool] = True

    def __init__(self, settings: RecorderSettings) -> None:
        """The file is opened in `open`."""
        super().__init__(settings)
        self.options = settings
        self.inputs = chosen_topics(settings.topics)  # type: ignore[misc]
        self.writer: RecordingWriter | None = None
        self._flush_at = 0.0
        self._found: queue.SimpleQueue[Callable[[RecordingWriter], None]] = queue.SimpleQueue()  # from other threads
        self._to_ask: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def open(self) -> None:
        """Schemas and what is known of the session first, so that even a torn file explains itself."""
        options = self.options
        stamp = datetime.now(timezone.utc).strftime("%Y%m%d-%H%M%S")
        name = options.file or f"presage-{options.robot}-{stamp}.mcap"
        path = options.directory / (name if name.endswith(".mcap") else name + ".mcap")
        self.writer = RecordingWriter(path, options.compression, options.chunk_size)
        for topic in self.inputs:
            if not topic.per_service:
                self.writer.declare(topic, topic.key(options.robot))
        self.writer.metadata("presage", {"robot": options.robot, "command": " ".join(sys.argv), **versions()})
        self.writer.metadata("config:recorder", {"config": json.dumps(options.effective())})
        self.writer.flush()
        self._flush_at = time.monotonic() + FLUSH_PERIOD
        threading.Thread(target=self._ask_services, daemon=True).start()
        self.loop.bus.watch_alive(lambda service, there: self._to_ask.put(service) if there else None)
        self.log.info("recording", file=str(path))

    def on_sample(self, sample: Sample) -> None:
        """Bytes as they came, whether or not they make sense."""
        assert self.writer is not None  # noqa: S101 - set in open
        published = sample.published_ns or sample.received_ns
        self.writer.write(sample.topic, sample.key, sample.payload, published, sample.received_ns)
        self.counters["written"] += 1

    def due(self) -> float | None:
        """Until the next flush."""
        return self._flush_at - time.monotonic()

    def on_timer(self) -> None:
        """Once a second: what services said of themselves, then to disk."""
        self._flush_at = time.monotonic() + FLUSH_PERIOD
        assert self.writer is not None  # noqa: S101 - set in open
        self._write_found()
        self.writer.flush()

    def close(self) -> None:
        """What still waits, then the end of the file."""
        if self.writer is None:
            return
        self._to_ask.put(None)
        while (entry := self.loop.inbox.get(0)) is not None:
            if isinstance(entry, Sample):
                self.on_sample(entry)
        self._write_found()
        dropped = {key: str(count) for key, count in self.loop.inbox.dropped.items() if count}
        self.writer.metadata("dropped", dropped)
        self.writer.metadata("written", {key: str(count) for key, count in self.writer.written.items()})
        path = self.writer.finish()
        self.log.info(
            "recorded", file=str(path), messages=sum(self.writer.written.values()), dropped=sum(map(int, dropped.values()))
        )

    def _write_found(self) -> None:
        while not self._found.empty():
            assert self.writer is not None  # noqa: S101 - set in open
            self._found.get()(self.writer)

    def _ask_services(self) -> None:
        """Another thread, for an answer may take a while: what each service that appears says of itself."""
        bus = self.loop.bus
        while (service := self._to_ask.get()) is not None:
            if service == self.name:
                continue
            try:
                reply = bus.ask(CONFIG, Request(), ConfigReply, timeout=ASK_TIMEOUT, service=service)
                values = {"config": reply.config, **reply.versions}
                self._found.put(lambda w, s=service, v=values: w.metadata(f"config:{s}", v))  # type: ignore[misc]
                if service == WORLD.server:
                    here = bus.ask(WORLD, Request(), WorldReply, timeout=ASK_TIMEOUT)
                    self._found.put(lambda w, h=here: write_world(w, h))  # type: ignore[misc]
            except UserError as error:
                self.log.warning("a service did not describe itself", service=service, why=str(error))


def chosen_topics(names: str) -> tuple[Topic, ...]:
    """The rows of those comma-separated names, or all that are marked; raises UserError for an unknown one."""
    recorded = {topic.name: topic for topic in TOPICS if topic.recorded}
    wanted = [part.strip() for part in names.split(",") if part.strip()]
    if unknown := [name for name in wanted if name not in recorded]:
        raise UserError(f"no topic {', '.join(unknown)}: choose from {', '.join(recorded)}")
    return tuple(recorded[name] for name in wanted) if wanted else tuple(recorded.values())


def write_world(writer: RecordingWriter, reply: WorldReply) -> None:
    """The world as an attachment that `load_world` reads; scanner and robot as JSON."""
    now = time.time_ns()
    if reply.world is not None:
        writer.attachment("world.yaml", save_world(reply.world).encode(), "application/yaml", now)
    described = {"scanner": reply.scanner, "robot": reply.robot}
    writer.metadata("world", {name: d.model_dump_json() for name, d in described.items() if d is not None})
