"""`presage bench latency`: it measures, and nothing of it stays, however it ends."""

from __future__ import annotations

import json
import signal

import psutil
import pytest

from common.bus import wait_until


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

    assert wait_until(lambda: any("echo_main" in " ".join(child.cmdline()) for child in children()), 90), bench.output
    started = children()
    assert len(started) == 4
    bench.send(number)
    assert bench.wait(20) == (-9 if number == signal.SIGKILL else 130)
    assert wait_until(lambda: not any(child.is_running() and child.status() != "zombie" for child in started), 10)
    assert "Traceback" not in bench.output


def test_numbers_that_cannot_be_written_are_said_first(process, tmp_path):
    bench = process("presage.__main__", "bench", "latency", "--json", str(tmp_path / "no" / "l.json"))
    assert bench.wait(60) == 2
    assert "l.json: cannot be written to (No such file or directory)" in bench.output
    assert "Traceback" not in bench.output
