"""Reading a recording: raw payloads or decoded messages, metadata, the world; unfinished files as far as they go."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from mcap.records import Attachment, Channel, Header, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from pydantic import ValidationError

from common.errors import UserError
from common.messages import Stamped
from common.robot import Robot
from common.topics import Topic, topic_of
from common.wire import DecodeError
from common.world import NOT_YAML, World
from services.recorder.writer import PROFILE

MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class Raw:
    """One payload of a file, with its times in ns of the wall clock."""

    key: str
    payload: bytes
    published_ns: int
    logged_ns: int


@dataclass
class Recording:
    """A recording, all of it in memory, in the order it was received; `problem` says what cut it short, if anything."""

    path: Path
    raw: list[Raw] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # of each name the last
    attachments: dict[str, bytes] = field(default_factory=dict)  # of each name the last
    problem: str = "its end is missing"
    undecodable: Counter[str] = field(default_factory=Counter)  # by key, of the last pass of `messages`
    profile: str = ""
    _keys: dict[int, str] = field(default_factory=dict)  # by channel

    @property
    def complete(self) -> bool:
        """Whether the file was finished and is whole."""
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
        return f"{self.path}: incomplete ({self.problem}): {why}; the {len(self.raw)} messages before that are used"

    def messages(self, *topics: Topic) -> Iterator[tuple[Topic, Stamped, Raw]]:
        """Decoded messages of the topics (none: all) beside their bytes; the undecodable are counted and left out."""
        self.undecodable.clear()
        for raw in self.raw:
            topic = topic_of(raw.key)
            if topic is None or (topics and topic not in topics):
                continue
            try:
                yield topic, topic.message.decode(raw.payload), raw
            except DecodeError:
                self.undecodable[raw.key] += 1

    def counts(self) -> Counter[str]:
        """Messages by key."""
        return Counter(raw.key for raw in self.raw)

    def world(self) -> World | None:
        """The world the session ran in, where it was recorded."""
        text = self.attachments.get("world.yaml")
        try:
            return World.model_validate(yaml.safe_load(text)) if text is not None else None
        except NOT_YAML:  # a ValidationError is a ValueError too
            return None

    def robot(self) -> Robot:
        """The base that was driven; the default one where it was not recorded."""
        try:
            return Robot.model_validate_json(self.metadata.get("world", {}).get("robot", "{}"))
        except ValidationError:
            return Robot()


def read_recording(path: Path) -> Recording:
    """All of a file; raises UserError where it is missing or no recording. A torn file gives its complete chunks."""
    recording = Recording(path)
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise UserError(f"{path}: not an MCAP file; `presage record` and `presage demo` make recordings")
            stream.seek(0)
            reader = StreamReader(stream, validate_crcs=True, record_size_limit=path.stat().st_size)
            try:
                for record in reader.records:
                    _take(recording, record)
                recording.problem = ""
            except Exception as error:  # noqa: BLE001 - a torn or damaged chunk raises kinds of each decompressor
                recording.problem = "its end is missing" if "End" in type(error).__name__ else f"damaged: {error}"
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); recordings are named NAME.mcap") from None
    if recording.profile not in {"", PROFILE} and not any(topic_of(key) for key in recording._keys.values()):  # noqa: SLF001
        raise UserError(f"{path}: an MCAP file, but no recording of presage (its profile is {recording.profile!r})")
    recording.raw.sort(key=lambda raw: raw.logged_ns)  # stable: equal times keep the file's order
    return recording


def _take(recording: Recording, record: object) -> None:
    if isinstance(record, Header):
        recording.profile = record.profile
    elif isinstance(record, Channel):
        recording._keys[record.id] = record.topic  # noqa: SLF001 - the recording's own half
    elif isinstance(record, Metadata):
        recording.metadata[record.name] = dict(record.metadata)
    elif isinstance(record, Attachment):
        recording.attachments[record.name] = record.data
    elif isinstance(record, McapMessage):
        key = recording._keys[record.channel_id]  # noqa: SLF001
        recording.raw.append(Raw(key, record.data, record.publish_time, record.log_time))
