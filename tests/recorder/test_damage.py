"""Damaged or hostile files: intact chunks are kept, losses are counted, and memory stays bounded."""

from __future__ import annotations

import errno
import itertools
import tracemalloc

import lz4.frame
import pytest
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer, Header
from mcap.writer import Writer
from rich.console import Console

from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.definitions import CmdVel, Pose, Truth, Twist
from common.messages.topics import CMD_VEL, TRUTH
from presage.recordings.info import survey
from presage.recordings.printing import info
from services.recorder.files.chunks import COMPRESSION, MAGIC, MAX_CHUNK_BYTES
from services.recorder.files.writer import PROFILE, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recording import OpenRecording
from services.recorder.recover import recover
from services.recorder.settings import RecorderSettings

CHUNKS = 6
EACH = 4  # messages per chunk, alternating between two channels
KINDS = st.sampled_from(["zstd", "lz4", "none"])


def message(number):
    if number % 2:
        return CMD_VEL, CmdVel(stamp_ns=number, seq=number // 2, twist=Twist(vx=0.1)).encode()
    return TRUTH, Truth(stamp_ns=number, seq=number // 2, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


SENT = [(topic.key("r"), payload) for topic, payload in map(message, range(CHUNKS * EACH))]


def recording(folder, compression="zstd", *, closed=True):
    """A session in chunks, with metadata and an attachment between them."""
    writer = RecordingWriter(folder / "run.mcap", compression)
    writer.metadata("presage", {"robot": "r"})
    for number in range(CHUNKS * EACH):
        topic, payload = message(number)
        writer.write(topic, topic.key("r"), payload, number, number)
        if number % EACH == EACH - 1:
            writer.flush()
            writer.attachment(f"note {number}", b"text", "text/plain", 1)
    if closed:
        return writer.finish()
    writer._stream.close()
    return writer.active


def flipped(folder, path, bit):
    data = bytearray(path.read_bytes())
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    (folder / "bad.mcap").write_bytes(data)
    return folder / "bad.mcap"


def chunks_lost(path):
    """Number of missing chunks. Asserts that the others are unchanged."""
    got = [(raw.key, raw.payload) for raw in read_recording(path).payloads()]
    kept = [SENT[n : n + EACH] for n in range(0, len(SENT), EACH) if SENT[n] in got]
    assert got == list(itertools.chain(*kept))
    return CHUNKS - len(kept)


@given(bit=st.integers(0, 1 << 20), compression=KINDS, closed=st.booleans())
@example(bit=0, compression="zstd", closed=False)
@example(bit=70, compression="zstd", closed=False)
def test_one_bit_costs_one_chunk_at_most(tmp_path_factory, bit, compression, closed):
    folder = tmp_path_factory.mktemp("flipped")
    bad = flipped(folder, recording(folder, compression, closed=closed), bit)
    assert chunks_lost(recover(bad).path) <= 1


@given(bit=st.integers(0, 1 << 20), compression=KINDS)
def test_info_notices_each_bit(tmp_path_factory, bit, compression):
    folder = tmp_path_factory.mktemp("flipped")
    bad = flipped(folder, recording(folder, compression), bit)
    try:
        facts = survey(read_recording(bad), check=True)
    except UserError as error:
        assert "presage recover" in str(error)  # noqa: PT017
        return
    assert not facts.complete
    assert "presage recover" in facts.warning


def test_info_of_a_damaged_index_suggests_recover(tmp_path):
    path = recording(tmp_path)
    data = bytearray(path.read_bytes())
    data[-60] ^= 1
    path.write_bytes(data)
    console = Console(width=200)
    with console.capture() as shown:
        assert info(path, None, None, console) == 1
    assert "INCOMPLETE" in shown.get()
    assert "presage recover" in shown.get()
    assert "checksums are correct" not in shown.get()
    assert [raw.payload for raw in read_recording(path).payloads()] == [payload for _, payload in SENT]


def by_mcap_alone(path, *, closed):
    """A recording that declares each channel only once. Returns the offset of its second chunk."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=COMPRESSION["none"])
        writer.start(PROFILE)
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channel, second = writer.register_channel(TRUTH.key("r"), "msgpack", schema), 0
        for number in range(0, CHUNKS * EACH, 2):
            writer.add_message(channel, number, message(number)[1], number)
            writer.flush()
            second = second or stream.tell()
        if closed:
            writer.finish()
    return second


@pytest.mark.parametrize("closed", [True, False], ids=["with its index", "without"])
def test_declarations_in_the_first_chunk_alone(tmp_path, closed):
    path = tmp_path / "old.mcap"
    first = by_mcap_alone(path, closed=closed)
    data = bytearray(path.read_bytes())
    data[first // 2] ^= 1
    path.write_bytes(data)
    others = CHUNKS * EACH // 2 - 1
    if closed:
        assert recover(path).messages.total() == others
        return
    with pytest.raises(UserError, match=f"no message in it can be recovered: {others} are in whole chunks"):
        recover(path)
    assert [file.name for file in tmp_path.iterdir()] == ["old.mcap"]


def bomb(path, compression, *, stated):
    """A recording whose only chunk unpacks to 256 MiB of zeros and states another size."""
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
@pytest.mark.parametrize("stated", [0, 1000], ids=["as it is", "wrong"])
def test_a_chunk_that_unpacks_to_gigabytes(tmp_path, compression, stated):
    path = bomb(tmp_path / "bomb.mcap", compression, stated=stated)
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


class FullDisk:
    """A file that raises an error after a number of bytes, like a full disk."""

    def __init__(self, stream, room):
        self.stream, self.room = stream, room

    def write(self, data):
        if self.stream.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.stream.write(data)

    def __getattr__(self, name):
        return getattr(self.stream, name)


def test_on_a_full_disk_each_lost_message_is_counted(tmp_path):
    inbox = Inbox()
    session = OpenRecording(RecorderSettings(directory=tmp_path, compression="none", chunk_size=1024), (), inbox)
    part = session.writer.part
    part._stream = part._writer._Writer__stream = FullDisk(part._stream, 40_000)
    for number in range(200):
        topic, payload = message(number)
        inbox.put(Sample(topic, topic.key("robot"), payload, number, number))

    def write_all():
        for _ in range(200):
            session.write(inbox.get(0))

    with pytest.raises(UserError, match="No space left"):
        write_all()
    session.writer.finish()
    recovered = recover(part.active).messages.total()
    assert recovered > 0
    assert (session.writer.saved, session.lost()) == (recovered, 200 - recovered)
