"""The recorder's thin shell: whatever is on the bus goes into the file; what describes the session too."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import ClassVar

from common.errors import UserError
from common.inbox import OTHERS, Sample
from common.log import Logger
from common.messages import WorldReply
from common.service import Service
from common.topics import TOPICS, WORLD, Topic
from common.versions import versions
from services.recorder.accounting import Ledger, as_metadata
from services.recorder.describing import Answer, Describer, MetadataRecord, records_of
from services.recorder.parts import Limits, PartsWriter
from services.recorder.settings import RecorderSettings
from services.recorder.writer import UNFINISHED, NameTakenError, RecordingWriter, is_being_written

LINK_WITHIN = 3.0  # s; a recorder may come before the others, but should not wait for nobody in silence


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
        self.writer: PartsWriter | None = None
        self.ledger = Ledger()
        self.describer: Describer | None = None
        self._flush_at = 0.0
        self._logged_ns = 0  # of the last message
        self._warn_at: float | None = None  # of nobody there; None: no more

    def open(self) -> None:
        """What is known of the session first, so that even a torn file explains itself."""
        options = self.options
        self.loop.inbox.capacity = options.capacity
        tell_of_unfinished(options.directory, self.log)
        limits = Limits(int(options.split_size * 1e6), options.split_minutes * 60)
        writer = self.writer = PartsWriter(parts_of(options), limits, self._counters)
        session = {"robot": options.robot, "command": " ".join(sys.argv), **versions()}
        writer.metadata("presage", session)
        writer.metadata("config:recorder", {"config": json.dumps(options.effective())})
        for topic in self.inputs:
            if not topic.per_service:
                writer.declare(topic, topic.key(options.robot))
        writer.flush()
        self._flush_at = time.monotonic() + options.flush
        self._warn_at = time.monotonic() + LINK_WITHIN if options.link().connect else None
        self.describer = Describer(self.loop.bus, self.name, self.log, weights=options.weights)
        self.log.info("recording", file=str(writer.part.path))

    def on_sample(self, sample: Sample) -> None:
        """Bytes as they came, whether or not they make sense."""
        assert self.writer is not None  # noqa: S101 - set in open
        if self.loop.inbox.counted_as(sample.key) != sample.key:  # somebody invents keys
            self.loop.inbox.dropped[OTHERS] += 1
            self.counters["turned_away"] += 1
            return
        self._logged_ns = max(self._logged_ns, sample.received_ns)  # in order, though a clock be set back
        published = sample.published_ns or sample.received_ns
        self.writer.write(sample.topic, sample.key, sample.payload, published, self._logged_ns)
        self.ledger.see(sample.key, sample.payload)
        self.counters["written"] += 1

    def counted(self, key: str) -> dict[str, int]:
        """For health: what was written of a key, and what never came."""
        return {"written": self.ledger.written.get(key, 0), "missing": self.ledger.lost(key).missing}

    def _counters(self) -> dict[str, dict[str, str]]:
        inbox = self.loop.inbox
        return {"counters": as_metadata(self.ledger.counts(inbox.received, inbox.dropped, inbox.oversized))}

    def due(self) -> float | None:
        """Until the next flush."""
        return self._flush_at - time.monotonic()

    def on_timer(self) -> None:
        """Now and then: what services said of themselves, then to disk."""
        self._flush_at = time.monotonic() + self.options.flush
        self._write_answers()
        self._look_for_others()
        if self.writer is not None:
            self.writer.flush()

    def close(self) -> None:
        """What still waits, then the end of the file."""
        writer, inbox = self.writer, self.loop.inbox
        if writer is None or self.describer is None:
            return
        self.describer.stop()
        try:
            if not writer.failed:
                for _ in range(inbox.capacity):  # bounded: others may go on publishing
                    if (entry := inbox.get(0)) is None:
                        break
                    if isinstance(entry, Sample):
                        self.on_sample(entry)
                self._write_answers()
        finally:
            *_, path = files = writer.finish()
            self.describer.join()
        written, dropped = sum(self.ledger.written.values()), sum(inbox.dropped.values())
        missing = sum(sequence.missing for sequence in self.ledger.sequences.values())
        parts = {"parts": len(files)} if len(files) > 1 else {}
        self.log.info("recorded", file=str(path), messages=written, dropped=dropped, missing=missing, **parts)

    def _look_for_others(self) -> None:
        """Say once that nobody is there, and when somebody comes after that."""
        if self._warn_at is None or time.monotonic() < self._warn_at:
            return
        linked = self.loop.bus.linked()
        if not linked and not self.note:
            self.note = f"nothing answers at {', '.join(self.options.link().connect)}"
            self.log.warning(self.note, advice="start a session with `presage up`, or say where it is with --connect")
        elif linked:
            if self.note:
                self.log.info("there it is")
            self._warn_at, self.note = None, ""

    def _write_answers(self) -> None:
        if self.writer is None or self.describer is None:
            return
        for service, answer in self.describer.answers():
            write_answer(self.writer, service, answer)


def open_writer(options: RecorderSettings) -> RecordingWriter:
    """Under the name asked for; a name of our own making gets a number where another recorder was first."""
    return parts_of(options)(1)


def parts_of(options: RecorderSettings) -> Callable[[int], RecordingWriter]:
    """Opens part number k: NAME.mcap, or NAME-001.mcap, NAME-002.mcap … where there may be several."""
    first, several = file_path(options), bool(options.split_size or options.split_minutes)
    chosen: list[Path] = []  # the name that was free for the first part

    def open_part(part: int) -> RecordingWriter:
        for number in itertools.count(1):
            path = first if number == 1 else first.with_stem(f"{first.stem}-{number}")
            path = chosen[0] if chosen else path
            file = path.with_stem(f"{path.stem}-{part:03d}") if several else path
            with suppress(NameTakenError) if not (options.file or chosen) else nullcontext():
                writer = RecordingWriter(file, options.compression, options.chunk_size)
                chosen.append(path)
                return writer
        raise AssertionError

    return open_part


def tell_of_unfinished(folder: Path, log: Logger) -> None:
    """Files of recorders that were killed, and what to do with them."""
    for path in sorted(folder.glob(f"*.mcap{UNFINISHED}")) if folder.is_dir() else ():
        if not is_being_written(path):
            log.warning("unfinished recording", file=str(path), advice=f"presage recover {path}")


def file_path(options: RecorderSettings) -> Path:
    """Where to record: the name asked for, or one of robot and time."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%d-%H%M%S")
    name = options.file or f"presage-{options.robot}-{stamp}.mcap"
    return options.directory / (name if name.endswith(".mcap") else name + ".mcap")


def chosen_topics(names: str) -> tuple[Topic, ...]:
    """The rows of those comma-separated names, or all that are marked; raises UserError for an unknown one."""
    recorded = {topic.name: topic for topic in TOPICS if topic.recorded}
    wanted = [part.strip() for part in names.split(",") if part.strip()]
    if unknown := [name for name in wanted if name not in recorded]:
        raise UserError(f"no topic {', '.join(unknown)}: choose from {', '.join(recorded)}")
    return tuple(recorded[name] for name in dict.fromkeys(wanted)) if wanted else tuple(recorded.values())


def write_answer(writer: RecordingWriter | PartsWriter, service: str, answer: Answer) -> None:
    """What a service said of itself, as `records_of` has it."""
    for record in records_of(service, answer):
        if isinstance(record, MetadataRecord):
            writer.metadata(record.name, record.values)
        else:
            writer.attachment(record.name, record.data, record.media_type, time.time_ns())


def write_world(writer: RecordingWriter | PartsWriter, reply: WorldReply) -> None:
    """The world as an attachment that `load_world` reads; scanner and robot as JSON."""
    write_answer(writer, WORLD.server, reply)
