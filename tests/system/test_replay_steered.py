"""`presage replay` in a terminal, and services whose time jumps back."""

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
from contextlib import suppress

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, Sample
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Goal, Health, Pose, Scan
from common.messages.requests import PlayerReply, PlayerRequest
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, PLAYER, SCAN
from common.robot.scanner import SCANNERS
from services.recorder.files.writer import RecordingWriter
from services.recorder.replaying.replay import ReplayOptions, replay
from tests.conftest import ROOT, WAIT_TIMEOUT_S

SECOND = 10**9


def write_one_hour(path, robot):
    """Writes a recording of one hour with one scan per second."""
    writer = RecordingWriter(path)
    for n in range(3600):
        writer.write(SCAN, SCAN.key(robot), bytes([n % 256]), n * SECOND, n * SECOND)
    return writer.finish()


@pytest.fixture
def terminal(tmp_path, link):
    """A replay in a pseudo-terminal: the process, the terminal's other end, and whether its modes are restored."""
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)

    def take_terminal():
        os.setsid()
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)

    args = ["replay", str(write_one_hour(tmp_path / "hour.mcap", link.robot)), "--connect", link.connect[0]]
    with (tmp_path / "output").open("wb") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", "presage", *args], stdin=theirs, stdout=output, stderr=output, cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, preexec_fn=take_terminal,  # noqa: PLW1509 - no lock in it
        )  # fmt: skip
    yield child, ours, lambda: termios.tcgetattr(theirs) == before
    with suppress(ProcessLookupError):
        child.kill()
    child.wait()
    os.close(ours)
    os.close(theirs)


def state(bus):
    return bus.ask(PLAYER, PlayerRequest(action="status"), PlayerReply, timeout=WAIT_TIMEOUT_S)


def test_keys_control_the_replay_and_the_terminal_is_restored(terminal, bus, tmp_path):
    child, ours, as_before = terminal
    assert wait_until(lambda: b"q: quit" in (tmp_path / "output").read_bytes(), WAIT_TIMEOUT_S)
    assert wait_until(lambda: not as_before(), WAIT_TIMEOUT_S)
    os.write(ours, b" ")
    assert wait_until(lambda: state(bus).paused, WAIT_TIMEOUT_S)
    here = state(bus).position_s
    os.write(ours, b"l")
    assert wait_until(lambda: state(bus).position_s == pytest.approx(here + 5), WAIT_TIMEOUT_S)
    os.write(ours, b"\x1b[D")
    assert wait_until(lambda: state(bus).position_s == pytest.approx(here), WAIT_TIMEOUT_S)
    os.write(ours, b".")
    assert wait_until(lambda: state(bus).position_s == pytest.approx(np.ceil(here)), WAIT_TIMEOUT_S)
    os.write(ours, b"\x1b[A")
    assert wait_until(lambda: state(bus).rate == 2.0, WAIT_TIMEOUT_S)
    os.write(ours, b" q")
    assert child.wait(WAIT_TIMEOUT_S) == 0
    assert as_before()
    assert b"replayed presage/" in (tmp_path / "output").read_bytes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_replay_cleanly(terminal, bus, tmp_path, number):
    child, _, as_before = terminal
    assert wait_until(lambda: not as_before(), WAIT_TIMEOUT_S)
    assert state(bus).duration_s == 3599.0
    child.send_signal(number)
    assert child.wait(WAIT_TIMEOUT_S) == 130
    assert as_before()
    assert "Traceback" not in (tmp_path / "output").read_text()


def test_services_treat_a_jump_back_in_time_as_a_new_session(process, bus, link, tmp_path):
    """A looping replay of ten scans along the corridor: after each jump back the belief is right at once."""
    world, scanner = load_world("corridor"), SCANNERS["tim571"].with_beams(200)
    writer, truth = RecordingWriter(tmp_path / "loop.mcap"), {}
    for n in range(10):
        pose = np.array([3.0 + 0.05 * n, 1.5, np.pi / 2])
        truth[n * SECOND // 15] = pose
        ranges = world.ray_distances(se2.compose(pose, scanner.mount)[None], scanner.angles())[0]
        scan = Scan(
            stamp_ns=n * SECOND // 15, seq=n, angle_min=scanner.angle_min, angle_increment=scanner.angle_increment,
            range_min=0.05, range_max=25.0, ranges=ranges, mount=Pose.of(scanner.mount),
        )  # fmt: skip
        writer.write(SCAN, SCAN.key(link.robot), scan.encode(), n * SECOND // 15, n * SECOND // 15)
    path = writer.finish()
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
    choice = ReplayOptions(rate=0.5, loop=True)
    thread = threading.Thread(target=replay, args=(path, link, choice), kwargs={"stop": stop})
    thread.start()

    def jumps():
        while isinstance(sample := inbox.get(0), Sample):
            message = sample.topic.message.decode(sample.payload)
            if isinstance(message, Health):
                failed[message.service] = message.counters["failed"]
            else:
                (beliefs if isinstance(message, Belief) else commands).append(message)
        back = sum(b.stamp_ns < a.stamp_ns for a, b in itertools.pairwise(beliefs))
        return back >= 3 and {"estimator", "controller"} <= failed.keys()

    try:
        assert wait_until(jumps, 60), [s.output for s in services]
    finally:
        stop.set()
        thread.join(WAIT_TIMEOUT_S)
    assert not any(failed.values()), [s.output for s in services]
    errors = [np.hypot(*(b.pose.array() - truth[b.stamp_ns])[:2]) for b in beliefs]
    assert np.max(errors) < 0.05
    assert {command.stamp_ns for command in commands if isinstance(command, CmdVel)} <= truth.keys()
    assert len(commands) >= len(beliefs) - 1  # each answered
