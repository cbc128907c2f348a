"""Recording on request: each file is complete, describes the session, and has its own counters."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.geometry.world import World
from common.messages.definitions import Health, Odom, Pose, Twist
from common.messages.requests import RecordReply, RecordRequest, WorldReply
from common.messages.topics import HEALTH, ODOM, RECORDING, WORLD
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from common.runtime.service import Loop, Service
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording
from services.recorder.settings import RecorderSettings
from tests.recorder import sessions as made


@pytest.fixture
def recorder(process, tmp_path):
    def start(*args):
        running = process("recorder", "--directory", str(tmp_path / "logs"), "--flush", "0.1", *args)
        running.wait_for("ready")
        return running

    return start


@pytest.fixture
def tell(bus):
    def ask(action) -> RecordReply:
        return bus.ask(RECORDING, RecordRequest(action=action), RecordReply, timeout=20)

    return ask


def send(bus, numbers):
    """Publishes odometry with these sequence numbers. Returns the payloads."""
    assert bus.wait_matching(ODOM, 20)
    sent = []
    for number in numbers:
        odom = Odom(stamp_ns=number, seq=number, pose=Pose(x=0, y=0), twist=Twist(), covariance=[[0.0] * 3] * 3)
        sent.append(odom.encode())
        bus.put(ODOM, sent[-1])
    return sent


def settle(bus, count):
    """Waits until the recorder has received this many messages. A request may overtake messages sent before it."""
    pulses, own, key = Inbox(), HEALTH.key(bus.robot, "recorder"), ODOM.key(bus.robot)
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def heard():
        entry = pulses.get(0)
        rows = Health.decode(entry.payload).topics if entry is not None and entry.key == own else []
        return any(row.key == key and row.received == count for row in rows)

    assert wait_until(heard, 20)


def odometry_in(path, bus):
    """Odometry payloads and their counters. Asserts that the file is complete and all counters match."""
    recording = read_recording(path)
    assert recording.complete
    counters = from_metadata(recording.metadata["counters"])
    assert {key: count.written for key, count in counters.items()} == recording.counts()
    assert all(count.received == count.written and not count.dropped for count in counters.values())
    key = ODOM.key(bus.robot)
    return [raw.payload for raw in recording.payloads({key})], counters.get(key)


def test_idle_it_writes_nothing_until_told_and_then_one_file_each_time(recorder, bus, tell, tmp_path):
    running = recorder("--idle", "--topics", "odom")
    status = tell("status")
    assert (status.ok, status.recording, status.file, status.messages) == (True, False, "", 0)
    send(bus, range(5))
    settle(bus, 5)
    files, sent, total = [], [], 5
    for first, count in (
        (5, 20),
        (100, 30),
    ):  # messages between the recordings are in no file and do not count as missing
        begun = tell("start")
        assert (begun.ok, begun.recording) == (True, True)
        sent.append(send(bus, range(first, first + count)))
        assert wait_until(lambda n=count: tell("status").messages == n, 20), running.output
        ended = tell("stop")
        assert (ended.ok, ended.recording, ended.file, ended.messages) == (True, False, begun.file, count)
        assert ended.seconds > 0
        files.append(ended.file)
        send(bus, range(90, 95))
        total += count + 5
        settle(bus, total)
    logs = tmp_path / "logs"
    assert sorted(str(path) for path in logs.iterdir()) == sorted(files)
    for file, payloads in zip(files, sent, strict=True):
        got, count = odometry_in(logs / file, bus)
        assert got == payloads
        assert (count.gaps, count.missing, count.restarts) == (0, 0, 0)
    assert running.stop()[0] == 0
    assert len(list(logs.iterdir())) == 2


def test_what_cannot_be_is_refused_with_the_reason(recorder, bus, tell, tmp_path):
    recorder("--idle", "--file", "run")
    refused = tell("stop")
    assert not refused.ok
    assert "records nothing" in refused.reason
    assert tell("start").file.endswith("run.mcap")
    refused = tell("start")
    assert not refused.ok
    assert refused.recording
    assert "run.mcap" in refused.reason
    assert tell("stop").ok
    assert tell("start").file.endswith("run-2.mcap")  # the configured name is taken
    assert tell("stop").ok
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["run-2.mcap", "run.mcap"]


def test_a_folder_that_cannot_be_written_to_is_an_answer_and_no_end(process, bus, tell):
    running = process("recorder", "--directory", "/dev/null/x", "--idle")
    running.wait_for("ready")
    refused = tell("start")
    assert not refused.ok
    assert "/dev/null/x: cannot be written to" in refused.reason
    assert not tell("status").recording
    assert running.stop()[0] == 0


def test_a_file_lost_underneath_is_an_answer_too(recorder, bus, tell, tmp_path):
    running = recorder("--idle", "--flush", "60")
    begun = tell("start")
    (tmp_path / "logs" / (begun.file.rsplit("/", 1)[-1] + ".active")).unlink()
    refused = tell("stop")
    assert not refused.ok
    assert tell("start").ok
    assert tell("stop").ok
    assert running.stop()[0] == 0


def test_one_that_records_from_the_start_can_be_stopped_and_started(recorder, bus, tell, tmp_path):
    running = recorder("--file", "run", "--topics", "odom")
    first = send(bus, range(10))
    assert wait_until(lambda: tell("status").messages == 10, 20)
    assert tell("status").recording
    assert tell("stop").file.endswith("run.mcap")
    assert odometry_in(tmp_path / "logs" / "run.mcap", bus)[0] == first
    assert tell("start").file.endswith("run-2.mcap")
    second = send(bus, range(10, 15))
    assert wait_until(lambda: tell("status").messages == 5, 20)
    assert running.stop()[0] == 0  # during the second recording
    assert odometry_in(tmp_path / "logs" / "run-2.mcap", bus)[0] == second


def test_health_counts_all_files_and_says_when_none_is_written(recorder, bus, tell):
    recorder("--idle")
    pulses, own, key = Inbox(), HEALTH.key(bus.robot, "recorder"), ODOM.key(bus.robot)
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def shown(wanted, note):
        entry = pulses.get(0)
        if entry is None or entry.key != own:
            return False
        health = Health.decode(entry.payload)
        row = next((row for row in health.topics if row.key == key), None)
        return (row.received, row.written, row.missing) == wanted and health.note == note if row else False

    tell("start")
    send(bus, [0, 1, 4])
    assert wait_until(lambda: shown((3, 3, 2), ""), 20)
    tell("stop")
    send(bus, [5])
    assert wait_until(lambda: shown((4, 3, 2), "records nothing until a request starts it"), 20)
    tell("start")
    send(bus, [6, 8])
    assert wait_until(lambda: shown((6, 5, 3), ""), 20)


class Pretender(Service):
    """Answers queries like the simulator, with a world that changes."""

    name = "simulator"
    queries = (WORLD,)
    world = made.WORLD

    def on_request(self, query, request):
        return WorldReply(world=self.world, scanner=SCANNERS["tim571"], robot=Robot(radius=0.31))


class Settings(RecorderSettings):
    service = "simulator"


def world_in(path) -> World | None:
    return read_recording(path).world()


def test_every_file_says_what_the_session_is_now(recorder, bus, tell, tmp_path):
    recorder("--idle", "--compression", "none")
    pretender = Pretender(Settings(robot=bus.robot))
    loop = Loop(pretender, bus, Inbox())
    thread = threading.Thread(target=loop.run)
    thread.start()
    try:
        began = tell("start")
        active = tmp_path / "logs" / (began.file.rsplit("/", 1)[-1] + ".active")
        assert wait_until(lambda: b"world.yaml" in active.read_bytes(), 20)
        first = tell("stop").file
        second_began = tell("start").file  # the known description is written before any query
        second = tell("stop").file
        assert second == second_began
        pretender.world = made.WORLD.model_copy(update={"obstacles": made.WORLD.obstacles[:1]})
        active = tmp_path / "logs" / (tell("start").file.rsplit("/", 1)[-1] + ".active")
        # An obstacle was removed: the file has the old world first, then the new one.
        assert wait_until(lambda: active.read_bytes().count(b"world.yaml") >= 2, 20)
        third = tell("stop").file
    finally:
        loop.stop()
        thread.join(10)
    assert world_in(tmp_path / "logs" / first) == world_in(tmp_path / "logs" / second) == made.WORLD
    assert world_in(tmp_path / "logs" / third) == pretender.world
    recording = read_recording(tmp_path / "logs" / second)
    assert json.loads(recording.metadata["config:simulator"]["config"])["robot"] == bus.robot
    assert recording.metadata["presage"]["robot"] == bus.robot


def test_one_that_is_gone_is_not_described(recorder, bus, tell, process, tmp_path):
    recorder("--idle", "--compression", "none")
    controller = process("controller")
    controller.wait_for("ready")
    active = tmp_path / "logs" / (tell("start").file.rsplit("/", 1)[-1] + ".active")
    assert wait_until(lambda: b"config:controller" in active.read_bytes(), 20)
    tell("stop")
    assert controller.stop()[0] == 0
    assert wait_until(lambda: "controller" not in bus.alive(), 20)

    def absent():
        tell("start")
        return "config:controller" not in read_recording(Path(tell("stop").file)).metadata

    assert wait_until(absent, 20, 0.1)
