"""`presage replay` in a terminal and instead of the simulator, and services whose time jumps back."""

from __future__ import annotations

import fcntl
import itertools
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, Sample
from common.containers.healthcheck import find_fault
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Goal, Health, Pose, Scan
from common.messages.requests import PlayerReply, PlayerRequest
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, PLAYER, SCAN, TOPICS, TRUTH
from common.robot.scanner import SCANNERS
from common.runtime.heartbeat import read_beats
from services.recorder.files.writer import RecordingWriter
from services.recorder.replaying.replay import ReplayOptions, replay
from tests.conftest import ROOT, WAIT_TIMEOUT_S, wait_for_message

SECOND = 10**9
PERIOD = SECOND // 15
SERVICE = "services.recorder.replaying.service"


def write(path, *payloads):
    """A recording with payloads given as (topic, robot, bytes, time in ns)."""
    writer = RecordingWriter(path)
    for topic, robot, payload, at in payloads:
        writer.write(topic, topic.key(robot), payload, at, at)
    return writer.finish()


def scan(number, ranges=(2.0,) * 5, **more):
    fields = {"angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.05, "range_max": 25.0, **more}
    return Scan(stamp_ns=number * PERIOD, seq=number, ranges=np.array(ranges, np.float32), **fields)


@pytest.fixture
def terminal(tmp_path, link):
    """A replay in a pseudo-terminal: the process, the terminal's other end, and whether its modes are restored."""
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)

    def take_terminal():
        os.setsid()
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a script's background commands

    file = write(tmp_path / "hour.mcap", *((SCAN, link.robot, bytes([n % 256]), n * SECOND) for n in range(3600)))
    with (tmp_path / "output").open("wb") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", "presage", "--connect", link.connect[0], "replay", str(file)],
            stdin=theirs, stdout=output, stderr=output, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
            preexec_fn=take_terminal,
        )  # fmt: skip
    yield child, ours, lambda: termios.tcgetattr(theirs) == before
    with suppress(ProcessLookupError):
        child.kill()
    child.wait()
    os.close(ours)
    os.close(theirs)


def state(bus):
    return bus.query(PLAYER, PlayerRequest(action="status"), PlayerReply, timeout=WAIT_TIMEOUT_S)


def test_keys_in_a_terminal(terminal, bus, tmp_path):
    child, ours, as_before = terminal
    assert wait_until(lambda: b"q: quit" in (tmp_path / "output").read_bytes() and not as_before(), WAIT_TIMEOUT_S)
    os.write(ours, b" ")
    assert wait_until(lambda: state(bus).paused, WAIT_TIMEOUT_S)
    here = state(bus).position_s
    for key, position in ((b"l", here + 5), (b"\x1b[D", here), (b".", np.ceil(here))):
        os.write(ours, key)
        assert wait_until(lambda p=position: state(bus).position_s == pytest.approx(p), WAIT_TIMEOUT_S), key
    os.write(ours, b"\x1b[A")
    assert wait_until(lambda: state(bus).rate == 2.0, WAIT_TIMEOUT_S)
    os.write(ours, b" q")
    assert child.wait(WAIT_TIMEOUT_S) == 0
    assert as_before()
    assert b"replayed presage/" in (tmp_path / "output").read_bytes()


def test_interrupt_in_a_terminal(terminal, bus, tmp_path):
    child, _, as_before = terminal
    assert wait_until(lambda: not as_before(), WAIT_TIMEOUT_S)
    assert state(bus).duration_s == 3599.0
    child.send_signal(signal.SIGINT)
    assert child.wait(WAIT_TIMEOUT_S) == 130
    assert as_before()
    assert "Traceback" not in (tmp_path / "output").read_text()


def test_time_that_jumps_back(process, bus, link, tmp_path):
    """A looping replay of ten scans along the corridor: after each jump back the belief is right at once."""
    world, scanner = load_world("corridor"), SCANNERS["tim571"].with_beams(200)
    poses = np.array([[3.0 + 0.05 * n, 1.5, np.pi / 2] for n in range(10)])
    truth = {n * PERIOD: pose for n, pose in enumerate(poses)}
    seen = world.ray_distances(se2.compose(poses, scanner.mount), scanner.angles())
    geometry = {"angle_min": scanner.angle_min, "angle_increment": scanner.angle_increment}
    scans = [scan(n, ranges, **geometry, mount=Pose.of(scanner.mount)) for n, ranges in enumerate(seen)]
    path = write(tmp_path / "loop.mcap", *((SCAN, link.robot, each.encode(), each.stamp_ns) for each in scans))
    services = [
        process("estimator", "--model", "exact", "--initial-pose", "3,1.5,90"),
        process("controller", "--belief-timeout", "60"),
    ]
    inbox = Inbox()
    for topic in (BELIEF, CMD_VEL, HEALTH):
        bus.subscribe(topic, inbox, keep_all=True)
    assert wait_until(lambda: {"estimator", "controller"} <= bus.alive(), 60), [s.output for s in services]
    assert bus.wait_matching(GOAL, WAIT_TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=15.5, y=1.5)).encode())
    stop, beliefs, commands, failed = threading.Event(), [], [], {}
    thread = threading.Thread(target=partial(replay, path, link, ReplayOptions(rate=0.5, loop=True), stop=stop))
    thread.start()

    def three_jumps():
        while isinstance(sample := inbox.get(0), Sample):
            message = sample.topic.message.decode(sample.payload)
            if isinstance(message, Health):
                failed[message.service] = message.counters["failed"]
            else:
                (beliefs if isinstance(message, Belief) else commands).append(message)
        # Not every belief is answered: a busy controller leaves some out.
        back = [sum(b.stamp_ns < a.stamp_ns for a, b in itertools.pairwise(each)) for each in (beliefs, commands)]
        return min(back) >= 3 and {"estimator", "controller"} <= failed.keys()

    try:
        assert wait_until(three_jumps, WAIT_TIMEOUT_S), [s.output for s in services]
    finally:
        stop.set()
        thread.join(WAIT_TIMEOUT_S)
    assert not any(failed.values()), [s.output for s in services]
    assert {belief.state for belief in beliefs} == {"tracking"}
    assert max(np.hypot(*(b.pose.array() - truth[b.stamp_ns])[:2]) for b in beliefs) < 0.05
    assert {command.stamp_ns for command in commands if isinstance(command, CmdVel)} <= truth.keys()


@pytest.fixture
def recordings(tmp_path):
    """A folder with a recording of another robot with scans and beliefs, and one without scans."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    scans = [(SCAN, "other", scan(n).encode(), SECOND + n * PERIOD) for n in range(4)]
    write(folder / "drive.mcap", *scans, (BELIEF, "other", b"x", SECOND))
    write(folder / "truth.mcap", (TRUTH, "other", b"x", SECOND))
    return folder


def test_recording_instead_of_the_simulator(bus, process, recordings, tmp_path):
    scans, all_else = Inbox(), Inbox()
    for topic in TOPICS:
        bus.subscribe(topic, scans if topic is SCAN else all_else, keep_all=True)
    running = process(SERVICE, "--directory", str(recordings), "--replay", "drive.mcap", "--heartbeat", str(tmp_path))
    for _ in range(2):  # the replay loops
        for number in range(4):
            assert wait_for_message(scans, Scan, lambda _: True).seq == number, running.output

    def healthy():
        return find_fault("replay", read_beats(tmp_path, "replay"), [bus.robot], time.monotonic()) == ""

    assert wait_until(healthy, WAIT_TIMEOUT_S), read_beats(tmp_path, "replay")
    assert running.stop() == 0
    assert not all_else.received


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("", ["no recording '' in "]),
        ("other.mcap", ["no recording 'other.mcap' in ", "there are drive.mcap, truth.mcap"]),
        ("truth.mcap", ["no scans in this recording"]),
    ],
)
def test_recording_that_cannot_be_replayed(process, recordings, name, says):
    running = process(SERVICE, "--directory", str(recordings), "--replay", name)
    assert running.wait() == 2
    assert all(part in running.output for part in says), running.output


def test_wait_for_a_remote_robot(bus, process, tmp_path):
    running = process("common.containers.remote_robot", "--heartbeat", str(tmp_path))

    def fault():
        return find_fault("remote", read_beats(tmp_path, "remote"), [bus.robot], time.monotonic())

    wanted = f"{bus.robot}: no scan was received so far (no scan so far)"
    assert wait_until(lambda: fault() == wanted, WAIT_TIMEOUT_S), fault()
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    assert wait_until(lambda: bus.put(SCAN, scan(0).encode()) or fault() == "", WAIT_TIMEOUT_S), fault()
    running.wait_for("scans are arriving")
    running.wait_for("no scan for 5 s")
    assert wait_until(lambda: "no scan was received for" in fault(), WAIT_TIMEOUT_S), fault()
    assert running.stop() == 0
