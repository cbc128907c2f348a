"""`presage doctor` finds real faults of sessions, connections and disks; `presage top` shows a session."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, IncomingRequest
from common.messages.definitions import Health, Scan, TopicHealth
from common.messages.topics import CONFIG, HEALTH, ODOM, SCAN
from common.runtime.protocol_check import build_config_reply
from common.versions import PROTOCOL
from presage.diagnosis.bus_observation import observe_bus
from tests.conftest import ROOT, WAIT_TIMEOUT_S


class Participant:
    """A fake service in its own session with configurable replies and health messages, four times a second."""

    def __init__(self, link, name: str, *, reply_fields=None, ahead_s=0.0, scans=False, frozen=False) -> None:
        self.link, self.name, self.ahead_s, self.scans, self.frozen = link, name, ahead_s, scans, frozen
        self.reply_fields = {"uptime": 9.0, **(reply_fields or {})}
        self.ready, self.stopping = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        with open_bus(self.link) as bus:
            wait_until(bus.linked, WAIT_TIMEOUT_S)
            calls, number = Inbox(), 0
            bus.serve(CONFIG, calls, self.name)
            bus.declare_alive(self.name)
            self.ready.set()
            while not self.stopping.wait(0.25 if self.frozen else 0.0):
                if self.frozen:
                    continue
                if isinstance(call := calls.get(0.25), IncomingRequest):
                    call.reply(build_config_reply(self.name, "{}").model_copy(update=self.reply_fields).encode())
                number += 1
                bus.put(HEALTH, self.health(number).encode(), self.name)
                if self.scans:
                    ranges = np.ones(3)
                    scan = Scan(
                        stamp_ns=number, seq=number, angle_min=0, angle_increment=0.1, range_min=0, range_max=9,
                        ranges=ranges,
                    )  # fmt: skip
                    bus.put(SCAN, scan.encode())
                    bus.put(ODOM, b"\xc1")

    def health(self, number: int) -> Health:
        row = TopicHealth(key=SCAN.key(self.link.robot), received=9 * number, dropped=5 * number, undecodable=number)
        return Health(
            stamp_ns=time.time_ns() + int(self.ahead_s * 1e9), service=self.name, uptime=9.0, topics=[row],
            counters={"failed": number, "unfit_scans": number}, note="no weights of this world",
        )  # fmt: skip

    def stop(self) -> None:
        self.stopping.set()
        self.thread.join(WAIT_TIMEOUT_S)


def run_doctor(process, folder: Path, *args: str):
    return process("presage.__main__", "doctor", "--json", str(folder / "found.json"), *args)


def read_findings(folder: Path) -> list[dict]:
    return json.loads((folder / "found.json").read_text())["findings"]


def find_fault(found: list[dict], code: str, words: str) -> dict:
    fits = [f for f in found if f["code"] == code and f["ok"] is False and words in f["what"]]
    assert fits, (code, [f["what"] for f in found if f["ok"] is False])
    assert fits[0]["where"]
    return fits[0]


@pytest.fixture
def stopped_recorder(process, bus, tmp_path):
    recorder = process("recorder", "--directory", str(tmp_path), fresh=True)  # doctor looks for its command line
    assert wait_until(lambda: "recorder" in bus.alive(), WAIT_TIMEOUT_S), recorder.output
    recorder.send(signal.SIGSTOP)
    return recorder


@pytest.fixture
def faulty_session(stopped_recorder, link):
    """Two estimators of other versions with wrong clocks, two simulators, and a frozen viewer."""
    made = [
        Participant(link, "estimator", reply_fields={"protocol": PROTOCOL + 1, "host": "far"}, ahead_s=60.0),
        Participant(link, "estimator", reply_fields={"versions": {"presage": "9.9"}, "host": "near"}, ahead_s=60.0),
        Participant(link, "simulator", scans=True),
        Participant(link, "simulator", scans=True),
        Participant(link, "viewer", frozen=True),
    ]
    for each in made:
        assert each.ready.wait(WAIT_TIMEOUT_S)
    yield made
    for each in made:
        each.stop()


def test_faulty_session(process, bus, stopped_recorder, faulty_session, tmp_path):
    assert wait_until(lambda: {"viewer", "estimator", "simulator"} <= bus.alive(), WAIT_TIMEOUT_S)
    running = run_doctor(process, tmp_path, "--seconds", "4")
    assert running.wait(90) == 1, running.output
    found = read_findings(tmp_path)
    assert "far for 9 s" in find_fault(found, "doubled", "estimator of")["what"]
    assert "stop" in find_fault(found, "doubled", "simulator of")["advice"]
    assert "scan" in find_fault(found, "two_publishers", "back and forth")["where"]
    assert find_fault(found, "protocol", f"protocol {PROTOCOL + 1}")["where"] == "estimator on far"
    assert find_fault(found, "versions", "presage")["where"] == "estimator on near"
    assert "ahead of" in find_fault(found, "clocks", "estimator on far, near: its clock is 60.0 s")["what"]
    assert find_fault(found, "frozen", "no report")["where"] == "viewer"
    find_fault(found, "frozen", str(stopped_recorder.child.pid))
    assert not [f for f in found if (f["code"], f["where"]) == ("missing", "recorder")]  # it is to be resumed
    assert "python -m services.controller" in find_fault(found, "missing", "controller")["advice"]
    find_fault(found, "rate", "scan: ")
    find_fault(found, "rate", "cmd_vel: 0.0 of 15 Hz")
    assert find_fault(found, "undecodable", "odom")["where"] == ODOM.key(bus.robot)
    find_fault(found, "undecodable_rising", "estimator: ")
    find_fault(found, "dropped_rising", "estimator: ")
    find_fault(found, "failed", "simulator: ")
    find_fault(found, "weights", "estimator reports: no weights of this world")
    assert "Traceback" not in running.output
    assert "install the same version of presage" in " ".join(running.output.split())


def test_no_session():
    """At three endpoints at once, because zenoh waits for each."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(5)]
        silent, full, closed, *fillers = sockets
        for listener, queue in ((silent, 5), (full, 0), (closed, None)):
            listener.bind(("127.0.0.1", 0))
            if queue is not None:
                listener.listen(queue)
        for filler in fillers:  # a full queue drops further connections, as a firewall does
            filler.setblocking(False)
            filler.connect_ex(full.getsockname())
        links = [Link(connect=(f"tcp/127.0.0.1:{each.getsockname()[1]}",)) for each in sockets[:3]]
        with ThreadPoolExecutor(3) as pool:
            found = [finding for (finding,) in pool.map(partial(observe_bus, seconds=0.1), links)]
    for finding, code, what, advice in zip(
        found,
        ("no_router", "blocked", "no_router"),
        ("something listens there", "no answer", "nothing listens there"),
        ("TLS", "firewall", "presage up"),
        strict=True,
    ):
        assert (finding.code, finding.ok) == (code, False)
        assert what in finding.what
        assert advice in finding.advice


def test_read_only_disk_and_no_weights(tmp_path, free_port):
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
        pytest.skip("needs `unshare -m` (root): a small disk is mounted for this test alone")
    disk, world = tmp_path / "disk", tmp_path / "shed.yaml"
    disk.mkdir()
    world.write_text("name: shed\nboundary: [[0, 0], [4, 0], [4, 3], [0, 3]]\nstart: {x: 2, y: 1, yaw_deg: 0}\n")
    command = (
        f"mount -t tmpfs -o size=1m,ro tmpfs {disk} && exec {sys.executable} -m presage "
        f"--connect tcp/127.0.0.1:{free_port()} doctor --seconds 1 --world {world} --json {tmp_path}/found.json"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PRESAGE_DIRECTORY": str(disk)}
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", command], env=environment, capture_output=True, text=True, timeout=WAIT_TIMEOUT_S
    )
    assert done.returncode == 1, done.stderr
    found = read_findings(tmp_path)
    assert "Read-only file system" in find_fault(found, "not_writable", "recordings cannot be written to")["what"]
    assert find_fault(found, "disk", "MB free")["where"] == str(disk)
    assert f"presage train --world {world}" in find_fault(found, "weights", "no weights for world 'shed'")["what"]


def words(text: str) -> str:
    """The text without the table's lines, so that wrapped words are joined."""
    return " ".join("".join(" " if c in "│┃─━┏┓┗┛└┘├┤┡┩╇╋┳┬┴┻┼" else c for c in text).split())


def row_of(output: str, service: str) -> str:
    return next(words(line) for line in output.splitlines() if words(line).startswith(service))


def test_missing_services_of_two_robots(presage, process, bus, link):
    process("controller")
    assert wait_until(lambda: "controller" in bus.alive(), 60)
    outputs = []

    def controller_alive():
        status, output = presage("--connect", link.connect[0], "top", "--once", bus.robot, "nobody")
        assert status == 1
        outputs.append(output)
        return row_of(output, "controller").startswith("controller alive")

    assert wait_until(controller_alive, WAIT_TIMEOUT_S), outputs[-1]  # before its first health message it is starting
    output = outputs[-1]
    assert row_of(output, "estimator").startswith("estimator missing")
    start = f"python -m services.simulator --robot {bus.robot} --connect {link.connect[0]}"
    assert start.replace(" ", "") in words(output).replace(" ", "")
    assert "robot nobody" in output
    assert words(output).count("controller missing") == 1


def test_live_table(process, bus):
    top = process("presage.__main__", "top", env={"FORCE_COLOR": "1", "COLUMNS": "160", "LINES": "40"})
    top.wait_for("missing")
    controller = process("controller")
    top.wait_for("alive")
    controller.kill()
    top.wait_for("gone")
    assert top.stop(signal.SIGINT) == 0
    assert "\x1b[?1049h" in top.output
    assert top.output.rstrip().endswith(("\x1b[?25h", "\x1b[?1049l"))  # the terminal is restored
    assert "Traceback" not in top.output
