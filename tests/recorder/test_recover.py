"""Recovery keeps every complete chunk and reports what is missing."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader

from common.errors import UserError
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import TRUTH
from services.recorder.files.message_counts import Count, as_metadata, from_metadata
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recover import recover

KEY = "presage/r/truth"
CHUNKS = 8
EACH = 5  # messages per chunk


def truth(number):
    return Truth(stamp_ns=number, seq=number, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


def torn(path, compression="zstd"):
    """An unfinished recording of a killed recorder, and the end offset of each chunk."""
    writer, ends = RecordingWriter(path, compression), []
    writer.metadata("presage", {"robot": "r"})
    writer.attachment("world.yaml", b"name: x", "application/yaml", 1)
    for number in range(CHUNKS * EACH):
        writer.write(TRUTH, KEY, truth(number), number, number)
        if number % EACH == EACH - 1:
            writer.flush()
            ends.append(writer.size)
    writer._stream.close()
    return writer.active, ends


def stamps(path):
    return [message.stamp_ns for _, message, _ in read_recording(path).messages()]


def test_an_unfinished_recording_becomes_a_whole_one(tmp_path):
    active, _ = torn(tmp_path / "run.mcap")
    found = recover(active)
    assert found.path == tmp_path / "run.mcap"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.mcap.torn"]
    recording = read_recording(found.path)
    assert recording.complete
    assert stamps(found.path) == list(range(CHUNKS * EACH))
    assert recording.metadata["presage"] == {"robot": "r"}
    assert recording.metadata["recovered"]["bytes_not_used"] == "0"
    assert recording.attachments == {"world.yaml": b"name: x"}
    assert found.messages == {KEY: CHUNKS * EACH}
    assert found.lines()[1:] == ["missing: the end of the file; messages after the last flush were never written"]
    for reader in (NonSeekingReader, make_reader):
        with found.path.open("rb") as stream:
            messages = list(reader(stream, validate_crcs=True).iter_messages())
        assert [m.data for _, _, m in messages] == [truth(n) for n in range(CHUNKS * EACH)]
        assert {channel.topic for _, channel, _ in messages} == {KEY}


@given(data=st.data())
def test_cut_anywhere_every_complete_chunk_comes_back(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut")
    active, ends = torn(folder / "run.mcap", data.draw(st.sampled_from(["zstd", "lz4", "none"])))
    whole = active.read_bytes()
    cut = data.draw(st.one_of(st.integers(0, len(whole)), st.sampled_from(ends)))
    (folder / "cut.mcap.active").write_bytes(whole[:cut])
    complete = sum(end <= cut for end in ends)
    try:
        found = recover(folder / "cut.mcap.active")
    except UserError as error:
        assert "cut.mcap.active: " in str(error)  # noqa: PT017
        assert not complete
        assert not (folder / "cut.mcap").exists()
        assert (folder / "cut.mcap.active").exists()
        return
    got = stamps(found.path)
    assert got == list(range(len(got)))
    assert len(got) // EACH >= complete
    assert sum(d.length for d in found.damages) + sum(0 for _ in got) <= cut


@given(data=st.data())
def test_damage_in_the_middle_costs_its_own_chunk_alone(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    active, ends = torn(folder / "run.mcap", data.draw(st.sampled_from(["zstd", "lz4", "none"])))
    whole = bytearray(active.read_bytes())
    chunk = data.draw(st.integers(1, CHUNKS - 2))
    begin, end = ends[chunk - 1], ends[chunk]
    at = data.draw(st.integers(begin, end - 1))
    length = data.draw(st.integers(1, end - at))
    whole[at : at + length] = bytes((b ^ 0xA5) for b in whole[at : at + length])
    (folder / "bad.mcap").write_bytes(whole)
    found = recover(folder / "bad.mcap")
    assert found.path == folder / "bad-recovered.mcap"
    assert (folder / "bad.mcap").read_bytes() == whole  # a source that is not .active stays unchanged
    others = [n for n in range(CHUNKS * EACH) if n // EACH != chunk]
    assert set(others) <= set(stamps(found.path))


def test_what_is_missing_is_said_by_the_publishers_numbers(tmp_path):
    active, ends = torn(tmp_path / "run.mcap")
    whole = bytearray(active.read_bytes())
    whole[ends[2] + 60] ^= 1
    (tmp_path / "bad.mcap").write_bytes(whole)
    lines = recover(tmp_path / "bad.mcap").lines()
    assert f"missing: {EACH} messages of {KEY} by their sequence numbers, in 1 gaps" in lines
    assert any("bytes from byte" in line for line in lines)


def test_a_recording_that_lives_is_left_alone(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    with pytest.raises(UserError, match="is being written"):
        recover(writer.active)
    writer.finish()


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "cannot be read"), (b"", "is empty, there is nothing to recover"), (b"\x89PNG" * 9, "not an MCAP file")],
    ids=["missing", "empty", "picture"],
)
def test_what_is_no_recording_is_named(tmp_path, content, said):
    if content is not None:
        (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(UserError, match=said):
        recover(tmp_path / "x.mcap")
    assert not (tmp_path / "x-recovered.mcap").exists()


def test_nothing_is_written_over(tmp_path):
    active, _ = torn(tmp_path / "run.mcap")
    (tmp_path / "run.mcap").write_bytes(b"precious")
    with pytest.raises(UserError, match=r"run\.mcap: is there already"):
        recover(active)
    assert (tmp_path / "run.mcap").read_bytes() == b"precious"
    assert active.exists()


def test_a_recovery_that_was_cut_short_does_not_stop_the_next(tmp_path):
    active, _ = torn(tmp_path / "run.mcap")
    (tmp_path / "run.mcap.recovering").write_bytes(b"half")
    assert recover(active).messages == {KEY: CHUNKS * EACH}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.mcap.torn"]


def test_what_was_counted_of_the_whole_is_not_said_of_what_is_left(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap", "none", chunk_size=1024)
    for number in range(40):
        writer.write(TRUTH, KEY, truth(number), number, number)
    writer.metadata("counters", as_metadata({KEY: Count(received=40, written=40)}))
    whole = bytearray(writer.finish().read_bytes())
    whole[whole.find(truth(20)) + 5] ^= 1
    (tmp_path / "bad.mcap").write_bytes(whole)
    found = recover(tmp_path / "bad.mcap")
    count = from_metadata(read_recording(found.path).metadata["counters"])[KEY]
    assert count.written == count.received == found.messages[KEY] < 40
    assert count.missing == 40 - count.written
