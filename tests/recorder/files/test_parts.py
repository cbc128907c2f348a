"""Split recordings: each part is complete, and together they contain all messages."""

from __future__ import annotations

from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import SCAN, TRUTH
from services.recorder.files.parts import PartLimits, PartsWriter
from services.recorder.files.writer import NameTakenError, RecordingWriter
from services.recorder.reader import read_recording
from services.recorder.recording import open_first_part, open_part
from services.recorder.settings import RecorderSettings
from tests.recorder.sessions import on_full_disk

KEY = "presage/r/truth"
SECOND_NS = 1_000_000_000


def truth(number):
    return Truth(stamp_ns=number, seq=number, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


def writer_in(folder, limits, **changes):
    options = RecorderSettings(directory=folder, file="run", split_minutes=1, **changes)
    path, first = open_first_part(options)
    return PartsWriter(first, partial(open_part, options, path), limits, lambda: {"counters": {"so": "far"}})


@settings(max_examples=10)
@given(count=st.integers(1, 30), seconds=st.integers(1, 30))
def test_parts_by_time(tmp_path_factory, count, seconds):
    folder = tmp_path_factory.mktemp("parts")
    writer = writer_in(folder, PartLimits(seconds=seconds))
    writer.metadata("presage", {"robot": "r"})
    writer.metadata("presage", {"robot": "r", "later": "yes"})
    writer.attachment("world.yaml", b"name: x", "application/yaml", 1)
    writer.declare(SCAN, "presage/r/scan")
    for number in range(count):
        writer.write(TRUTH, KEY, truth(number), number * SECOND_NS, number * SECOND_NS)
    files = writer.finish()
    assert [file.name for file in files] == [f"run-{k:03d}.mcap" for k in range(1, -(-count // seconds) + 1)]
    assert sorted(folder.iterdir()) == files
    payloads = []
    for number, file in enumerate(files, 1):
        recording = read_recording(file)
        assert recording.complete
        assert recording.metadata["presage"] == {"robot": "r", "later": "yes"}
        assert recording.metadata["counters"] == {"so": "far"}
        assert recording.attachments == {"world.yaml": b"name: x"}
        previous = {"number": str(number), "previous": files[number - 2].name} if number > 1 else None
        assert recording.metadata.get("part") == previous
        payloads += [raw.payload for raw in recording.payloads()]
    assert payloads == [truth(number) for number in range(count)]


def test_parts_by_size(tmp_path, small_chunks):
    writer = writer_in(tmp_path, PartLimits(size=20_000), compression="none")
    for number in range(500):
        writer.write(TRUTH, KEY, truth(number), number, number)
    files = writer.finish()
    assert len(files) > 2
    assert all(20_000 <= file.stat().st_size < 30_000 for file in files[:-1])


def test_what_each_part_repeats_does_not_count_for_its_size(tmp_path, small_chunks):
    writer = writer_in(tmp_path, PartLimits(size=20_000), compression="none")
    writer.attachment("model", bytes(30_000), "application/octet-stream", 1)
    for number in range(500):
        writer.write(TRUTH, KEY, truth(number), number, number)
    files = writer.finish()
    assert len(files) > 2
    assert all(50_000 <= file.stat().st_size < 60_000 for file in files[:-1])


def test_next_name_is_taken(tmp_path):
    writer = writer_in(tmp_path, PartLimits(seconds=1))
    (tmp_path / "run-002.mcap").write_bytes(b"another file")
    writer.write(TRUTH, KEY, truth(0), 0, 0)
    with pytest.raises(UserError, match=r"run-002\.mcap: is there already"):
        writer.write(TRUTH, KEY, truth(1), 0, 5 * SECOND_NS)
    assert writer.finish() == [tmp_path / "run-001.mcap"]
    assert [raw.payload for raw in read_recording(tmp_path / "run-001.mcap").payloads()] == [truth(0)]


@pytest.mark.parametrize("name", ["run-002.mcap", "run-017.mcap.active"])
def test_parts_of_another_recording(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    (tmp_path / "runway-002.mcap").write_bytes(b"")
    with pytest.raises(NameTakenError, match=rf"{name}: is there already"):
        writer_in(tmp_path, PartLimits(seconds=1))
    options = RecorderSettings(directory=tmp_path, file="run", split_minutes=1)
    assert open_first_part(options, may_rename=True)[1].finish() == tmp_path / "run-2-001.mcap"


def test_part_that_cannot_begin(tmp_path):
    rooms = iter([1 << 20, 0])

    def open_limited(number):
        return on_full_disk(RecordingWriter(tmp_path / f"run-{number}.mcap"), next(rooms))

    writer = PartsWriter(open_limited(1), open_limited, PartLimits(seconds=1))
    writer.write(TRUTH, KEY, truth(0), 0, 0)
    with pytest.raises(UserError, match=r"run-2\.mcap\.active: recording failed .* it holds no message"):
        writer.write(TRUTH, KEY, truth(1), 0, 5 * SECOND_NS)
    assert writer.finish() == list(tmp_path.iterdir()) == [tmp_path / "run-1.mcap"]


def test_part_that_cannot_end(tmp_path):
    rooms = iter([20_000, 1 << 20])

    def open_limited(number):
        return on_full_disk(RecordingWriter(tmp_path / f"run-{number}.mcap", "none", 100), next(rooms))

    writer = PartsWriter(
        open_limited(1), open_limited, PartLimits(seconds=1), lambda: {"counters": {"long": "x" * 50_000}}
    )
    writer.write(TRUTH, KEY, truth(0), 0, 0)
    writer.flush()
    with pytest.raises(UserError, match=r"run-1\.mcap\.active: recording failed .* `presage recover"):
        writer.write(TRUTH, KEY, truth(1), 0, 5 * SECOND_NS)
    assert writer.finish() == list(tmp_path.iterdir()) == [tmp_path / "run-1.mcap.active"]
