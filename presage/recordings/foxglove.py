"""An MCAP file for Foxglove and Lichtblick.

Schemas come from foxglove-schemas-protobuf, descriptors in the file from mcap-protobuf-support: both Foxglove's, small,
kept up. `presage/recordings/foxglove_session.py` says how times and frames are chosen; docs/foxglove-layout.json is a
layout for the channels written here.
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
from presage.recordings import plain_numbers as numbers
from presage.recordings.foxglove_session import Out, SessionView, driver_of, still_life
from presage.recordings.selection import entries, keys_of, refuse_to_overwrite, robot_of, tracked
from services.recorder.reader import Recording

CLOCK = "wall clock of the recording; a stamp's time is when its first sensor message was recorded"


class Channels:
    """Registers a channel when its first message comes."""

    def __init__(self, writer: Writer) -> None:
        self.counts: Counter[str] = Counter()  # by channel
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, out: Out) -> None:
        """One message."""
        if isinstance(out.content, Protobuf):
            data = out.content.SerializeToString()
        else:
            data = json.dumps(out.content, allow_nan=False).encode()
        number = self._channels.get(out.topic)
        if number is None:
            number = self._channels[out.topic] = self._declare(out)
        self._writer.add_message(number, out.log_ns, data, out.publish_ns, self.counts[out.topic])
        self.counts[out.topic] += 1

    def _declare(self, out: Out) -> int:
        if isinstance(out.content, Protobuf):
            name, encoding = out.content.DESCRIPTOR.full_name, "protobuf"
            data = build_file_descriptor_set(type(out.content)).SerializeToString()
        else:
            name, schema = numbers.schema_of(out.topic)
            encoding, data = "jsonschema", json.dumps(schema).encode()
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, encoding, data)
        return self._writer.register_channel(
            out.topic, "protobuf" if encoding == "protobuf" else "json", self._schemas[name]
        )


def export_foxglove(recording: Recording, out: Path, robot: str, console: Console, *, force: bool) -> dict[str, int]:
    """Write ``out``: messages by channel. What is under that name appears only when it is whole.

    Raises UserError where nothing can be written or something is there already and ``force`` is not given.
    """
    name = robot_of(recording, robot)
    refuse_to_overwrite([out], force=force)
    if out.exists() and out.samefile(recording.path):
        raise UserError(f"{out}: is the recording itself; choose another place with --out")
    if not keys_of(recording, name):
        raise UserError(f"{recording.path}: no message of presage in it, so there is nothing to export")
    unfinished = out.with_name(out.name + ".active")
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
    """All of it, in the order received."""
    keys, counts = keys_of(recording, robot), recording.counts()
    driver = driver_of({topic.name for topic in keys.values()})
    about = {"recording": recording.path.name, "robot": robot, "base_link is driven by": driver, "times": CLOCK}
    writer.add_metadata("export", {**about, **versions()})
    for title, record in recording.metadata.items():
        writer.add_metadata(title, record)
    for title, data in recording.attachments.items():
        if title.endswith(".yaml"):
            writer.add_attachment(recording.start_ns, recording.start_ns, title, "application/yaml", data)
    channels = Channels(writer)
    believed, true = _paths(recording, robot, console)
    for out in still_life(recording.world(), recording.robot(), believed, true, recording.start_ns):
        channels.write(out)
    view = SessionView(driver)
    total = sum(counts[key] for key in keys)
    for topic, message, raw in tracked(entries(recording, robot), total, "foxglove", console):
        for out in view.feed(topic, message, raw):
            channels.write(out)
    if view.left_out:
        rows = ", ".join(f"{count} of {name}" for name, count in view.left_out.items())
        console.print(f"left out, as Foxglove has no form for them here: {rows}", highlight=False, soft_wrap=True)
    return channels.counts


def _paths(recording: Recording, robot: str, console: Console) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) believed and (M, 3) true poses, read ahead so that the whole path can stand from the beginning."""
    believed, true = list[np.ndarray](), list[np.ndarray]()
    keys, counts = keys_of(recording, robot, BELIEF, TRUTH), recording.counts()
    found: Iterator[tuple[object, object, object]] = tracked(
        entries(recording, robot, BELIEF, TRUTH), sum(counts[key] for key in keys), "paths", console
    )
    for _, message, _ in found:
        if isinstance(message, Belief):
            believed.append(message.pose.array())
        elif isinstance(message, Truth):
            true.append(message.pose.array())
    return np.array(believed).reshape(-1, 3), np.array(true).reshape(-1, 3)
