"""The recorder as a process, over real zenoh."""

from __future__ import annotations

import itertools
import json
import random
import re
import signal
import threading
import time
from collections import Counter

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import MAX_KEYS, Inbox
from common.messages.definitions import Health, Odom, Pose, Twist
from common.messages.requests import RecordReply, RecordRequest, WorldReply
from common.messages.topics import HEALTH, ODOM, RECORDING, SCAN, TOPICS, WORLD
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from common.runtime.service import Loop, Service
from presage.recordings.info import survey
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording
from services.recorder.recover import recover
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
    """Publishes arbitrary bytes on every topic. Returns keys and payloads in order."""
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
    counters = from_metadata(recording.metadata["counters"])
    count = counters[SCAN.key(bus.robot)]
    scans = len(range(TOPICS.index(SCAN), 3000, len(TOPICS)))
    assert (count.received, count.written, count.dropped) == (scans, scans, 0)
    assert all(c.received == c.written and c.dropped == c.missing == 0 for c in counters.values())
    assert {key: c.written for key, c in counters.items()} == recording.counts()
    assert str(path) in running.output


def test_kill_9_leaves_what_came_more_than_a_flush_before(recorder, bus, tmp_path):
    running = recorder()
    sent = publish(bus, 300)
    key = HEALTH.key(bus.robot, "recorder")
    beats = Inbox()
    bus.subscribe(HEALTH, beats)
    # Two health messages of the recorder, a second apart: a flush lies between them.
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
    """Waits until the recorder has received this many messages. A request may overtake messages sent before it."""
    pulses, own = Inbox(), HEALTH.key(bus.robot, "recorder")
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def heard():
        entry = pulses.get(0)
        if entry is None or entry.key != own:
            return False
        return sum(row.received for row in Health.decode(entry.payload).topics if row.key != own) >= count

    assert wait_until(heard, 20)


class Pretender(Service):
    """Answers queries like the simulator."""

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
    running.wait_for("connected to the router")
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


LIMITED = """
import resource, runpy, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))  # acts like a full disk
sys.argv = ["recorder", *sys.argv[1:]]
runpy.run_module("services.recorder", run_name="__main__")
"""


def test_a_full_disk_ends_it_with_one_line_and_what_was_written_is_recovered(process, bus, tmp_path):
    (tmp_path / "limited.py").write_text(LIMITED)
    small = ("--compression", "none", "--chunk-size", "20000")
    running = process(tmp_path / "limited.py", "--directory", str(tmp_path / "logs"), *small)
    running.wait_for("ready")
    sent = publish(bus, 400)
    assert running.wait() == 2, running.output
    told = [line for line in running.output.splitlines() if line.startswith("recorder: ")]
    assert len(told) == 1
    assert "recording failed (File too large)" in told[0]
    assert "presage recover" in told[0]
    assert "Traceback" not in running.output
    found = recover(only_file(tmp_path / "logs", ".mcap.active"))
    last = next(line for line in running.output.splitlines() if "recording is incomplete" in line)
    counts = {name: int(number) for name, number in re.findall(r"(messages|lost|missing)=(\d+)", last)}
    assert counts["lost"] > 0
    assert 0 < counts["messages"] <= found.messages.total()
    for topic in TOPICS:
        key = topic.key(bus.robot, "me")
        got = [raw.payload for raw in read_recording(found.path).payloads({key})]
        assert got == [payload for sent_key, payload in sent if sent_key == key][: len(got)]


def test_a_file_removed_underneath_is_noticed(recorder, bus, tmp_path):
    running = recorder()
    only_file(tmp_path / "logs", ".mcap.active").unlink()
    assert running.wait() == 2
    assert "was removed or moved while it was being written" in running.output
    assert "Traceback" not in running.output


def test_a_recorder_tells_how_to_mend_what_another_left_and_they_do_not_meet(recorder, bus, tmp_path):
    killed = recorder("--file", "first")
    publish(bus, 30)
    settle(bus, 30)
    alive = recorder("--file", "second")
    killed.kill()
    third = recorder("--file", "third")
    left = tmp_path / "logs" / "first.mcap.active"
    third.wait_for(f"presage recover {left}")
    assert "second.mcap.active" not in third.output
    assert alive.stop()[0] == third.stop()[0] == 0
    assert recover(left).messages.total() > 0


def test_kill_9_loses_at_most_the_last_second(recorder, bus, tmp_path):
    """Everything the recorder had received a second before it was killed is in the file."""
    running = recorder()
    assert bus.wait_matching(ODOM, 10)
    sent: list[tuple[float, bytes]] = []
    began = time.monotonic()
    while time.monotonic() - began < 2.5:  # the recorder's own clock: it must go on while time passes
        payload = len(sent).to_bytes(4, "big")
        bus.put(ODOM, payload)
        sent.append((time.monotonic(), payload))
        time.sleep(0.005)
    running.kill()
    killed = time.monotonic()
    found = recover(only_file(tmp_path / "logs", ".mcap.active"))
    key = ODOM.key(bus.robot)
    got = [raw.payload for raw in read_recording(found.path).payloads({key})]
    assert got == [payload for _, payload in sent[: len(got)]]
    # On a machine that stalls, a flush comes late: the age of the last message kept says how late.
    assert killed - sent[len(got) - 1][0] < 1.0 + stalls(sent)


def stalls(sent):
    """S, the longest pause between two messages: the machine's, not the recorder's."""
    times = [at for at, _ in sent]
    return max(b - a for a, b in itertools.pairwise(times)) * 4


def test_gaps_are_counted_live_and_in_the_file(recorder, bus, tmp_path):
    running = recorder()
    assert bus.wait_matching(ODOM, 10)
    for number in (0, 1, 2, 7, 8, 0, 1):
        odom = Odom(stamp_ns=number, seq=number, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=[[0.0] * 3] * 3)
        bus.put(ODOM, odom.encode())
    pulses, own, key = Inbox(), HEALTH.key(bus.robot, "recorder"), ODOM.key(bus.robot)
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def shown():
        entry = pulses.get(0)
        rows = Health.decode(entry.payload).topics if entry is not None and entry.key == own else []
        return any((row.key, row.written, row.missing) == (key, 7, 4) for row in rows)

    assert wait_until(shown, 20), running.output
    assert running.stop()[0] == 0
    recording = read_recording(only_file(tmp_path / "logs"))
    count = from_metadata(recording.metadata["counters"])[key]
    assert (count.received, count.written, count.gaps, count.missing, count.restarts) == (7, 7, 1, 4, 1)


def test_invented_keys_do_not_fill_the_file(recorder, bus, tmp_path):
    running = recorder()
    assert bus.wait_matching(HEALTH, 10, service="me")
    for number in range(MAX_KEYS + 200):
        bus.put(HEALTH, b"", service=f"x{number}")
    pulses, own = Inbox(), HEALTH.key(bus.robot, "recorder")
    bus.subscribe(HEALTH, pulses, keep_all=True)

    def turned_away():
        entry = pulses.get(0)
        return entry is not None and entry.key == own and Health.decode(entry.payload).counters.get("turned_away", 0)

    assert wait_until(lambda: turned_away() >= 200, 20), running.output
    assert running.stop()[0] == 0
    recording = read_recording(only_file(tmp_path / "logs"))
    assert len(recording.counts()) <= MAX_KEYS
    counters = from_metadata(recording.metadata["counters"])
    assert counters["others"].dropped == counters["others"].received >= 200
    assert counters["others"].written == 0


def test_parts_by_time(recorder, bus, tmp_path):
    running = recorder("--file", "run", "--split-minutes", "0.001")
    sent = publish(bus, 100)
    settle(bus, 100)
    assert wait_until(lambda: len(list((tmp_path / "logs").glob("*.mcap"))) >= 2, 20)  # its own health goes on
    assert running.stop()[0] == 0
    files = sorted((tmp_path / "logs").iterdir())
    assert [file.name for file in files] == [f"run-{k:03d}.mcap" for k in range(1, len(files) + 1)]
    for topic in TOPICS:
        key = topic.key(bus.robot, "me")
        got = [raw.payload for file in files for raw in read_recording(file).payloads({key})]
        assert got == [payload for sent_key, payload in sent if sent_key == key]
    assert "counters" in read_recording(files[0]).metadata


def test_presage_record_beside_a_sessions_own_recorder(recorder, process, bus, link, tmp_path):
    first = recorder("--file", "first")
    where = ("--robot", bus.robot, "--connect", link.connect[0])
    second = process("presage.__main__", "record", "--out", str(tmp_path / "second"), *where)
    second.wait_for("ready")
    pulses, own = Inbox(), HEALTH.key(bus.robot, "recorder")
    bus.subscribe(HEALTH, pulses, keep_all=True)
    heard = Counter()

    def both_went_on():
        if (entry := pulses.get(0)) is not None and entry.key == own:
            heard[Health.decode(entry.payload).instance] += 1
        return len(heard) == 2 and min(heard.values()) >= 3

    assert wait_until(both_went_on, 30), second.output
    state = bus.ask(RECORDING, RecordRequest(action="stop"), RecordReply)  # the page's button
    assert (state.ok, state.recording) == (True, False)
    assert state.file.endswith("first.mcap")
    assert "recorded" not in second.output
    assert second.stop(signal.SIGINT)[0] == 0
    assert first.stop()[0] == 0
    for path in (tmp_path / "logs" / "first.mcap", only_file(tmp_path / "second")):
        recording = read_recording(path)
        (row,) = [row for row in survey(recording).topics if row.key == own]
        assert (row.missing, row.gaps, row.restarts, row.reordered) == (0, 0, 0, 0)
        count = from_metadata(recording.metadata["counters"])[own]
        assert (count.missing, count.restarts, count.reordered) == (0, 0, 0)
