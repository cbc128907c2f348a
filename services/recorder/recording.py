"""One recording from start to end, with its counters."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterable
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

from common.bus.inbox import Inbox, Sample, is_message_counter
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
        self, options: RecorderSettings, topics: Iterable[Topic], inbox: Inbox, *, may_rename: bool = False
    ) -> None:
        """Opens the file. ``may_rename`` appends a number to a name chosen by the user if it is taken.

        The metadata known so far is written first, so that it is readable even in a file that is never finished.
        """
        self.message_counts = MessageCounts()
        self._inbox, self._before, self._began = inbox, inbox.handled_counts(), time.monotonic()
        # Log times are wall time at the opening and monotonic time from there, so that setting the system clock does
        # not change the times between messages.
        self._clock_ns = time.time_ns() - time.monotonic_ns()
        self._logged_ns = 0  # log time of the last message
        path, first = open_first_part(options, may_rename=may_rename)
        limits = PartLimits(int(options.split_size * 1e6), options.split_minutes * 60)
        writer = self.writer = PartsWriter(first, partial(open_part, options, path), limits, self._counters)
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
        return [{key: n for key, n in counts.items() if is_message_counter(key)} for counts in since]

    def _counters(self) -> dict[str, dict[str, str]]:
        return {"counters": as_metadata(self._counts())}


def open_first_part(options: RecorderSettings, *, may_rename: bool = False) -> tuple[Path, RecordingWriter]:
    """Opens the first part under a free name. Returns the path without the number of a part, and the writer.

    If the name is taken, a number is appended to a generated name, or to any with ``may_rename``. Otherwise raises
    NameTakenError.
    """
    wanted = file_path(options)
    for number in itertools.count(1):
        path = wanted if number == 1 else wanted.with_stem(f"{wanted.stem}-{number}")
        try:
            return path, open_part(options, path, 1)
        except NameTakenError:
            if options.file and not may_rename:
                raise
    raise AssertionError


def open_part(options: RecorderSettings, path: Path, part: int) -> RecordingWriter:
    """Opens NAME.mcap, or NAME-001.mcap, NAME-002.mcap, ... if the recording is split. Raises NameTakenError."""
    if options.split_size or options.split_minutes:
        if part == 1:
            check_no_parts(path)
        path = path.with_stem(f"{path.stem}-{part:03d}")
    return RecordingWriter(path, options.compression)


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
