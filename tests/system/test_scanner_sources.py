"""Replacements of the simulator: a replayed recording, or a process that only waits for a remote robot's scans."""

from __future__ import annotations

import time

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.containers.healthcheck import find_fault
from common.messages.definitions import Scan
from common.messages.topics import SCAN, TOPICS, TRUTH
from common.runtime.heartbeat import read_beats
from services.recorder.files.writer import RecordingWriter
from tests.conftest import wait_for_message

SCANS = 4
TIMEOUT_S = 30.0


def scan(number):
    return Scan(
        stamp_ns=1_000_000_000 + number * 66_000_000, seq=number, ranges=np.full(5, 2.0, np.float32),
        angle_min=-1.0, angle_increment=0.5, range_min=0.05, range_max=25.0,
    )  # fmt: skip


@pytest.fixture
def recording(tmp_path):
    """A recording of another robot, with beliefs, which must not be replayed."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    writer = RecordingWriter(folder / "drive.mcap")
    kinds = {topic.name: topic for topic in TOPICS}
    for number in range(SCANS):
        at, message = scan(number).stamp_ns, scan(number)
        writer.write(kinds["scan"], "presage/other/scan", message.encode(), at, at)
        writer.write(kinds["belief"], "presage/other/belief", b"x", at, at)
    writer.finish()
    return folder


def test_a_recording_replaces_the_simulator(bus, process, recording, tmp_path):
    scans, all_else = Inbox(), Inbox()
    bus.subscribe(SCAN, scans, keep_all=True)
    for topic in set(TOPICS) - {SCAN}:
        bus.subscribe(topic, all_else, keep_all=True)
    running = process(
        "services.recorder.replaying.service", "--directory", str(recording), "--replay", "drive.mcap", "--heartbeat",
        str(tmp_path),
    )  # fmt: skip
    for _ in range(2):  # the replay loops
        for number in range(SCANS):
            assert wait_for_message(scans, Scan, lambda message: True).seq == number, running.output
    healthy = lambda: find_fault("replay", read_beats(tmp_path, "replay"), [bus.robot], time.monotonic()) == ""  # noqa: E731
    assert wait_until(healthy, TIMEOUT_S), read_beats(tmp_path, "replay")
    assert running.stop()[0] == 0
    assert not all_else.received


@pytest.mark.parametrize(
    ("name", "expected_text"), [("", "no recording ''"), ("other.mcap", "no recording 'other.mcap'")]
)
def test_a_missing_recording_is_reported_with_the_available_ones(process, recording, name, expected_text):
    running = process("services.recorder.replaying.service", "--directory", str(recording), "--replay", name)
    assert running.wait() == 2
    assert f"replay: {expected_text} in {recording}" in running.output
    assert "there are drive.mcap" in running.output


def test_a_recording_without_scans_is_refused(process, tmp_path):
    writer = RecordingWriter(tmp_path / "drive.mcap")
    writer.write(TRUTH, "presage/other/truth", b"x", 1, 1)
    writer.finish()
    running = process("services.recorder.replaying.service", "--directory", str(tmp_path), "--replay", "drive.mcap")
    assert running.wait() == 2
    assert "no scans in this recording" in running.output


def test_waiting_for_a_remote_robot_reports_when_its_scans_start_and_stop(bus, process, tmp_path):
    running = process("common.containers.remote_robot", "--heartbeat", str(tmp_path))
    fault = lambda: find_fault("remote", read_beats(tmp_path, "remote"), [bus.robot], time.monotonic())  # noqa: E731
    wanted = f"{bus.robot}: no scan was received so far (no scan so far)"
    assert wait_until(lambda: fault() == wanted, TIMEOUT_S), fault()
    assert bus.wait_matching(SCAN, TIMEOUT_S)
    sent = scan(0).encode()
    assert wait_until(lambda: bus.put(SCAN, sent) or fault() == "", TIMEOUT_S), fault()
    running.wait_for("scans are arriving")
    running.wait_for("no scan for 5 s")
    assert wait_until(lambda: "no scan was received for" in fault(), TIMEOUT_S), fault()
    assert running.stop()[0] == 0
