"""`presage bench latency`, `viewer` and `recorder`: they measure, and leave no process behind, however they end."""

from __future__ import annotations

import json
import signal
import zlib
from contextlib import suppress

import psutil
import pytest

from common.bus.bus import wait_until
from common.messages.topics import TRUTH
from lab.benchmarks.recorder import _compare
from services.recorder.files.message_counts import Count, as_metadata
from services.recorder.files.writer import RecordingWriter


def test_latency_is_measured_and_written(process, tmp_path):
    bench = process("presage.__main__", "bench", "latency", "--scans", "20", "--json", str(tmp_path / "l.json"))
    assert bench.wait(120) == 0, bench.output
    numbers = json.loads((tmp_path / "l.json").read_text())
    assert numbers["unanswered"] == 0
    assert 0 < numbers["zenoh_round_trip_median_ms"] < numbers["scan_to_command_median_ms"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_bench_latency(process, number):
    bench = process("presage.__main__", "bench", "latency", "--scans", "3000")

    def children():
        return psutil.Process(bench.child.pid).children(recursive=True)

    def echoes(child):
        with suppress(psutil.Error):  # it may be gone by now
            return "echo_main" in " ".join(child.cmdline())
        return False

    assert wait_until(lambda: any(map(echoes, children())), 90), bench.output
    started = children()
    assert len(started) == 4
    bench.send(number)
    assert bench.wait(20) == (-9 if number == signal.SIGKILL else 130)
    assert wait_until(lambda: not any(child.is_running() and child.status() != "zombie" for child in started), 10)
    assert "Traceback" not in bench.output


def test_an_unwritable_output_file_is_reported_first(process, tmp_path):
    bench = process("presage.__main__", "bench", "latency", "--json", str(tmp_path / "no" / "l.json"))
    assert bench.wait(60) == 2
    assert "l.json: cannot be written to (No such file or directory)" in bench.output
    assert "Traceback" not in bench.output


def test_viewer_costs_are_measured_and_written(process, tmp_path):
    args = ("--seconds", "2", "--rounds", "1", "--json", str(tmp_path / "v.json"))
    bench = process("presage.__main__", "bench", "viewer", *args)
    assert bench.wait(150) == 0, bench.output
    numbers = json.loads((tmp_path / "v.json").read_text())
    assert numbers["frames_hz"] > 1
    assert 0 < numbers["viewer_cpu_share"] < 1
    for name in ("without", "with"):
        assert 0 < numbers[f"scan_to_command_median_{name}_ms"] <= numbers[f"scan_to_command_p99_{name}_ms"]


def test_a_recorder_under_load_keeps_every_byte(process, tmp_path):
    args = ("--seconds", "2", "--rate", "720", "--out", str(tmp_path / "kept"), "--json", str(tmp_path / "r.json"))
    bench = process("presage.__main__", "bench", "recorder", *args)
    assert bench.wait(120) == 0, bench.output
    numbers = json.loads((tmp_path / "r.json").read_text())
    assert numbers["sent"] == numbers["received"] == numbers["written"] == numbers["in_file"]
    assert 0 < numbers["sent"] <= 1440  # a busy machine sends fewer
    assert (numbers["dropped"], numbers["missing"], numbers["bytes_as_sent"]) == (0, 0, True)
    assert [file.name for file in tmp_path.glob("kept/*.mcap*")] == ["bench.mcap"]


def test_a_lost_or_altered_message_is_detected(tmp_path):
    """The comparison detects a missing message, a changed byte and a changed order."""
    key = TRUTH.key("bench")
    for payloads, whole in (([b"a", b"b"], True), ([b"a"], False), ([b"a", b"c"], False), ([b"b", b"a"], False)):
        writer = RecordingWriter(tmp_path / f"{b''.join(payloads).decode()}.mcap")
        for number, payload in enumerate(payloads):
            writer.write(TRUTH, key, payload, number, number)
        writer.metadata("counters", as_metadata({key: Count(received=2, written=len(payloads))}))
        sent = {"sent": {key: {"count": 2, "crc": zlib.crc32(b"ab")}}, "late_s": 0.0}
        assert _compare(sent, writer.finish())["bytes_as_sent"] is whole
