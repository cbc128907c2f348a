"""Written recordings are readable by this project and by mcap; unfinished, foreign and missing files are errors."""

from __future__ import annotations

import errno
import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from common.errors import UserError
from common.geometry.world import load_world
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import HEALTH, ODOM, SCAN, TOPICS, TRUTH
from services.recorder.files.chunks import MAGIC
from services.recorder.files.writer import NameTakenError, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recording import open_writer
from services.recorder.service import RecorderService, chosen_topics
from services.recorder.settings import RecorderSettings
from tests.recorder import sessions as made

KEYS = [(SCAN, "presage/r/scan"), (ODOM, "presage/other/odom"), (HEALTH, "presage/r/health/me")]
TIMES = st.integers(0, 2**63)
ENTRIES = st.lists(st.tuples(st.sampled_from(KEYS), st.binary(max_size=300), TIMES, TIMES), max_size=30)


def truth(stamp):
    return Truth(stamp_ns=stamp, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


@given(entries=ENTRIES, compression=st.sampled_from(["zstd", "lz4", "none"]), flushes=st.sets(st.integers(0, 29)))
def test_payloads_and_times_come_back_bit_exactly(tmp_path_factory, entries, compression, flushes):
    writer = RecordingWriter(tmp_path_factory.mktemp("round") / "run.mcap", compression, chunk_size=1024)
    for number, ((topic, key), payload, published, received) in enumerate(entries):
        writer.write(topic, key, payload, published, received)
        if number in flushes:
            writer.flush()
    path = writer.finish()
    recording = read_recording(path)
    wanted = [(key, payload, published, received) for (_, key), payload, published, received in entries]
    assert [(r.key, r.payload, r.published_ns, r.logged_ns) for r in recording.raw] == sorted(
        wanted, key=lambda w: w[3]
    )
    assert recording.complete
    assert recording.counts() == writer.written
    with path.open("rb") as stream:
        theirs = [
            (channel.topic, message.data, message.publish_time, message.log_time)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]
    assert theirs == wanted


def test_every_topic_has_its_schema_and_its_channel(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    for topic in TOPICS:
        writer.write(topic, topic.key("rob", "me"), b"", 1, 1)
    with writer.finish().open("rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = {channel.topic: channel for channel in summary.channels.values()}
    for topic in TOPICS:
        channel = channels[topic.key("rob", "me")]
        assert channel.message_encoding == "msgpack"
        assert channel.metadata == {"topic": topic.name, "robot": "rob"}
        schema = summary.schemas[channel.schema_id]
        assert (schema.name, schema.encoding) == (topic.message.__name__, "jsonschema")
        assert json.loads(schema.data) == topic.message.json_schema()


def test_metadata_stand_first_and_the_world_comes_back(tmp_path):
    path = made.write(tmp_path / "run.mcap")
    text = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    first_chunk = min(index.chunk_start_offset for index in summary.chunk_indexes)
    assert max(index.offset for index in summary.metadata_indexes + summary.attachment_indexes) < first_chunk
    assert text[summary.attachment_indexes[0].offset :].find(b"world.yaml") > 0
    recording = read_recording(path)
    assert recording.world() == made.WORLD
    assert recording.robot().radius == 0.3
    (tmp_path / "world.yaml").write_bytes(recording.attachments["world.yaml"])
    assert load_world(str(tmp_path / "world.yaml")) == made.WORLD


def test_messages_are_decoded_and_what_is_none_is_counted(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    for number, payload in enumerate([truth(7), b"", b"\xc1", truth(8)]):
        writer.write(TRUTH, "presage/r/truth", payload, 0, number)
    writer.write(SCAN, "presage/r/scan", truth(9), 0, 9)  # another message's bytes
    recording = read_recording(writer.finish())
    assert [(topic, message.stamp_ns, raw.logged_ns) for topic, message, raw in recording.messages()] == [
        (TRUTH, 7, 0),
        (TRUTH, 8, 3),
    ]
    assert recording.undecodable == {"presage/r/truth": 2, "presage/r/scan": 1}
    assert list(recording.messages(ODOM)) == []


def test_an_unfinished_file_is_known_by_its_name(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap.active"]
    writer.finish()
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_no_recording_is_written_over(tmp_path):
    for name in ("run.mcap", "run.mcap.active"):
        (tmp_path / name).write_bytes(b"precious")
        with pytest.raises(UserError, match="--file"):
            RecordingWriter(tmp_path / "run.mcap")
        assert (tmp_path / name).read_bytes() == b"precious"
        (tmp_path / name).unlink()


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot be written to .*; choose another folder"):
        RecordingWriter(tmp_path / "file" / "run.mcap")


def test_a_full_disk_is_one_line_and_leaves_what_was_flushed(tmp_path, monkeypatch):
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.write(TRUTH, "presage/r/truth", truth(1), 1, 1)
    writer.flush()

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer._writer, "flush", full)
    with pytest.raises(UserError, match="No space left on device") as told:
        writer.flush()
    assert "\n" not in str(told.value)
    assert writer.failed
    assert writer.finish() == tmp_path / "run.mcap.active"
    assert [raw.payload for raw in read_recording(writer.active).raw] == [truth(1)]


WRITING = """
import sys
import threading
from pathlib import Path
from common.messages.definitions import Odom, Pose, Twist
from common.messages.topics import ODOM
from services.recorder.files.writer import RecordingWriter

writer = RecordingWriter(Path(sys.argv[1]))
writer.metadata("presage", {"robot": "r"})
for number in range(2000):
    odom = Odom(stamp_ns=number, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=[[0.0] * 3] * 3)
    writer.write(ODOM, "presage/r/odom", odom.encode(), number, number)
    if number == 1499:
        writer.flush()
        print("flushed", flush=True)
print("all", flush=True)
threading.Event().wait()
"""


def test_kill_9_loses_no_more_than_what_was_not_flushed(tmp_path, processes):
    (tmp_path / "writing.py").write_text(WRITING)
    child = processes.start(tmp_path / "writing.py", str(tmp_path / "run.mcap"))
    child.wait_for("all")
    child.kill()
    recording = read_recording(tmp_path / "run.mcap.active")
    assert not recording.complete
    assert "incomplete" in recording.warning
    assert recording.metadata["presage"]["robot"] == "r"
    stamps = [message.stamp_ns for _, message, _ in recording.messages()]
    assert stamps == list(range(len(stamps)))
    assert 1500 <= len(stamps) < 2000


@given(data=st.data())
def test_a_file_cut_anywhere_gives_its_whole_chunks_or_one_clear_line(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut")
    writer = RecordingWriter(folder / "run.mcap", data.draw(st.sampled_from(["zstd", "lz4", "none"])), chunk_size=1024)
    for number in range(40):
        writer.write(TRUTH, "presage/r/truth", truth(number), number, number)
    whole = writer.finish().read_bytes()
    kept = data.draw(st.integers(0, len(whole) - 1))
    (folder / "cut.mcap").write_bytes(whole[:kept])
    if kept < len(MAGIC):
        with pytest.raises(UserError, match="not an MCAP file"):
            read_recording(folder / "cut.mcap")
        return
    recording = read_recording(folder / "cut.mcap")
    assert not recording.complete
    stamps = [message.stamp_ns for _, message, _ in recording.messages()]
    assert stamps == list(range(len(stamps)))


def test_a_damaged_chunk_is_noticed(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap", "none")
    writer.write(TRUTH, "presage/r/truth", truth(12345), 1, 1)
    data = bytearray(writer.finish().read_bytes())
    data[data.find(truth(12345)) + 20] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    recording = read_recording(tmp_path / "bad.mcap")
    assert recording.raw == []
    assert not recording.complete
    assert "damaged" in recording.warning


def foreign(path):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.add_message(writer.register_channel("/chatter", "cdr", schema), 1, b"hello", 1)
        writer.finish()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "cannot be read"),
        (lambda path: path.mkdir(), "cannot be read"),
        (lambda path: path.write_bytes(b""), "not an MCAP file"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" * 100), "not an MCAP file"),
        (foreign, "not a recording of presage .*'ros2'"),
    ],
    ids=["missing", "folder", "empty", "picture", "ros2"],
)
def test_what_is_no_recording_is_named(tmp_path, make, said):
    make(tmp_path / "x.mcap")
    with pytest.raises(UserError, match=said) as told:
        read_recording(tmp_path / "x.mcap")
    assert str(tmp_path / "x.mcap") in str(told.value)
    assert "\n" not in str(told.value)


def test_two_recordings_never_share_a_name(tmp_path):
    def name(recording):
        return recording.path.name.rsplit("-r-", 1)[-1][len("20260101-000000") :]

    options = RecorderSettings(directory=tmp_path, robot="r")
    writers = [open_writer(options) for _ in range(3)]
    stamp = writers[0].path.stem
    while writers[-1].path.stem != f"{stamp}-3":  # unless the second turned between two of them
        stamp = (first := open_writer(options)).path.stem
        writers += [first, *(open_writer(options) for _ in range(2))]
    assert [name(w) for w in writers[-3:]] == [".mcap", "-2.mcap", "-3.mcap"]
    assert len({w.finish() for w in writers}) == len(writers)


def test_a_name_asked_for_is_never_another(tmp_path):
    options = RecorderSettings(directory=tmp_path, file="run")
    writer = open_writer(options)
    with pytest.raises(NameTakenError, match=r"run\.mcap\.active: is there already"):
        open_writer(options)
    whole = writer.finish().read_bytes()
    with pytest.raises(NameTakenError, match=r"run\.mcap: is there already"):
        open_writer(options)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [whole]


def test_topics_are_chosen_by_name():
    assert chosen_topics("") == tuple(topic for topic in TOPICS if topic.recorded)
    assert chosen_topics("odom, scan,odom") == (ODOM, SCAN)
    with pytest.raises(UserError, match="no topic skan: choose from scan, odom"):
        chosen_topics("skan")


def test_the_recorder_takes_every_row_that_is_marked():
    assert set(RecorderService.inputs) == {topic for topic in TOPICS if topic.recorded}
    assert RecorderService.keep_all
