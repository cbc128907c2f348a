"""Reading a recording: raw payloads or decoded messages, metadata, the world; unfinished files as far as they go."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from pydantic import ValidationError

from common.errors import UserError
from common.messages import Stamped
from common.topics import Topic, topic_of
from common.wire import DecodeError
from common.world import World


@dataclass(frozen=True)
class Raw:
    """One payload of a file."""

    key: str
    payload: bytes
    published_ns: int
    logged_ns: int


@dataclass
class Recording:
    """A recording in memory order of the file; `complete` is False where its end is missing."""

    path: Path
    raw: list[Raw] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    complete: bool = True
    undecodable: Counter[str] = field(default_factory=Counter)

    def messages(self, *topics: Topic) -> Iterator[tuple[Topic, Stamped]]:
        """Decoded messages of the topics (none: all), in the order they were logged; what is undecodable is counted."""
        self.undecodable.clear()
        for raw in self.raw:
            topic = topic_of(raw.key)
            if topic is None or (topics and topic not in topics):
                continue
            try:
                yield topic, topic.message.decode(raw.payload)
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
        except (yaml.YAMLError, ValidationError):
            return None


def read_recording(path: Path) -> Recording:
    """All of a file; raises UserError where it is missing or no MCAP. A torn file gives its complete chunks."""
    recording = Recording(path)
    channels: dict[int, Channel] = {}
    try:
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True).records:
                    _take(recording, channels, record)
            except (McapError, EOFError, ValueError) as error:
                if not channels and not recording.metadata:
                    raise UserError(f"{path}: not an MCAP file ({type(error).__name__})") from None
                recording.complete = False
            except Exception:  # the decompressors raise kinds of their own on a torn chunk
                recording.complete = False
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    recording.complete &= path.suffix != ".active"
    recording.raw.sort(key=lambda raw: raw.logged_ns)
    return recording


def _take(recording: Recording, channels: dict[int, Channel], record: object) -> None:
    if isinstance(record, Channel):
        channels[record.id] = record
    elif isinstance(record, Metadata):
        recording.metadata[record.name] = dict(record.metadata)
    elif isinstance(record, Attachment):
        recording.attachments[record.name] = record.data
    elif isinstance(record, McapMessage):
        key = channels[record.channel_id].topic
        recording.raw.append(Raw(key, record.data, record.publish_time, record.log_time))
