"""Recordings and exports read by mcap's own two readers, with checksums, and by one that shares nothing with them."""

from __future__ import annotations

import struct

import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from rich.console import Console

from common.messages.topics import SCAN, TOPICS, TRUTH
from presage.recordings.foxglove import export_foxglove
from services.recorder.files.parts import Limits, PartsWriter
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recover import recover
from tests.lab.navigation import drives as driven
from tests.presage.recordings.mcap_by_specification import read
from tests.recorder import sessions as made


def by_mcap(path, reader):
    """Messages as they stand, metadata and attachments, checksums compared."""
    with path.open("rb") as stream:
        messages = [
            (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]
    with path.open("rb") as stream:
        metadata = [(m.name, m.metadata) for m in reader(stream, validate_crcs=True).iter_metadata()]
    with path.open("rb") as stream:
        attachments = [(a.name, a.media_type, a.data) for a in reader(stream, validate_crcs=True).iter_attachments()]
    return messages, metadata, attachments


def agree(path):
    """All three readers find the same; the contents."""
    ours = read(path)
    for reader in (SeekingReader, NonSeekingReader):
        messages, metadata, attachments = by_mcap(path, reader)
        assert messages == ours.messages
        assert sorted(metadata, key=str) == sorted(ours.metadata, key=str)
        assert attachments == ours.attachments
    return ours


def test_a_finished_recording(tmp_path):
    found = agree(made.write(tmp_path / "run.mcap"))
    assert (found.profile, found.library) == ("presage", "presage recorder")
    wanted = sorted(
        (topic.key("robot", service), at, message.encode()) for topic, service, message, at in made.events()
    )
    assert sorted((key, logged, data) for key, _, logged, _, data in found.messages) == wanted
    assert {schema[1] for schema in found.schemas.values()} == {"jsonschema"}


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_many_chunks_of_every_compression(tmp_path, compression):
    writer = RecordingWriter(tmp_path / "run.mcap", compression, chunk_size=1024)
    for number in range(200):
        topic = TOPICS[number % len(TOPICS)]
        writer.write(topic, topic.key("r", "me"), bytes([number]) * (number % 90), 5 * number, 7 * number)
        if number % 50 == 49:
            writer.flush()
    found = agree(writer.finish())
    assert found.chunks > 5
    assert [data for *_, data in found.messages] == [bytes([n]) * (n % 90) for n in range(200)]


def test_a_recording_of_nothing(tmp_path):
    assert agree(driven.write(tmp_path / "run.mcap", *TOPICS, world=False)).messages == []


def test_every_part_of_a_split_recording(tmp_path):
    parts = PartsWriter(
        lambda number: RecordingWriter(tmp_path / f"run-{number}.mcap"),
        Limits(seconds=0.4),
        lambda: {"end": {"a": "b"}},
    )
    parts.metadata("presage", {"robot": "rob"})
    parts.attachment("note.txt", b"a note", "text/plain", 1)
    sent = [(key, message.encode(), at) for _, key, message, at in driven.events()]
    for (topic, *_), (key, data, at) in zip(driven.events(), sent, strict=True):
        parts.write(topic, key, data, at, at)
    found = [agree(path) for path in parts.finish()]
    assert len(found) == 3
    assert [(m[0], m[4], m[2]) for part in found for m in part.messages] == sent
    for part in found:
        assert dict(part.metadata)["presage"] == {"robot": "rob"}
        assert [name for name, *_ in part.attachments] == ["note.txt"]


@pytest.mark.parametrize("lost", [1, 40, 3000], ids=lambda lost: f"{lost} bytes cut off")
def test_a_recovered_recording(tmp_path, lost):
    writer = RecordingWriter(tmp_path / "run.mcap", chunk_size=1024)
    writer.metadata("presage", {"robot": "rob"})
    for topic, key, message, at in driven.events():
        writer.write(topic, key, message.encode(), at, at)
    path = writer.finish()
    path.write_bytes(path.read_bytes()[:-lost])
    found = agree(recover(path).path)
    keys = [key for _, key, _, _ in driven.events()]
    assert [message[0] for message in found.messages] == keys[: len(found.messages)]
    assert len(found.messages) > len(keys) / 2
    assert dict(found.metadata)["presage"] == {"robot": "rob"}


def test_an_export_for_viewers(tmp_path):
    recording = read_recording(driven.write(tmp_path / "run.mcap"))
    export_foxglove(recording, tmp_path / "view.mcap", "", Console(quiet=True), force=False)
    found = agree(tmp_path / "view.mcap")
    assert {schema[1] for schema in found.schemas.values()} == {"protobuf", "jsonschema"}
    assert "export" in dict(found.metadata)


def payload(path):
    """Where the bytes of the fourth truth stand in an uncompressed file."""
    messages = [message.encode() for topic, _, message, _ in driven.events() if topic == TRUTH]
    return path.read_bytes().find(messages[3])


def changed(path, at, byte):
    data = bytearray(path.read_bytes())
    data[at] = byte
    path.write_bytes(data)


@pytest.mark.parametrize("where", ["payload", "footer", "statistics"])
def test_our_own_reader_is_hard_to_please(tmp_path, where):
    """A reader that accepts everything would prove nothing."""
    writer = RecordingWriter(tmp_path / "run.mcap", "none")
    for topic, key, message, at in driven.events():
        if topic in {TRUTH, SCAN}:
            writer.write(topic, key, message.encode(), at, at)
    path = writer.finish()
    read(path)
    data = path.read_bytes()
    summary = struct.unpack_from("<Q", data, len(data) - 8 - 20)[0]
    at = {"payload": payload(path) + 20, "footer": len(data) - 8 - 20, "statistics": summary + 30}[where]
    changed(path, at, data[at] ^ 1)
    with pytest.raises((AssertionError, struct.error)):
        read(path)
