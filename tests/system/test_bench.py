"""`presage bench latency`, `viewer`, `cpu` and `recorder` measure what they say."""

from __future__ import annotations

import json
import zlib

import pytest

from common.messages.topics import TRUTH
from lab.benchmarks import cpu, latency, viewer
from lab.benchmarks.recorder import _compare
from services.recorder.files.message_counts import KeyCounts, as_metadata
from services.recorder.files.writer import RecordingWriter


@pytest.fixture
def bench(presage, monkeypatch, tmp_path):
    """A function that runs a benchmark with a short warm-up and returns its numbers."""
    monkeypatch.setattr(cpu, "WARM_UP_S", 1.0)
    monkeypatch.setattr(viewer, "WARM_UP_S", 0.5)
    monkeypatch.setattr(latency, "WARM_UP_SCANS", 3)

    def run(*args):
        numbers = tmp_path / "numbers.json"
        status, output = presage("bench", *args, "--json", str(numbers))
        assert status == 0, output
        return json.loads(numbers.read_text())

    return run


def test_latency(bench):
    numbers = bench("latency", "--scans", "10")
    assert numbers["unanswered"] == 0
    assert 0 < numbers["zenoh_round_trip_median_ms"] < numbers["scan_to_command_median_ms"]


def test_viewer(bench):
    numbers = bench("viewer", "--seconds", "1", "--rounds", "1")
    assert numbers["frames_hz"] > 0
    assert 0 < numbers["viewer_cpu_share"] < 1
    for name in ("without", "with"):
        assert 0 < numbers[f"scan_to_command_median_{name}_ms"] <= numbers[f"scan_to_command_p99_{name}_ms"]


def test_cpu(bench):
    numbers = bench("cpu", "--seconds", "1")
    assert numbers["beliefs_hz"] > 0
    assert 0 < numbers["cpu_share"]["estimator"] < numbers["cpu_share"]["on_the_robot"]
    assert all(megabytes > 10 for megabytes in numbers["memory_mb"].values())


def test_recorder(bench, tmp_path):
    numbers = bench("recorder", "--seconds", "1", "--rate", "720", "--out", str(tmp_path / "kept"))
    assert 720 >= numbers["sent"] > 0  # a busy machine sends fewer
    assert numbers["sent"] == numbers["received"] == numbers["written"] == numbers["in_file"]
    assert (numbers["dropped"], numbers["missing"], numbers["bytes_as_sent"]) == (0, 0, True)
    assert [file.name for file in tmp_path.glob("kept/*.mcap*")] == ["bench.mcap"]


@pytest.mark.parametrize(
    ("payloads", "equal"), [((b"a", b"b"), True), ((b"a",), False), ((b"a", b"c"), False), ((b"b", b"a"), False)]
)
def test_lost_or_altered_messages(tmp_path, payloads, equal):
    key, writer = TRUTH.key("bench"), RecordingWriter(tmp_path / "bench.mcap")
    for number, payload in enumerate(payloads):
        writer.write(TRUTH, key, payload, number, number)
    writer.metadata("counters", as_metadata({key: KeyCounts(received=2, written=len(payloads))}))
    sent = {"sent": {key: {"count": 2, "crc": zlib.crc32(b"ab")}}, "late_s": 0.0}
    assert _compare(sent, writer.finish())["bytes_as_sent"] is equal
