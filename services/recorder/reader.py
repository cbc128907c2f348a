"""Reads recordings, complete or not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, Header, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from pydantic import ValidationError

from common.errors import UserError
from common.geometry.world import NOT_YAML, World
from common.geometry.yaml_text import parse_yaml
from common.messages.definitions import Stamped
from common.messages.topics import Topic, topic_of
from common.messages.wire import DecodeError
from common.robot.base import Robot
from common.robot.scanner import Scanner
from services.recorder.files.chunks import MAGIC, records_of
from services.recorder.files.index import in_order, summary_of
from services.recorder.files.writer import PROFILE


@dataclass(frozen=True)
class Raw:
    """One payload of a file, with its times in ns of the wall clock."""

    key: str
    payload: bytes
    published_ns: int
    logged_ns: int


@dataclass
class Recording:
    """A recording on disk; payloads are read when asked for. `problem` says what cut it short, if anything.

    Damage inside a finished file is found where it is read: ask for `problem` after the messages.
    """

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # of each name the last
    attachments: dict[str, bytes] = field(default_factory=dict)  # of each name the last
    problem: str = ""
    undecodable: Counter[str] = field(default_factory=Counter)  # by key, of the last pass of `messages`
    profile: str = ""
    start_ns: int = 0  # reception of the first message, wall clock
    end_ns: int = 0  # and of the last
    _counts: Counter[str] = field(default_factory=Counter)  # by key
    _finished: bool = False  # there is an index

    @property
    def complete(self) -> bool:
        """Whether the file was finished and, as far as it was read, is whole."""
        return not self.problem

    @property
    def warning(self) -> str:
        """One line for the user where the file is not complete; else empty."""
        if self.complete:
            return ""
        why = (
            "the recorder still writes, or was killed"
            if self.path.suffix == ".active"
            else "it is cut short or damaged"
        )
        readable = "what comes" if self._finished else f"the {sum(self._counts.values())} messages"
        return (
            f"{self.path}: incomplete ({self.problem}): {why}; {readable} before that can be used, and "
            "`presage recover` makes a whole file of what is readable"
        )

    def payloads(
        self, keys: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Raw]:
        """Those of some keys (None: all), from ``start_ns`` to before ``end_ns`` of the wall clock, as received.

        A chunk at a time is in memory. Ends at the first damage, and `problem` then says what it is.
        """
        try:
            with self.path.open("rb") as stream:
                for channel, message in (self._indexed if self._finished else self._torn)(
                    stream, keys, start_ns, end_ns
                ):
                    yield Raw(channel.topic, message.data, message.publish_time, message.log_time)
        except OSError as error:
            raise _unreadable(self.path, error) from None

    @property
    def indexed(self) -> bool:
        """Whether it was finished: damage is then found only where it is read."""
        return self._finished

    @property
    def raw(self) -> list[Raw]:
        """All of it at once, for short recordings."""
        return list(self.payloads())

    def messages(self, *topics: Topic) -> Iterator[tuple[Topic, Stamped, Raw]]:
        """Decoded messages of the topics (none: all) beside their bytes; the undecodable are counted and left out."""
        self.undecodable.clear()
        rows = {key: topic for key in self._counts if (topic := topic_of(key)) and (not topics or topic in topics)}
        for raw in self.payloads(rows.keys()):
            try:
                yield rows[raw.key], rows[raw.key].message.decode(raw.payload), raw
            except DecodeError:
                self.undecodable[raw.key] += 1

    def counts(self) -> Counter[str]:
        """Messages by key."""
        return Counter(self._counts)

    def topics(self) -> dict[str, Topic]:
        """The rows of the table that are in it, by key."""
        return {key: topic for key in sorted(self._counts) if (topic := topic_of(key)) is not None}

    def world(self) -> World | None:
        """The world the session ran in, where it was recorded."""
        text = self.attachments.get("world.yaml")
        try:
            return World.model_validate(parse_yaml(text)) if text is not None else None
        except NOT_YAML:  # a ValidationError is a ValueError too
            return None

    def robot(self) -> Robot:
        """The base that was driven; the default one where it was not recorded."""
        try:
            return Robot.model_validate_json(self.metadata.get("world", {}).get("robot", "{}"))
        except ValidationError:
            return Robot()

    def scanner(self) -> Scanner | None:
        """The scanner that was read, where it was recorded."""
        try:
            return Scanner.model_validate_json(self.metadata.get("world", {}).get("scanner", ""))
        except ValidationError:
            return None

    def verify(self) -> None:
        """Compare the checksum of all that is before the summary; `problem` is set where it is wrong.

        Reads the whole file. Recorders of before this checksum wrote none, and then only records are looked at.
        """
        if not self.problem:
            with self.path.open("rb") as stream:
                for _ in _records(self, stream, chunks=False):
                    pass

    def _indexed(
        self, stream: BinaryIO, keys: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[Channel, McapMessage]]:
        try:
            if (summary := SeekingReader(stream).get_summary()) is not None:
                yield from in_order(stream, summary, keys, start_ns, end_ns)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - a damaged chunk raises kinds of each decompressor
            self.problem = f"damaged: {error}"

    def _torn(
        self, stream: BinaryIO, keys: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[Channel, McapMessage]]:
        channels: dict[int, Channel] = {}
        for record in _records(self, stream):
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                channel, at = channels.get(record.channel_id), record.log_time
                if channel is None or (keys is not None and channel.topic not in keys):
                    continue
                if (start_ns is None or at >= start_ns) and (end_ns is None or at < end_ns):
                    yield channel, record


def read_recording(path: Path) -> Recording:
    """Open a file; raises UserError where it is missing or no recording. A torn file gives its complete chunks."""
    recording = Recording(path)
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise UserError(
                    f"{path}: not an MCAP file, or its first bytes are damaged; `presage record` makes recordings, "
                    "`presage import` of logs, and `presage recover` a whole one of a damaged one"
                )
            if not _read_summary(recording, stream):
                _read_through(recording, stream)
    except OSError as error:
        raise _unreadable(path, error) from None
    if recording.profile not in {"", PROFILE} and not recording.topics():
        raise UserError(
            f"{path}: an MCAP file, but no recording of presage (its profile is {recording.profile!r}); of a ROS 2 "
            "bag `presage import` makes one"
        )
    return recording


def _read_summary(recording: Recording, stream: BinaryIO) -> bool:
    """From the index of a finished file; False where there is none that can be trusted."""
    try:
        summary = summary_of(stream)
        if summary is None or summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        stream.seek(0)
        reader = SeekingReader(stream, record_size_limit=recording.path.stat().st_size)
        recording.profile = reader.get_header().profile
        for metadata in reader.iter_metadata():
            recording.metadata[metadata.name] = dict(metadata.metadata)
        for attachment in reader.iter_attachments():
            recording.attachments[attachment.name] = attachment.data
        for number, count in summary.statistics.channel_message_counts.items():
            recording._counts[summary.channels[number].topic] += count  # noqa: SLF001 - the recording's own half
        recording.start_ns, recording.end_ns = (
            summary.statistics.message_start_time,
            summary.statistics.message_end_time,
        )
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever a torn or damaged end makes of it
        recording.metadata, recording.attachments, recording._counts = {}, {}, Counter()  # noqa: SLF001
        recording.problem = str(error) if isinstance(error, ValueError) else "its index is damaged"
        return False
    recording._finished = True  # noqa: SLF001
    return True


def _read_through(recording: Recording, stream: BinaryIO) -> None:
    """From the beginning, as far as it goes."""
    keys: dict[int, str] = {}
    for record in _records(recording, stream):
        if isinstance(record, Header):
            recording.profile = record.profile
        elif isinstance(record, Channel):
            keys[record.id] = record.topic
        elif isinstance(record, Metadata):
            recording.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Attachment):
            recording.attachments[record.name] = record.data
        elif isinstance(record, McapMessage) and record.channel_id in keys:
            if not recording._counts:  # noqa: SLF001
                recording.start_ns = record.log_time
            recording._counts[keys[record.channel_id]] += 1  # noqa: SLF001
            recording.end_ns = max(recording.end_ns, record.log_time)


def _records(recording: Recording, stream: BinaryIO, *, chunks: bool = True) -> Iterator[object]:
    """Until the end or the first damage, which is noted; a record longer than the file is damage.

    With ``chunks`` what is in chunks comes in their place.
    """
    stream.seek(0)
    size = recording.path.stat().st_size
    try:
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size).records:
            if chunks and isinstance(record, Chunk):
                yield from records_of(record)
            else:
                yield record
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - a torn or damaged chunk raises kinds of each decompressor
        recording.problem = "its end is missing" if "End" in type(error).__name__ else f"damaged: {error}"


def _unreadable(path: Path, error: OSError) -> UserError:
    return UserError(f"{path}: cannot be read ({error.strerror}); recordings are named NAME.mcap")
