"""Written recordings are readable by this project and by mcap; unfinished, foreign and missing files are errors."""

from __future__ import annotations

import json
from io import BytesIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from common.errors import UserError
from common.geometry.world import load_world
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import HEALTH, ODOM, SCAN, TOPICS, TRUTH
from services.recorder.files.chunks import CHUNK_BUILDER, MAGIC
from services.recorder.files.writer import NameTakenError, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recording import open_first_part
from services.recorder.service import RecorderService, parse_topics
from services.recorder.settings import RecorderSettings
from tests.recorder import sessions

KEYS = [(SCAN, "presage/r/scan"), (ODOM, "presage/other/odom"), (HEALTH, "presage/r/health/me")]
TIMES = st.integers(0, 2**63)
ENTRIES = st.lists(st.tuples(st.sampled_from(KEYS), st.binary(max_size=300), TIMES, TIMES), max_size=30)
COMPRESSIONS = st.sampled_from(["zstd", "lz4", "none"])


def truth(stamp):
    return Truth(stamp_ns=stamp, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


@given(entries=ENTRIES, compression=COMPRESSIONS, flushes=st.sets(st.integers(0, 29)))
def test_round_trip(tmp_path_factory, entries, compression, flushes):
    writer = RecordingWriter(tmp_path_factory.mktemp("round") / "run.mcap", compression, chunk_size=1024)
    for number, ((topic, key), payload, published, received) in enumerate(entries):
        writer.write(topic, key, payload, published, received)
        if number in flushes:
            writer.flush()
    path = writer.finish()
    recording = read_recording(path)
    wanted = [(key, payload, published, received) for (_, key), payload, published, received in entries]
    found = [(r.key, r.payload, r.published_ns, r.logged_ns) for r in recording.payloads()]
    assert found == sorted(wanted, key=lambda w: w[3])
    assert recording.complete
    assert recording.counts == writer.written
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        assert [(channel.topic, m.data, m.publish_time, m.log_time) for _, channel, m in messages] == wanted


def test_private_name_of_mcap():
    changed = f"mcap.writer.Writer has no {CHUNK_BUILDER} any more: see services/recorder/files/chunks.py"
    assert hasattr(Writer(BytesIO()), CHUNK_BUILDER), changed


def test_schemas_and_channels(tmp_path):
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


def test_metadata_and_world(tmp_path):
    path = sessions.write(tmp_path / "run.mcap")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    first_chunk = min(index.chunk_start_offset for index in summary.chunk_indexes)
    assert max(index.offset for index in summary.metadata_indexes + summary.attachment_indexes) < first_chunk
    recording = read_recording(path)
    assert recording.world() == sessions.WORLD
    assert recording.robot().radius == 0.3
    (tmp_path / "world.yaml").write_bytes(recording.attachments["world.yaml"])
    assert load_world(str(tmp_path / "world.yaml")) == sessions.WORLD


def test_decoded_messages(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    for number, payload in enumerate([truth(7), b"", b"\xc1", truth(8)]):
        writer.write(TRUTH, "presage/r/truth", payload, 0, number)
    writer.write(SCAN, "presage/r/scan", truth(9), 0, 9)  # another message's bytes
    recording = read_recording(writer.finish())
    found = [(topic, message.stamp_ns, raw.logged_ns) for topic, message, raw in recording.messages()]
    assert found == [(TRUTH, 7, 0), (TRUTH, 8, 3)]
    assert recording.undecodable == {"presage/r/truth": 2, "presage/r/scan": 1}
    assert list(recording.messages(ODOM)) == []


def test_names(tmp_path):
    options = RecorderSettings(directory=tmp_path, file="run")
    _, writer = open_first_part(options)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap.active"]
    with pytest.raises(NameTakenError, match=r"run\.mcap\.active: is there already.*--file"):
        open_first_part(options)
    whole = writer.finish().read_bytes()
    with pytest.raises(NameTakenError, match=r"run\.mcap: is there already.*--file"):
        open_first_part(options)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("run.mcap", whole)]


def test_generated_names(tmp_path, monkeypatch):
    monkeypatch.setattr("services.recorder.recording.file_path", lambda _: tmp_path / "now.mcap")
    writers = [open_first_part(RecorderSettings(directory=tmp_path))[1] for _ in range(3)]
    assert [writer.finish().name for writer in writers] == ["now.mcap", "now-2.mcap", "now-3.mcap"]


def test_unusable_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot be written to .*; choose another folder"):
        RecordingWriter(tmp_path / "file" / "run.mcap")


@given(data=st.data())
def test_cut_file(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut")
    writer = RecordingWriter(folder / "run.mcap", data.draw(COMPRESSIONS), chunk_size=1024)
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


def foreign(path):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.add_message(writer.register_channel("/chatter", "cdr", schema), 1, b"hello", 1)
        writer.finish()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "cannot be read"),
        (lambda path: path.mkdir(), "cannot be read"),
        (lambda path: path.write_bytes(b""), "not an MCAP file"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" * 100), "not an MCAP file"),
        (foreign, "not a recording of presage .*'ros2'"),
    ],
    ids=["missing", "folder", "empty", "picture", "ros2"],
)
def test_other_files(tmp_path, make, message):
    make(tmp_path / "x.mcap")
    with pytest.raises(UserError, match=rf"^{tmp_path}/x.mcap.*{message}"):
        read_recording(tmp_path / "x.mcap")


def test_chosen_topics():
    recorded = tuple(topic for topic in TOPICS if topic.recorded)
    assert set(RecorderService.inputs) == set(parse_topics("")) == set(recorded)
    assert parse_topics("odom, scan,odom") == (ODOM, SCAN)
    with pytest.raises(UserError, match="no topic skan: choose from scan, odom"):
        parse_topics("skan")
