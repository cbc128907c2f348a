"""The recorder as a process, over real zenoh."""

from __future__ import annotations

import itertools
import json
import random
import re
import signal
from collections import Counter

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import MAX_KEYS, Inbox
from common.messages.definitions import Health
from common.messages.topics import HEALTH, ODOM, SCAN, TOPICS
from presage.recordings.info import collect_facts
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording
from services.recorder.recover import recover
from tests.conftest import WAIT_TIMEOUT_S
from tests.recorder import sessions


def only_file(folder, suffix=".mcap"):
    (path,) = folder.glob("*" + suffix)
    return path


def publish(bus, count, seed=1):
    """Publishes arbitrary bytes on every topic. Returns payloads by key."""
    sent, source = {topic.key(bus.robot, "me"): [] for topic in TOPICS}, random.Random(seed)
    for topic in TOPICS:
        assert bus.wait_matching(topic, 10, service="me")
    for number in range(count):
        topic = TOPICS[number % len(TOPICS)]
        payload = number.to_bytes(4, "big") + source.randbytes(source.choice([0, 10, 3300]))
        bus.put(topic, payload, service="me")
        sent[topic.key(bus.robot, "me")].append(payload)
    return sent


def payloads_in(files, keys):
    found = {key: [] for key in keys}
    for file in files:
        for raw in read_recording(file).payloads(keys):
            found[raw.key].append(raw.payload)
    return found


def received(bus, count):
    """Condition of `recorder_health`: has received so many messages of other services."""
    own = HEALTH.key(bus.robot, "recorder")
    return lambda health, _: sum(row.received for row in health.topics if row.key != own) >= count


def test_every_payload_is_in_the_file(recorder, recorder_health, simulator, bus, logs):
    running = recorder()
    active = only_file(logs, ".mcap.active")
    assert wait_until(lambda: b"world.yaml" in active.read_bytes(), 20), running.output
    sent = publish(bus, 1000)
    recorder_health(received(bus, 1000))
    assert running.stop(signal.SIGTERM) == 0, running.output
    path = only_file(logs)
    assert path.name.startswith(f"presage-{bus.robot}-")
    assert str(path) in running.output
    recording = read_recording(path)
    assert recording.complete
    assert payloads_in([path], sent) == sent
    assert all(0 < r.published_ns <= r.logged_ns + 1_000_000_000 for r in recording.payloads())
    counters = from_metadata(recording.metadata["counters"])
    assert counters[SCAN.key(bus.robot)].received == len(sent[SCAN.key(bus.robot)])
    assert all(c.received == c.written and c.dropped == c.missing == 0 for c in counters.values())
    assert {key: c.written for key, c in counters.items()} == recording.counts
    assert recording.world() == sessions.WORLD
    assert recording.robot().radius == 0.31
    metadata = recording.metadata
    assert json.loads(metadata["world"]["scanner"])["beams"] == sessions.SCANNER.beams
    assert json.loads(metadata["config:simulator"]["config"])["robot"] == bus.robot
    assert "python" in metadata["config:simulator"]
    assert metadata["presage"]["commit"]
    assert "services.recorder" in metadata["presage"]["command"].replace("/", ".")
    assert json.loads(metadata["config:recorder"]["config"])["compression"] == "zstd"


def test_chosen_topics(recorder, recorder_health, bus, logs):
    running = recorder("--topics", "odom", "--file", "some", "--compression", "none")
    assert bus.wait_matching(ODOM, 10)
    bus.put(SCAN, b"no")
    bus.put(ODOM, b"yes")
    recorder_health(lambda _, odom: odom.received == 1)
    assert running.stop(signal.SIGINT) == 0
    assert [(r.key, r.payload) for r in read_recording(logs / "some.mcap").payloads()] == [
        (ODOM.key(bus.robot), b"yes")
    ]


def test_kill_9_keeps_what_was_flushed(recorder, bus, logs):
    """The recorder flushes without any further message; another recorder names the command that recovers the file."""
    killed, alive = recorder("--file", "first", "--topics", "odom"), recorder("--file", "second")
    assert bus.wait_matching(ODOM, 10)
    sent = [number.to_bytes(4, "big") for number in range(300)]
    for payload in sent:
        bus.put(ODOM, payload)
    active = logs / "first.mcap.active"
    assert wait_until(lambda: len(list(read_recording(active).payloads())) == len(sent), 20), killed.output
    killed.kill()
    assert not read_recording(active).complete
    third = recorder("--file", "third")
    third.wait_for(f"presage recover {active}")
    assert "second.mcap.active" not in third.output
    assert alive.stop() == third.stop() == 0
    assert [raw.payload for raw in read_recording(recover(active).path).payloads()] == sent


IMPATIENT = """
import sys
from services.recorder import service
from services.recorder.__main__ import RecorderSettings, main, build_service
service.SERVICE_WARNING_DELAY_S = 0.1
sys.argv[0] = "recorder"
main(RecorderSettings, build_service)
"""


def test_warning_without_router(processes, tmp_path, free_port):
    (tmp_path / "impatient.py").write_text(IMPATIENT)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ("--directory", str(tmp_path), "--flush", "0.1")
    running = processes.start(tmp_path / "impatient.py", *arguments, env={"PRESAGE_CONNECT": endpoint})
    running.wait_for(f"nothing answers at {endpoint}")
    running.wait_for("start a session with `presage up`")
    processes.start("common.router", "--listen", endpoint)
    running.wait_for("no service of robot robot is running")
    processes.start("services.simulator", "--beams", "16", env={"PRESAGE_CONNECT": endpoint})
    running.wait_for("messages can arrive now")
    assert running.output.count("nothing answers") == running.output.count("no service") == 1
    assert running.stop() == 0


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--topics", "skan"), "recorder: no topic skan: choose from scan"),
        (("--directory", "/dev/null/x"), "recorder: /dev/null/x: cannot be written to"),
        (("--file", "a/b"), "recorder: file: "),
    ],
)
def test_invalid_settings(process, args, message):
    running = process("recorder", *args)
    assert running.wait() == 2
    lines = [line for line in running.output.splitlines() if "[" not in line[:12]]
    assert lines[-1].startswith(message), running.output
    assert "Traceback" not in running.output


LIMITED = """
import functools, resource, runpy, sys
from services.recorder import recording
recording.RecordingWriter = functools.partial(recording.RecordingWriter, chunk_size=20_000)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))  # acts like a full disk
sys.argv = ["recorder", *sys.argv[1:]]
runpy.run_module("services.recorder", run_name="__main__")
"""


def test_full_disk(process, bus, tmp_path, logs):
    (tmp_path / "limited.py").write_text(LIMITED)
    running = process(tmp_path / "limited.py", "--directory", str(logs), "--compression", "none")
    running.wait_for("ready")
    sent = publish(bus, 400)
    assert running.wait() == 2, running.output
    (line,) = [line for line in running.output.splitlines() if line.startswith("recorder: ")]
    assert "recording failed (File too large)" in line
    assert "presage recover" in line
    assert "Traceback" not in running.output
    found = recover(only_file(logs, ".mcap.active"))
    last = next(line for line in running.output.splitlines() if "recording is incomplete" in line)
    counts = {name: int(number) for name, number in re.findall(r"(messages|lost|missing)=(\d+)", last)}
    assert counts["lost"] > 0
    assert 0 < counts["messages"] <= found.messages.total()
    for key, payloads in payloads_in([found.path], sent).items():
        assert payloads == sent[key][: len(payloads)]


def test_removed_file(recorder, logs):
    running = recorder()
    only_file(logs, ".mcap.active").unlink()
    assert running.wait() == 2
    assert "was removed or moved while it was being written" in running.output
    assert "Traceback" not in running.output


def test_invented_keys(recorder, recorder_health, bus, logs):
    running = recorder()
    assert bus.wait_matching(HEALTH, 10, service="me")
    numbers = itertools.count()

    def messages_rejected(health, _):
        for _ in range(200):  # again after each report, because some are lost on a busy machine
            bus.put(HEALTH, b"", service=f"x{next(numbers)}")
        return health.counters.get("messages_rejected", 0) >= 200

    for number in range(MAX_KEYS):
        bus.put(HEALTH, b"", service=f"y{number}")
    recorder_health(messages_rejected)
    assert running.stop() == 0
    recording = read_recording(only_file(logs))
    assert len(recording.counts) <= MAX_KEYS
    others = from_metadata(recording.metadata["counters"])["others"]
    assert others.dropped == others.received >= 200
    assert others.written == 0


def test_parts_by_time(recorder, recorder_health, bus, logs):
    running = recorder("--file", "run", "--split-minutes", "0.001")
    sent = publish(bus, 50)

    def two_parts():
        for key, payloads in publish(bus, len(TOPICS), seed=2).items():
            sent[key] += payloads
        return len(list(logs.glob("*.mcap"))) >= 2

    assert wait_until(two_parts, WAIT_TIMEOUT_S, 0.05)
    recorder_health(received(bus, sum(map(len, sent.values()))))
    assert running.stop() == 0
    files = sorted(logs.iterdir())
    assert [file.name for file in files] == [f"run-{k:03d}.mcap" for k in range(1, len(files) + 1)]
    assert payloads_in(files, sent) == sent
    counts = from_metadata(read_recording(files[0]).metadata["counters"])
    assert all(count.received == count.written for count in counts.values())  # with the next part's first


def test_presage_record_beside_a_recorder(recorder, request_recording, process, bus, tmp_path, logs):
    first = recorder("--file", "first")
    second = process("presage.__main__", "record", "--out", str(tmp_path / "second"))
    second.wait_for("ready")
    inbox, own, heard = Inbox(), HEALTH.key(bus.robot, "recorder"), Counter()
    bus.subscribe(HEALTH, inbox, keep_all=True)

    def both_publish():
        if (entry := inbox.get(0)) is not None and entry.key == own:
            heard[Health.decode(entry.payload).instance] += 1
        return len(heard) == 2 and min(heard.values()) >= 2

    assert wait_until(both_publish, WAIT_TIMEOUT_S), second.output
    state = request_recording("stop")
    assert (state.ok, state.recording) == (True, False)
    assert state.file.endswith("first.mcap")
    assert "recorded" not in second.output
    assert second.stop(signal.SIGINT) == 0
    assert first.stop() == 0
    for path in (logs / "first.mcap", only_file(tmp_path / "second")):
        recording = read_recording(path)
        (row,) = [row for row in collect_facts(recording).topics if row.key == own]
        assert (row.missing, row.gaps, row.restarts, row.reordered) == (0, 0, 0, 0)
        count = from_metadata(recording.metadata["counters"])[own]
        assert (count.missing, count.restarts, count.reordered) == (0, 0, 0)
