"""Split recordings: each part is complete, and together they contain all messages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import SCAN, TRUTH
from services.recorder.files.parts import Limits, PartsWriter
from services.recorder.reader import read_recording
from services.recorder.recording import parts_of
from services.recorder.settings import RecorderSettings

KEY = "presage/r/truth"
SECOND = 1_000_000_000


def truth(number):
    return Truth(stamp_ns=number, seq=number, pose=Pose(x=1.0, y=2.0), twist=Twist()).encode()


def writer_in(folder, limits, **settings):
    options = RecorderSettings(directory=folder, file="run", split_minutes=1, **settings)
    return PartsWriter(parts_of(options), limits, lambda: {"counters": {"so": "far"}})


@given(count=st.integers(1, 60), seconds=st.integers(1, 30))
def test_every_part_describes_the_session_and_together_they_are_all(tmp_path_factory, count, seconds):
    folder = tmp_path_factory.mktemp("parts")
    writer = writer_in(folder, Limits(seconds=seconds))
    writer.metadata("presage", {"robot": "r"})
    writer.metadata("presage", {"robot": "r", "later": "yes"})
    writer.attachment("world.yaml", b"name: x", "application/yaml", 1)
    writer.declare(SCAN, "presage/r/scan")
    for number in range(count):
        writer.write(TRUTH, KEY, truth(number), number * SECOND, number * SECOND)
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


def test_a_part_ends_when_it_is_large(tmp_path):
    writer = writer_in(tmp_path, Limits(size=20_000), compression="none", chunk_size=1024)
    for number in range(1000):
        writer.write(TRUTH, KEY, truth(number), number, number)
    files = writer.finish()
    assert len(files) > 3
    assert all(20_000 <= file.stat().st_size < 30_000 for file in files[:-1])


def test_where_the_next_part_cannot_be_opened_the_last_one_still_is_completed(tmp_path):
    writer = writer_in(tmp_path, Limits(seconds=1))
    (tmp_path / "run-002.mcap").write_bytes(b"somebody else's")
    writer.write(TRUTH, KEY, truth(0), 0, 0)
    with pytest.raises(UserError, match=r"run-002\.mcap: is there already"):
        writer.write(TRUTH, KEY, truth(1), 0, 5 * SECOND)
    assert writer.finish() == [tmp_path / "run-001.mcap"]
    assert [raw.payload for raw in read_recording(tmp_path / "run-001.mcap").payloads()] == [truth(0)]
