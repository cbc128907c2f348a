"""One recording from start to end, with its counters."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import nullcontext, suppress
from datetime import datetime, timezone
from pathlib import Path

from common.bus.inbox import OTHERS, Inbox, Sample
from common.errors import UserError
from common.log import Logger
from common.messages.requests import RecordReply
from common.messages.topics import Topic
from common.versions import versions
from services.recorder.files.message_counts import KeyCounts, MessageCounts, as_metadata
from services.recorder.files.parts import PartLimits, PartsWriter
from services.recorder.files.writer import UNFINISHED_SUFFIX, NameTakenError, RecordingWriter, is_being_written
from services.recorder.session_description import DescriptionReply, MetadataRecord, description_records
from services.recorder.settings import RecorderSettings


class OpenRecording:
    """A recording that is being written. Every method raises UserError if writing fails."""

    def __init__(
        self, options: RecorderSettings, topics: Iterable[Topic], inbox: Inbox, *, numbered: bool = False
    ) -> None:
        """Opens the file. ``numbered`` is passed to `parts_of`.

        The metadata known so far is written first, so that it is readable even in a file that is never finished.
        """
        self.message_counts = MessageCounts()
        self._inbox, self._before, self._began = inbox, inbox.handled_counts(), time.monotonic()
        # Log times are wall time at the opening and monotonic time from there: a clock that is set does not bend them.
        self._clock_ns = time.time_ns() - time.monotonic_ns()
        self._logged_ns = 0  # log time of the last message
        limits = PartLimits(int(options.split_size * 1e6), options.split_minutes * 60)
        writer = self.writer = PartsWriter(parts_of(options, numbered=numbered), limits, self._counters)
        try:
            writer.metadata("presage", {"robot": options.robot, "command": shlex.join(sys.argv), **versions()})
            writer.metadata("config:recorder", {"config": json.dumps(options.effective())})
            for topic in topics:
                if not topic.per_service:
                    writer.declare(topic, topic.key(options.robot))
            writer.flush()
        except UserError:
            writer.part.discard()
            raise

    def write(self, sample: Sample) -> None:
        """Writes the payload as received, whether or not it can be decoded."""
        self._logged_ns = max(self._logged_ns, sample.received_ns + self._clock_ns)  # log times must not decrease
        published = sample.published_ns or self._logged_ns
        # Counted first, as it is no longer in the queue: writing may end a part of the file, which states the counts.
        self.message_counts.add(sample.key, sample.payload)
        self.writer.write(sample.topic, sample.key, sample.payload, published, self._logged_ns)

    def describe(self, service: str, reply: DescriptionReply) -> None:
        """Writes a service's reply about its configuration, world or model."""
        write_description(self.writer, service, reply)

    def state(self) -> RecordReply:
        """File, number of messages and duration so far."""
        written, seconds = sum(self.message_counts.written.values()), time.monotonic() - self._began
        return RecordReply(recording=True, file=str(self.writer.part.path), messages=written, seconds=seconds)

    def missing(self) -> int:
        """Messages that were published and never received, by their sequence numbers."""
        return sum(self.message_counts.sequence_totals(key).missing for key in self.message_counts.sequences)

    def not_in_file(self) -> int:
        """Upper bound of the messages that were queued but are not in the file, after writing failed."""
        arrived, dropped, oversized = (sum(counts.values()) for counts in self._since(self._inbox.received_counts()))
        return arrived - dropped - oversized - self.writer.saved

    def dropped(self) -> int:
        """Messages that were dropped because the queue was full."""
        return sum(count.dropped for count in self._counts().values())

    def _counts(self) -> dict[str, KeyCounts]:
        received, dropped, oversized = self._since(self._inbox.handled_counts())
        return self.message_counts.counts(received, dropped, oversized)

    def _since(self, now: tuple[Counter[str], ...]) -> list[dict[str, int]]:
        """Counts by key since the recording began, without requests, which the inbox counts by query name."""
        since = [after - before for after, before in zip(now, self._before, strict=True)]
        return [{key: n for key, n in counts.items() if "/" in key or key == OTHERS} for counts in since]

    def _counters(self) -> dict[str, dict[str, str]]:
        return {"counters": as_metadata(self._counts())}


def parts_of(options: RecorderSettings, *, numbered: bool = False) -> Callable[[int], RecordingWriter]:
    """Returns a function that opens part k: NAME.mcap, or NAME-001.mcap, NAME-002.mcap, ... if the recording is split.

    If the name is taken, a generated name, or any name with ``numbered``, gets a number appended. A name chosen by the
    user raises NameTakenError.
    """
    first, several = file_path(options), bool(options.split_size or options.split_minutes)
    chosen: list[Path] = []  # the name that was free for the first part

    def open_part(part: int) -> RecordingWriter:
        for number in itertools.count(1):
            path = first if number == 1 else first.with_stem(f"{first.stem}-{number}")
            path = chosen[0] if chosen else path
            file = path.with_stem(f"{path.stem}-{part:03d}") if several else path
            try_next_number = (numbered or not options.file) and not chosen
            with suppress(NameTakenError) if try_next_number else nullcontext():
                if several and not chosen:
                    check_no_parts(path)
                writer = RecordingWriter(file, options.compression)
                chosen.append(path)
                return writer
        raise AssertionError

    return open_part


def check_no_parts(path: Path) -> None:
    """Raises NameTakenError if another recording has parts of this name, which this one would need later."""
    pattern = re.compile(rf"{re.escape(path.stem)}-\d{{3,}}\.mcap({re.escape(UNFINISHED_SUFFIX)})?")
    for existing in sorted(path.parent.glob("*.mcap*")):
        if pattern.fullmatch(existing.name):
            raise NameTakenError(existing)


def warn_about_unfinished(folder: Path, log: Logger) -> None:
    """Logs a warning for each file that a killed recorder left unfinished."""
    for path in sorted(folder.glob(f"*.mcap{UNFINISHED_SUFFIX}")) if folder.is_dir() else ():
        if not is_being_written(path):
            log.warning("unfinished recording", file=str(path), advice=f"presage recover {path}")


def file_path(options: RecorderSettings) -> Path:
    """Path of the recording. The file name defaults to one made of the robot's name and the time."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%d-%H%M%S")
    name = options.file or f"presage-{options.robot}-{stamp}.mcap"
    return options.directory / (name if name.endswith(".mcap") else name + ".mcap")


def write_description(writer: RecordingWriter | PartsWriter, service: str, reply: DescriptionReply) -> None:
    """Writes a service's reply as the metadata and attachments of `description_records`."""
    for record in description_records(service, reply):
        if isinstance(record, MetadataRecord):
            writer.metadata(record.name, record.values)
        else:
            writer.attachment(record.name, record.data, record.media_type, time.time_ns())
