"""Reads recordings, complete or not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, Header, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from pydantic import ValidationError

from common.errors import UserError
from common.geometry.world import World
from common.messages.definitions import Stamped
from common.messages.topics import Topic, topic_of
from common.messages.wire import DecodeError
from common.robot.robot import Robot
from common.robot.scanner import Scanner
from common.yaml_text import NOT_YAML, parse_yaml
from services.recorder.files.chunks import MAGIC, unpacked_records
from services.recorder.files.index import messages_in_order, summary_of
from services.recorder.files.writer import PROFILE


@dataclass(frozen=True)
class RawMessage:
    """One recorded payload with its wall-clock times, in ns."""

    key: str
    payload: bytes
    published_ns: int
    logged_ns: int


@dataclass
class Recording:
    """A recording on disk. Payloads are read on demand.

    `problem` describes why the file is incomplete, or is empty. Damage inside a finished file is only found when that
    part is read, so check `problem` after reading the messages.
    """

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # by name; the last record of each name
    attachments: dict[str, bytes] = field(default_factory=dict)  # by name; the last one of each name
    problem: str = ""
    undecodable: Counter[str] = field(default_factory=Counter)  # by key, in the last call of `messages`
    profile: str = ""
    start_ns: int = 0  # wall time at which the first message was received
    end_ns: int = 0  # wall time at which the last message was received
    counts: Counter[str] = field(default_factory=Counter)  # messages by key
    indexed: bool = False  # the file has a valid index, so damage is only found when the damaged part is read

    @property
    def complete(self) -> bool:
        """Whether the file was finished and no damage has been found in the parts read so far."""
        return not self.problem

    @property
    def warning(self) -> str:
        """One line for the user if the file is incomplete, else an empty string."""
        if self.complete:
            return ""
        consequence = (
            "the recorder is still writing it, or was killed"
            if self.path.suffix == ".active"
            else "it is cut short or damaged"
        )
        readable = "the messages" if self.indexed else f"the {sum(self.counts.values())} messages"
        return (
            f"{self.path}: incomplete ({self.problem}): {consequence}; {readable} before that can be used, and "
            "`presage recover` writes a complete file from the readable part"
        )

    def payloads(
        self, keys: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yields the payloads in the order in which they were received.

        ``keys`` defaults to all keys. ``start_ns`` (included) and ``end_ns`` (excluded) are wall times of reception.
        One chunk at a time is held in memory. Stops at the first damaged place, which `problem` then describes.
        """
        try:
            read = self._read_indexed if self.indexed else self._read_unindexed
            with self.path.open("rb") as stream:
                for channel, message in read(stream, keys, start_ns, end_ns):
                    yield RawMessage(channel.topic, message.data, message.publish_time, message.log_time)
        except OSError as error:
            raise _unreadable(self.path, error) from None

    def messages(self, *topics: Topic) -> Iterator[tuple[Topic, Stamped, RawMessage]]:
        """Yields topic, decoded message and payload. Defaults to all topics.

        Payloads that cannot be decoded are skipped and counted in `undecodable`.
        """
        self.undecodable.clear()
        rows = {key: topic for key in self.counts if (topic := topic_of(key)) and (not topics or topic in topics)}
        for raw in self.payloads(rows.keys()):
            try:
                yield rows[raw.key], rows[raw.key].message.decode(raw.payload), raw
            except DecodeError:
                self.undecodable[raw.key] += 1

    def topics(self) -> dict[str, Topic]:
        """Topics of the recording, by key. Keys that are not in the table of topics are left out."""
        return {key: topic for key in sorted(self.counts) if (topic := topic_of(key)) is not None}

    def world(self) -> World | None:
        """The simulator's world, or without a simulator the estimator's map.

        Returns None if neither was recorded, or if it is invalid.
        """
        text = self.attachments.get("world.yaml", self.attachments.get("model/world.yaml"))
        try:
            return World.model_validate(parse_yaml(text)) if text is not None else None
        except NOT_YAML:  # a ValidationError is a ValueError too
            return None

    def robot(self) -> Robot:
        """The mobile base of the session, or the default one if it was not recorded."""
        try:
            return Robot.model_validate_json(self.metadata.get("world", {}).get("robot", "{}"))
        except ValidationError:
            return Robot()

    def scanner(self) -> Scanner | None:
        """The scanner of the session. Returns None if it was not recorded."""
        try:
            return Scanner.model_validate_json(self.metadata.get("world", {}).get("scanner", ""))
        except ValidationError:
            return None

    def verify(self) -> None:
        """Checks the checksum of the data section and sets `problem` if it is wrong.

        Reads the whole file. Files from older recorders have no such checksum; then only the records are parsed.
        """
        if not self.problem:
            with self.path.open("rb") as stream:
                for _ in _records(self, stream, chunks=False):
                    pass

    def _read_indexed(
        self, stream: BinaryIO, keys: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[Channel, McapMessage]]:
        try:
            if (summary := summary_of(stream)) is not None:
                yield from messages_in_order(stream, summary, keys, start_ns, end_ns)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - each decompressor raises its own error types
            self.problem = f"damaged: {error}"

    def _read_unindexed(
        self, stream: BinaryIO, keys: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[Channel, McapMessage]]:
        channels: dict[int, Channel] = {}
        for record in _records(self, stream):
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                channel, log_time = channels.get(record.channel_id), record.log_time
                if channel is None or (keys is not None and channel.topic not in keys):
                    continue
                if (start_ns is None or log_time >= start_ns) and (end_ns is None or log_time < end_ns):
                    yield channel, record


def read_recording(path: Path) -> Recording:
    """Opens a recording. The complete chunks of an unfinished file can be read.

    Raises UserError if the file is missing or is not a recording.
    """
    recording = Recording(path)
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise UserError(
                    f"{path}: not an MCAP file, or its first bytes are damaged; `presage record` makes recordings, "
                    "`presage import` converts logs, and `presage recover` repairs a damaged recording"
                )
            if not _read_summary(recording, stream):
                _read_through(recording, stream)
    except OSError as error:
        raise _unreadable(path, error) from None
    if recording.profile not in {"", PROFILE} and not recording.topics():
        raise UserError(
            f"{path}: an MCAP file, but not a recording of presage (its profile is {recording.profile!r}); "
            "`presage import` converts a ROS 2 bag"
        )
    return recording


def _read_summary(recording: Recording, stream: BinaryIO) -> bool:
    """Fills ``recording`` from the file's index. Returns False if there is no valid index."""
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
            recording.counts[summary.channels[number].topic] += count
        recording.start_ns, recording.end_ns = (
            summary.statistics.message_start_time,
            summary.statistics.message_end_time,
        )
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged index can raise any error
        recording.metadata, recording.attachments, recording.counts = {}, {}, Counter()
        recording.problem = str(error) if isinstance(error, ValueError) else "its index is damaged"
        return False
    recording.indexed = True
    return True


def _read_through(recording: Recording, stream: BinaryIO) -> None:
    """Fills ``recording`` by reading the file from the beginning to the first damaged place."""
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
            if not recording.counts:
                recording.start_ns = record.log_time
            recording.counts[keys[record.channel_id]] += 1
            recording.end_ns = max(recording.end_ns, record.log_time)


def _records(recording: Recording, stream: BinaryIO, *, chunks: bool = True) -> Iterator[object]:
    """Yields records until the end or the first damaged place, which is stored in `Recording.problem`.

    A record that claims to be longer than the file counts as damaged. With ``chunks``, yields the records inside each
    chunk instead of the chunk itself.
    """
    stream.seek(0)
    size = recording.path.stat().st_size
    try:
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size).records:
            if chunks and isinstance(record, Chunk):
                yield from unpacked_records(record)
            else:
                yield record
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - each decompressor raises its own error types
        recording.problem = "its end is missing" if isinstance(error, EndOfFile) else f"damaged: {error}"


def _unreadable(path: Path, error: OSError) -> UserError:
    return UserError(f"{path}: cannot be read ({error.strerror}); recordings are named NAME.mcap")
