"""Recording on request: each file is complete, describes the session, and has its own counters."""

from __future__ import annotations

from pathlib import Path

from common.bus.bus import wait_until
from common.messages.topics import ODOM
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording
from tests.recorder import sessions
from tests.recorder.conftest import publish_odometry


def odometry_in(file, bus):
    """Odometry payloads and their counters. Asserts that the file is complete and all counters match."""
    recording = read_recording(Path(file))
    assert recording.complete
    counters = from_metadata(recording.metadata["counters"])
    assert {key: count.written for key, count in counters.items()} == recording.counts
    assert all(count.received == count.written and not count.dropped for count in counters.values())
    key = ODOM.key(bus.robot)
    return [raw.payload for raw in recording.payloads({key})], counters[key]


def test_one_file_for_each_request(recorder, bus, request_recording, recorder_health, logs):
    running = recorder("--idle", "--topics", "odom")
    status = request_recording("status")
    assert (status.ok, status.recording, status.file, status.messages) == (True, False, "", 0)
    publish_odometry(bus, range(5))
    recorder_health(lambda health, odom: odom.received == 5 and "not recording" in health.note)
    first, sent = request_recording("start"), publish_odometry(bus, range(5, 25))
    assert (first.ok, first.recording) == (True, True)
    assert wait_until(lambda: request_recording("status").messages == 20, 20), running.output
    ended = request_recording("stop")
    assert (ended.ok, ended.recording, ended.file, ended.messages) == (True, False, first.file, 20)
    assert ended.seconds > 0
    publish_odometry(bus, range(90, 95))  # messages between the recordings are in no file and not missing
    recorder_health(lambda _, odom: (odom.received, odom.written, odom.missing) == (30, 20, 0))
    second, sent_later = request_recording("start"), publish_odometry(bus, [100, 101, 104])
    recorder_health(lambda health, odom: (odom.received, odom.written, odom.missing) == (33, 23, 2) and not health.note)
    assert running.stop() == 0  # during the second recording
    assert sorted(str(path) for path in logs.iterdir()) == sorted([first.file, second.file])
    for file, payloads, missing in ((first.file, sent, 0), (second.file, sent_later, 2)):
        found, count = odometry_in(file, bus)
        assert found == payloads
        assert (count.missing, count.restarts) == (missing, 0)


def test_refused_requests(recorder, request_recording, logs):
    running = recorder("--idle", "--file", "run", "--flush", "60")
    refused = request_recording("stop")
    assert not refused.ok
    assert "not recording" in refused.reason
    assert request_recording("start").file.endswith("run.mcap")
    refused = request_recording("start")
    assert (refused.ok, refused.recording) == (False, True)
    assert "run.mcap" in refused.reason
    assert request_recording("stop").ok
    assert request_recording("start").file.endswith("run-2.mcap")  # the configured name is taken
    (logs / "run-2.mcap.active").unlink()
    assert not request_recording("stop").ok
    assert request_recording("start").ok
    assert running.stop() == 0
    assert sorted(path.name for path in logs.iterdir()) == ["run-2.mcap", "run.mcap"]


def test_unwritable_folder_is_an_answer(process, request_recording):
    running = process("recorder", "--directory", "/dev/null/x", "--idle")
    running.wait_for("ready")
    refused = request_recording("start")
    assert not refused.ok
    assert "/dev/null/x: cannot be written to" in refused.reason
    assert not request_recording("status").recording
    assert running.stop() == 0


def test_files_describe_the_present_session(recorder, simulator, request_recording, bus):
    recorder("--idle", "--compression", "none")

    def active():
        return Path(request_recording("status").file + ".active").read_bytes()

    request_recording("start")
    assert wait_until(lambda: b"world.yaml" in active(), 20)
    first = request_recording("stop").file
    request_recording("start")  # the known description is written before any query
    second = request_recording("stop").file
    simulator.world = sessions.WORLD.model_copy(update={"obstacles": sessions.WORLD.obstacles[:1]})
    request_recording("start")
    assert wait_until(lambda: active().count(b"world.yaml") >= 2, 20)  # the old world, then the new one
    third = request_recording("stop").file
    worlds = [read_recording(Path(file)).world() for file in (first, second, third)]
    assert worlds == [sessions.WORLD, sessions.WORLD, simulator.world]


def test_ended_services_are_not_described(recorder, bus, request_recording, process):
    recorder("--idle", "--compression", "none")
    controller = process("controller")
    controller.wait_for("ready")
    active = Path(request_recording("start").file + ".active")
    assert wait_until(lambda: b"config:controller" in active.read_bytes(), 20)
    request_recording("stop")
    assert controller.stop() == 0
    assert wait_until(lambda: "controller" not in bus.alive(), 20)

    def absent():
        request_recording("start")
        return "config:controller" not in read_recording(Path(request_recording("stop").file)).metadata

    assert wait_until(absent, 20, 0.1)
