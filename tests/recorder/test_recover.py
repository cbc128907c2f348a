"""Recovery of unfinished and damaged files: intact chunks are kept, losses are counted."""

from __future__ import annotations

import errno
import itertools

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from common.errors import UserError
from common.messages.definitions import CmdVel, Pose, Truth, Twist
from common.messages.topics import CMD_VEL, TRUTH
from services.recorder.files.chunks import COMPRESSION
from services.recorder.files.message_counts import KeyCounts, as_metadata, from_metadata
from services.recorder.files.writer import PROFILE, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recover import recover

CHUNKS = 6
EACH = 4  # messages per chunk, alternating between two channels
COMPRESSIONS = st.sampled_from(["zstd", "lz4", "none"])


def message(number):
    if number % 2:
        return CMD_VEL, CmdVel(stamp_ns=number, seq=number // 2, twist=Twist(vx=0.1)).encode()
    return TRUTH, Truth(stamp_ns=number, seq=number // 2, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


SENT = [(topic.key("r"), payload) for topic, payload in map(message, range(CHUNKS * EACH))]


def write_chunks(folder, compression="zstd", *, closed=False):
    """A recording in chunks, with metadata and attachments between them, and the end offset of each chunk."""
    writer, ends = RecordingWriter(folder / "run.mcap", compression), []
    writer.metadata("presage", {"robot": "r"})
    for number in range(CHUNKS * EACH):
        topic, payload = message(number)
        writer.write(topic, topic.key("r"), payload, number, number)
        if number % EACH == EACH - 1:
            writer.flush()
            ends.append(writer.size)
            writer.attachment(f"note {number}", b"text", "text/plain", 1)
    if closed:
        return writer.finish(), ends
    writer._stream.close()  # as if the recorder had been killed
    return writer.active, ends


def messages_in(path):
    return [(raw.key, raw.payload) for raw in read_recording(path).payloads()]


def lost_chunks(path):
    """Numbers of the missing chunks. Asserts that the others are unchanged."""
    found = messages_in(path)
    chunks = [SENT[n : n + EACH] for n in range(0, len(SENT), EACH)]
    assert found == list(itertools.chain(*(chunk for chunk in chunks if chunk[0] in found)))
    return [number for number, chunk in enumerate(chunks) if chunk[0] not in found]


def damaged(path, offset, mask=b"\x01"):
    """A copy in which the bytes from ``offset`` are combined with ``mask`` by exclusive or."""
    data = bytearray(path.read_bytes())
    data[offset : offset + len(mask)] = (a ^ b for a, b in zip(data[offset:], mask, strict=False))
    path.with_name("bad.mcap").write_bytes(data)
    return path.with_name("bad.mcap")


def test_unfinished_file(tmp_path):
    active, _ = write_chunks(tmp_path)
    (tmp_path / "run.mcap.recovering").write_bytes(b"of an interrupted recovery")
    found = recover(active)
    assert found.path == tmp_path / "run.mcap"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.mcap.incomplete"]
    recording = read_recording(found.path)
    assert recording.complete
    assert messages_in(found.path) == SENT
    assert recording.metadata["presage"] == {"robot": "r"}
    assert recording.metadata["recovered"]["bytes_not_used"] == "0"
    assert list(recording.attachments.values()) == [b"text"] * CHUNKS
    assert found.messages.total() == len(SENT)
    assert found.lines()[1:] == ["missing: the end of the file; messages after the last flush were never written"]
    for reader in (NonSeekingReader, make_reader):
        with found.path.open("rb") as stream:
            messages = list(reader(stream, validate_crcs=True).iter_messages())
        assert [(channel.topic, m.data) for _, channel, m in messages] == SENT


@given(data=st.data())
def test_cut_file(tmp_path_factory, data):
    active, ends = write_chunks(tmp_path_factory.mktemp("cut"), data.draw(COMPRESSIONS))
    whole = active.read_bytes()
    cut = data.draw(st.one_of(st.integers(0, len(whole)), st.sampled_from(ends)))
    active.write_bytes(whole[:cut])
    complete = [number for number, end in enumerate(ends) if end <= cut]
    try:
        found = recover(active)
    except UserError as error:
        assert "run.mcap.active: " in str(error)  # noqa: PT017
        assert not complete
        assert [file.name for file in active.parent.iterdir()] == ["run.mcap.active"]
    else:
        assert set(lost_chunks(found.path)).isdisjoint(complete)


@given(bit=st.integers(0, 1 << 20), compression=COMPRESSIONS, closed=st.booleans())
@example(bit=0, compression="zstd", closed=False)
@example(bit=70, compression="zstd", closed=False)
def test_one_damaged_bit(tmp_path_factory, bit, compression, closed):
    path, _ = write_chunks(tmp_path_factory.mktemp("flipped"), compression, closed=closed)
    bad = damaged(path, bit // 8 % path.stat().st_size, bytes([1 << bit % 8]))
    before = bad.read_bytes()
    found = recover(bad)
    assert len(lost_chunks(found.path)) <= 1
    assert found.path.name == "bad-recovered.mcap"
    assert bad.read_bytes() == before  # a source that is not .active stays unchanged


@given(data=st.data())
def test_damaged_chunk(tmp_path_factory, data):
    path, ends = write_chunks(tmp_path_factory.mktemp("damaged"), data.draw(COMPRESSIONS))
    chunk = data.draw(st.integers(1, CHUNKS - 1))
    begin = data.draw(st.integers(ends[chunk - 1], ends[chunk] - 1))
    bad = damaged(path, begin, b"\xa5" * data.draw(st.integers(1, ends[chunk] - begin)))
    assert lost_chunks(recover(bad).path) in ([], [chunk])


def test_report_of_missing_messages(tmp_path):
    path, ends = write_chunks(tmp_path)
    lines = recover(damaged(path, ends[2] + 150)).lines()
    assert f"missing: {EACH // 2} messages of {TRUTH.key('r')} by their sequence numbers, in 1 gaps" in lines
    assert any("bytes from byte" in line for line in lines)


def test_counters_of_recovered_messages(tmp_path):
    writer, key = RecordingWriter(tmp_path / "run.mcap", "none", chunk_size=1024), TRUTH.key("r")
    for number in range(0, 80, 2):
        writer.write(TRUTH, key, message(number)[1], number, number)
    writer.metadata("counters", as_metadata({key: KeyCounts(received=40, written=40)}))
    path = writer.finish()
    found = recover(damaged(path, path.read_bytes().find(message(40)[1]) + 5))
    count = from_metadata(read_recording(found.path).metadata["counters"])[key]
    assert count.written == count.received == found.messages[key] < 40
    assert count.missing == 40 - count.written


@pytest.mark.parametrize("closed", [True, False], ids=["with its index", "without"])
def test_channels_declared_once(tmp_path, closed):
    """Files that mcap's own writer wrote, of which the first chunk is damaged."""
    path, second = tmp_path / "old.mcap", 0
    with path.open("wb") as stream:
        writer = Writer(stream, compression=COMPRESSION["none"])
        writer.start(PROFILE)
        channel = writer.register_channel(TRUTH.key("r"), "msgpack", writer.register_schema("s", "jsonschema", b"{}"))
        for number in range(0, CHUNKS * EACH, 2):
            writer.add_message(channel, number, message(number)[1], number)
            writer.flush()
            second = second or stream.tell()
        if closed:
            writer.finish()
    bad, others = damaged(path, second // 2), CHUNKS * EACH // 2 - 1
    if closed:
        assert recover(bad).messages.total() == others
        return
    with pytest.raises(UserError, match=f"no message in it can be recovered: {others} are in whole chunks"):
        recover(bad)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bad.mcap", "old.mcap"]


def test_running_recorder(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    with pytest.raises(UserError, match="is being written"):
        recover(writer.active)
    writer.finish()


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read"), (b"", "is empty, there is nothing to recover"), (b"\x89PNG" * 9, "not an MCAP file")],
    ids=["missing", "empty", "picture"],
)
def test_other_files(tmp_path, content, message):
    if content is not None:
        (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(UserError, match=message):
        recover(tmp_path / "x.mcap")
    assert not (tmp_path / "x-recovered.mcap").exists()


def test_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"run\.mcap: cannot be read \(No such file or directory\)"):
        recover(tmp_path / "run.mcap")


def test_full_disk(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    path, _ = write_chunks(tmp_path)
    monkeypatch.setattr("mcap.writer.Writer.finish", fail)
    with pytest.raises(UserError, match=r"out\.mcap: cannot be written \(No space left on device\); free some space"):
        recover(path, tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


def test_nothing_is_overwritten(tmp_path):
    active, _ = write_chunks(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"precious")
    with pytest.raises(UserError, match=r"run\.mcap: is there already"):
        recover(active)
    assert (tmp_path / "run.mcap").read_bytes() == b"precious"
    assert active.exists()
