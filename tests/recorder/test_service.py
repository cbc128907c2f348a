"""The recorder as a process, over real zenoh."""

from __future__ import annotations

import json
import random
import signal
import threading

import pytest

from common.bus import wait_until
from common.inbox import Inbox
from common.messages import Health, WorldReply
from common.robot import Robot
from common.scanner import SCANNERS
from common.service import Loop, Service
from common.topics import HEALTH, ODOM, SCAN, TOPICS, WORLD
from services.recorder.reader import read_recording
from services.recorder.settings import RecorderSettings
from tests.recorder import sessions as made


@pytest.fixture
def recorder(process, tmp_path):
    def start(*args):
        running = process("recorder", "--directory", str(tmp_path / "logs"), *args)
        running.wait_for("ready")
        return running

    return start


def only_file(folder, suffix=".mcap"):
    (path,) = folder.glob("*" + suffix)
    return path


def publish(bus, count, seed=1):
    """Arbitrary bytes on every topic; key and payload in order."""
    sent, source = [], random.Random(seed)
    for topic in TOPICS:
        assert bus.wait_matching(topic, 10, service="me")
    for number in range(count):
        topic = TOPICS[number % len(TOPICS)]
        payload = number.to_bytes(4, "big") + source.randbytes(source.choice([0, 10, 3300]))
        bus.put(topic, payload, service="me")
        sent.append((topic.key(bus.robot, "me"), payload))
    return sent


def test_every_payload_is_in_the_file_bit_exactly(recorder, bus, tmp_path):
    running = recorder()
    sent = publish(bus, 3000)
    settle(bus, 3000)
    status, took = running.stop(signal.SIGTERM)
    assert status == 0, running.output
    assert took < 5
    path = only_file(tmp_path / "logs")
    assert path.name.startswith(f"presage-{bus.robot}-")
    recording = read_recording(path)
    assert recording.complete
    for topic in TOPICS:
        key = topic.key(bus.robot, "me")
        assert [r.payload for r in recording.raw if r.key == key] == [payload for k, payload in sent if k == key]
    assert all(0 < r.published_ns <= r.logged_ns + 1_000_000_000 for r in recording.raw)
    assert recording.metadata["dropped"] == {}
    assert int(recording.metadata["written"][SCAN.key(bus.robot)]) == recording.counts()[SCAN.key(bus.robot)]
    assert str(path) in running.output


def test_kill_9_leaves_what_came_more_than_a_flush_before(recorder, bus, tmp_path):
    running = recorder()
    sent = publish(bus, 300)
    key = HEALTH.key(bus.robot, "recorder")
    beats = Inbox()
    bus.subscribe(HEALTH, beats)
    # Two pulses of the recorder's, a second apart: between them lies a flush.
    heard = 0
    while heard < 3:
        entry = beats.get(10)
        assert entry is not None, running.output
        heard += entry.key == key
    running.kill()
    recording = read_recording(only_file(tmp_path / "logs", ".mcap.active"))
    assert not recording.complete
    got = {(r.key, r.payload) for r in recording.raw}
    assert set(sent) <= got
    assert recording.metadata["presage"]["robot"] == bus.robot


def settle(bus, count):
    """Until the recorder says that so many messages have come; an answer of its own may overtake what was put."""
    pulses, own = Inbox(), HEALTH.key(bus.robot, "recorder")
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def heard():
        entry = pulses.get(0)
        if entry is None or entry.key != own:
            return False
        return sum(row.received for row in Health.decode(entry.payload).topics if row.key != own) >= count

    assert wait_until(heard, 20)


class Pretender(Service):
    """Answers as the simulator does."""

    name = "simulator"
    queries = (WORLD,)

    def on_request(self, query, request):
        return WorldReply(world=made.WORLD, scanner=SCANNERS["tim571"], robot=Robot(radius=0.31))


class Settings(RecorderSettings):
    service = "simulator"


def test_services_that_appear_are_asked_what_they_are(recorder, bus, tmp_path):
    running = recorder()
    pretender = Pretender(Settings(robot=bus.robot))
    loop = Loop(pretender, bus, Inbox())
    thread = threading.Thread(target=loop.run)
    thread.start()
    file = only_file(tmp_path / "logs", ".mcap.active")
    try:
        assert wait_until(lambda: b"world.yaml" in file.read_bytes(), 20), running.output
    finally:
        loop.stop()
        thread.join(10)
    assert running.stop()[0] == 0
    recording = read_recording(only_file(tmp_path / "logs"))
    assert recording.world() == made.WORLD
    assert recording.robot().radius == 0.31
    assert json.loads(recording.metadata["world"]["scanner"])["beams"] == 811
    assert json.loads(recording.metadata["config:simulator"]["config"])["robot"] == bus.robot
    assert "python" in recording.metadata["config:simulator"]
    assert recording.metadata["presage"]["commit"]
    assert "services.recorder" in recording.metadata["presage"]["command"].replace("/", ".")
    assert json.loads(recording.metadata["config:recorder"]["config"])["compression"] == "zstd"


def test_only_the_topics_asked_for(recorder, bus, tmp_path):
    running = recorder("--topics", "odom", "--file", "some", "--compression", "none")
    assert bus.wait_matching(ODOM, 10)
    bus.put(SCAN, b"no")
    bus.put(ODOM, b"yes")
    settle(bus, 1)
    assert running.stop(signal.SIGINT)[0] == 0
    recording = read_recording(tmp_path / "logs" / "some.mcap")
    assert [(r.key, r.payload) for r in recording.raw] == [(ODOM.key(bus.robot), b"yes")]


def test_it_does_not_wait_in_silence_for_nobody(processes, tmp_path, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    running = processes.start("recorder", "--directory", str(tmp_path), env={"PRESAGE_CONNECT": endpoint})
    running.wait_for(f"nothing answers at {endpoint}")
    running.wait_for("start a session with `presage up`")
    processes.start("common.router", "--listen", endpoint)
    running.wait_for("there it is")
    assert running.output.count("nothing answers") == 1
    assert running.stop()[0] == 0


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("--topics", "skan"), "recorder: no topic skan: choose from scan"),
        (("--directory", "/dev/null/x"), "recorder: /dev/null/x: cannot be written to"),
        (("--compression", "zip"), "recorder: "),
        (("--file", "a/b"), "recorder: file: "),
    ],
)
def test_bad_input_is_one_line(process, args, said):
    running = process("recorder", *args)
    assert running.wait() == 2
    lines = [line for line in running.output.splitlines() if "[" not in line[:12]]
    assert lines[-1].startswith(said), running.output
    assert "Traceback" not in running.output
