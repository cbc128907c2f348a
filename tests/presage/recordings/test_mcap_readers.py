"""Recordings and exports are valid MCAP for mcap's own readers, with checksums."""

from __future__ import annotations

import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from rich.console import Console

from common.messages.topics import TOPICS
from presage.recordings.foxglove import export_foxglove
from services.recorder.files.parts import PartLimits, PartsWriter
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recover import recover
from tests.presage.recordings import artificial_session as driven

SENT = [(key, message.encode(), at) for _, key, message, at in driven.events()]


def fill(writer):
    writer.metadata("presage", {"robot": "rob"})
    writer.attachment("note.txt", b"a note", "text/plain", 1)
    for (topic, *_), (key, data, at) in zip(driven.events(), SENT, strict=True):
        writer.write(topic, key, data, at, at)
    return writer.finish()


def whole(folder, compression="zstd"):
    return [fill(RecordingWriter(folder / "run.mcap", compression, chunk_size=1024))]


def split(folder):
    def part(number):
        return RecordingWriter(folder / f"run-{number}.mcap")

    return fill(PartsWriter(part(1), part, PartLimits(seconds=0.4), lambda: {"end": {"a": "b"}}))


def recovered(folder):
    (path,) = whole(folder)
    path.write_bytes(path.read_bytes()[:-1])
    return [recover(path).path]


MAKERS = {
    "zstd": whole,
    "lz4": lambda folder: whole(folder, "lz4"),
    "uncompressed": lambda folder: whole(folder, "none"),
    "parts": split,
    "recovered": recovered,
}


def read(path, reader):
    """Messages, metadata and attachments."""
    with path.open("rb") as stream:
        messages = [
            (channel.topic, message.data, message.log_time)
            for _, channel, message in reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]
    with path.open("rb") as stream:
        metadata = {m.name: m.metadata for m in reader(stream).iter_metadata()}
    with path.open("rb") as stream:
        return messages, metadata, [a.name for a in reader(stream).iter_attachments()]


@pytest.mark.parametrize("reader", [SeekingReader, NonSeekingReader])
@pytest.mark.parametrize("maker", MAKERS)
def test_recording(tmp_path, maker, reader):
    found = [read(path, reader) for path in MAKERS[maker](tmp_path)]
    assert [message for messages, _, _ in found for message in messages] == SENT
    assert all(metadata["presage"] == {"robot": "rob"} for _, metadata, _ in found)
    assert all(attachments == ["note.txt"] for _, _, attachments in found)
    assert (len(found) > 1) == (maker == "parts")


def test_empty_recording(tmp_path):
    assert read(driven.write(tmp_path / "run.mcap", *TOPICS, world=False), SeekingReader)[0] == []


@pytest.mark.parametrize("reader", [SeekingReader, NonSeekingReader])
def test_export(tmp_path, reader):
    recording = read_recording(driven.write(tmp_path / "run.mcap"))
    counts = export_foxglove(recording, tmp_path / "view.mcap", "", Console(quiet=True), force=False)
    messages, metadata, _ = read(tmp_path / "view.mcap", reader)
    assert len(messages) == sum(counts.values())
    assert "export" in metadata
