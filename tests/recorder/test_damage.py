"""Damaged or hostile files and full disks: damage is noticed, and memory stays bounded."""

from __future__ import annotations

import time
import tracemalloc

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer, Header
from rich.console import Console

from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.requests import RecordRequest
from common.messages.topics import RECORDING
from common.runtime.service import ServiceLoop
from presage.recordings.info import collect_facts
from presage.recordings.printing import info
from services.recorder import recording
from services.recorder.files.chunks import MAGIC, MAX_CHUNK_BYTES
from services.recorder.files.writer import PROFILE, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recording import OpenRecording
from services.recorder.recover import recover
from services.recorder.service import RecorderService
from services.recorder.settings import RecorderSettings
from tests.process_replay.harness import FakeBus
from tests.recorder.sessions import on_full_disk
from tests.recorder.test_recover import COMPRESSIONS, SENT, damaged, message, messages_in, write_chunks


@given(bit=st.integers(0, 1 << 20), compression=COMPRESSIONS)
def test_info_notices_each_bit(tmp_path_factory, bit, compression):
    path, _ = write_chunks(tmp_path_factory.mktemp("flipped"), compression, closed=True)
    bad = damaged(path, bit // 8 % path.stat().st_size, bytes([1 << bit % 8]))
    try:
        facts = collect_facts(read_recording(bad), check=True)
    except UserError as error:
        assert "presage recover" in str(error)  # noqa: PT017
        return
    assert not facts.complete
    assert "presage recover" in facts.warning


def test_info_of_a_damaged_index(tmp_path):
    path, _ = write_chunks(tmp_path, closed=True)
    bad = damaged(path, path.stat().st_size - 60)
    console = Console(width=200)
    with console.capture() as shown:
        assert info(bad, None, None, console) == 1
    assert "INCOMPLETE" in shown.get()
    assert "presage recover" in shown.get()
    assert "checksums are correct" not in shown.get()
    assert messages_in(bad) == SENT


def test_index_damaged_after_opening(tmp_path):
    path, _ = write_chunks(tmp_path, closed=True)
    recording = read_recording(path)
    recording.path = damaged(path, path.stat().st_size - 60)
    assert list(recording.payloads()) == []
    assert "its index is damaged" in recording.problem


def bomb(path, compression, stated):
    """A recording whose only chunk unpacks to 256 MiB of zeros; ``stated`` replaces its stated size."""
    size, piece = 1 << 28, bytes(1 << 20)
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        packed = b"".join(packer.compress(piece) for _ in range(size >> 20)) + packer.flush()
    else:
        packer = lz4.frame.LZ4FrameCompressor()
        packed = packer.begin() + b"".join(packer.compress(piece) for _ in range(size >> 20)) + packer.flush()
    builder = RecordBuilder()
    Header(PROFILE, "").write(builder)
    Chunk(compression, packed, 0, 0, 0, stated or size).write(builder)
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    path.write_bytes(MAGIC + builder.end() + MAGIC)
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("stated", [0, 1000], ids=["true size", "wrong size"])
def test_huge_chunk(tmp_path, compression, stated):
    path = bomb(tmp_path / "bomb.mcap", compression, stated)
    tracemalloc.start()
    try:
        recording = read_recording(path)
        assert list(recording.payloads()) == []
        assert "damaged" in recording.problem
        with pytest.raises(UserError, match="no message in it can be recovered"):
            recover(path)
        assert tracemalloc.get_traced_memory()[1] < 4 * MAX_CHUNK_BYTES
    finally:
        tracemalloc.stop()


def test_losses_on_a_full_disk(tmp_path, small_chunks):
    inbox = Inbox()
    session = OpenRecording(RecorderSettings(directory=tmp_path, compression="none"), (), inbox)
    part = on_full_disk(session.writer.part, 40_000)
    for number in range(200):
        topic, payload = message(number)
        inbox.put(Sample(topic, topic.key("robot"), payload, number, number))

    def write_all():
        while (sample := inbox.get(0)) is not None:
            session.write(sample)

    with pytest.raises(UserError, match="No space left"):
        write_all()
    session.writer.finish()
    recovered = recover(part.active).messages.total()
    assert recovered > 0
    assert (session.writer.saved, session.not_in_file()) == (recovered, 200 - recovered)


def test_full_disk_from_the_beginning(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "RecordingWriter", lambda *args: on_full_disk(RecordingWriter(*args), 0))
    with pytest.raises(UserError, match=r"No space left.* it holds no message: free some space"):
        OpenRecording(RecorderSettings(directory=tmp_path), (), Inbox())
    assert list(tmp_path.iterdir()) == []


def test_full_disk_of_a_recorder_on_request(tmp_path, small_chunks):
    service = RecorderService(RecorderSettings(directory=tmp_path, idle=True, compression="none"))
    loop = ServiceLoop(service, FakeBus(), Inbox())
    service.open()
    assert service.on_request(RECORDING, RecordRequest(action="start")).recording
    on_full_disk(service.recording.writer.part, 40_000)
    sent = 0
    while service.recording is not None:
        topic, payload = message(sent)
        service.on_sample(Sample(topic, topic.key("robot"), payload, sent, sent))
        sent += 1
    assert service.counters["written"] == sent - 1  # without the one that failed
    assert "No space left" in service.note
    service.on_timer()
    assert service.on_request(RECORDING, RecordRequest(action="start")).recording
    assert not service.note
    service.close()
    assert loop.failed == 0


def test_clock_that_is_set(tmp_path, monkeypatch):
    inbox, began_ns = Inbox(), time.time_ns()
    session = OpenRecording(RecorderSettings(directory=tmp_path), (), inbox)
    monkeypatch.setattr(time, "time_ns", lambda: began_ns - 10**12)
    received = [time.monotonic_ns() + number * 10**8 for number in range(20)]
    for number, received_ns in enumerate(received):
        topic, payload = message(number)
        session.write(Sample(topic, topic.key("robot"), payload, 0, received_ns))
    (path,) = session.writer.finish()
    logged = [raw.logged_ns for raw in read_recording(path).payloads()]
    assert began_ns <= logged[0] < began_ns + 60 * 10**9
    assert np.diff(logged).tolist() == np.diff(received).tolist()
