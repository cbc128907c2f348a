"""An MCAP file for Foxglove and Lichtblick.

The schemas come from foxglove-schemas-protobuf and their descriptors in the file from mcap-protobuf-support; both are
small packages maintained by Foxglove. `presage/recordings/foxglove_session.py` explains the choice of times and frames;
docs/foxglove-layout.json is a layout for the channels written here.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from google.protobuf.message import Message as Protobuf
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rich.console import Console

from common.errors import UserError
from common.messages.definitions import Belief, Truth
from common.messages.topics import BELIEF, TRUTH
from common.versions import versions
from presage.recordings import foxglove_numbers as numbers
from presage.recordings.foxglove_session import FoxgloveMessage, SessionConverter, pose_source_of, static_messages
from presage.recordings.selection import entries, keys_of, refuse_to_overwrite, robot_of, with_progress
from services.recorder.reader import Recording

CLOCK = "wall clock of the recording; a stamp's time is when its first sensor message was recorded"


class ChannelWriter:
    """Writes messages to the file; registers each channel when its first message comes."""

    def __init__(self, writer: Writer) -> None:
        self.counts: Counter[str] = Counter()  # by channel
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, message: FoxgloveMessage) -> None:
        """Writes one message."""
        if isinstance(message.content, Protobuf):
            data = message.content.SerializeToString()
        else:
            data = json.dumps(message.content, allow_nan=False).encode()
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._channels[message.topic] = self._register(message)
        self._writer.add_message(channel, message.log_ns, data, message.publish_ns, self.counts[message.topic])
        self.counts[message.topic] += 1

    def _register(self, message: FoxgloveMessage) -> int:
        if isinstance(message.content, Protobuf):
            name, encoding = message.content.DESCRIPTOR.full_name, "protobuf"
            data = build_file_descriptor_set(type(message.content)).SerializeToString()
        else:
            name, schema = numbers.schema_of(message.topic)
            encoding, data = "jsonschema", json.dumps(schema).encode()
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, encoding, data)
        return self._writer.register_channel(
            message.topic, "protobuf" if encoding == "protobuf" else "json", self._schemas[name]
        )


def export_foxglove(recording: Recording, out: Path, robot: str, console: Console, *, force: bool) -> dict[str, int]:
    """Writes the file ``out``; returns the number of messages by channel.

    The file appears under its name only when it is complete. Raises UserError if it cannot be written, or if it exists
    and ``force`` is not given.
    """
    name = robot_of(recording, robot)
    refuse_to_overwrite([out], force=force)
    if out.exists() and out.samefile(recording.path):
        raise UserError(f"{out}: is the recording itself; choose another place with --out")
    if not keys_of(recording, name):
        raise UserError(f"{recording.path}: no message of presage in it, so there is nothing to export")
    unfinished = out.with_name(out.name + ".partial")  # .active is the recorder's
    try:
        with unfinished.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD)
            writer.start("", "presage export")
            counts = _write(recording, name, writer, console)
            writer.finish()  # type: ignore[no-untyped-call]
        unfinished.replace(out)
    except OSError as error:
        raise UserError(f"{out}: cannot be written ({error.strerror}); choose another place with --out") from None
    finally:
        with suppress(OSError):
            unfinished.unlink()
    return dict(counts)


def _write(recording: Recording, robot: str, writer: Writer, console: Console) -> Counter[str]:
    """Writes all messages in the order of reception."""
    keys, counts = keys_of(recording, robot), recording.counts
    pose_source = pose_source_of({topic.name for topic in keys.values()})
    about = {"recording": recording.path.name, "robot": robot, "base_link is driven by": pose_source, "times": CLOCK}
    writer.add_metadata("export", {**about, **versions()})
    for title, record in recording.metadata.items():
        writer.add_metadata(title, record)
    for title, data in recording.attachments.items():
        if title.endswith(".yaml"):
            writer.add_attachment(recording.start_ns, recording.start_ns, title, "application/yaml", data)
    channels = ChannelWriter(writer)
    believed, true = _paths(recording, robot, console)
    for converted in static_messages(recording.world(), recording.robot(), believed, true, recording.start_ns):
        channels.write(converted)
    converter = SessionConverter(pose_source, recording.world())
    total = sum(counts[key] for key in keys)
    for topic, message, raw in with_progress(entries(recording, robot), total, "foxglove", console):
        for converted in converter.convert(topic, message, raw):
            channels.write(converted)
    if converter.left_out:
        rows = ", ".join(f"{count} of {name}" for name, count in converter.left_out.items())
        console.print(f"left out, because this export does not support them: {rows}", highlight=False, soft_wrap=True)
    return channels.counts


def _paths(recording: Recording, robot: str, console: Console) -> tuple[np.ndarray, np.ndarray]:
    """Believed poses (N, 3) and true poses (M, 3); the whole paths are shown from the beginning of the file."""
    believed, true = list[np.ndarray](), list[np.ndarray]()
    keys, counts = keys_of(recording, robot, BELIEF, TRUTH), recording.counts
    messages: Iterator[tuple[object, object, object]] = with_progress(
        entries(recording, robot, BELIEF, TRUTH), sum(counts[key] for key in keys), "paths", console
    )
    for _, message, _ in messages:
        if isinstance(message, Belief):
            believed.append(message.pose.array())
        elif isinstance(message, Truth):
            true.append(message.pose.array())
    return np.array(believed).reshape(-1, 3), np.array(true).reshape(-1, 3)
