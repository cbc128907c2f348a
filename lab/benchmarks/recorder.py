"""`presage bench recorder`."""

from __future__ import annotations

import json
import os
import tempfile
import time
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import psutil
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from common.bus.bus import Bus, Link, open_bus
from common.errors import UserError
from common.messages.definitions import Health, Scan
from common.messages.topics import HEALTH, TOPICS, Topic
from presage.live.latest_messages import LatestMessages
from presage.session.stack import Stack
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording

NORMAL_RATE = 100.0  # messages/s of a normal session: seven topics at 15 Hz, and health
LOAD_TOPICS = tuple(topic for topic in TOPICS if topic.recorded and not topic.per_service)
LIMITS = {"core_share": 1.0, "memory_mb": 512.0}
SEND_INTERVAL_S = 0.005  # messages due within this time are sent together
ROBOT = "bench"


@dataclass(frozen=True)
class RecorderLoad:
    """Messages sent to the recorder."""

    rate: float = 20 * NORMAL_RATE  # messages/s, over all topics
    seconds: float = 60.0
    beams: int = 811  # per message; each is a scan of random ranges, 3.4 kB that hardly compress

    @property
    def per_topic(self) -> int:
        """Number of messages on each topic."""
        return int(self.rate * self.seconds) // len(LOAD_TOPICS)

    @property
    def count(self) -> int:
        """Number of messages on all topics."""
        return self.per_topic * len(LOAD_TOPICS)


def publish_main() -> None:
    """Entry point of the publisher process: sends the load, then writes message counts and checksums by key."""
    job = json.loads(os.environ["BENCH_RECORDER"])
    load, rng = RecorderLoad(**job["load"]), np.random.default_rng(0)
    ranges = rng.uniform(0.1, 25.0, (64, load.beams)).astype(np.float32)
    bodies = [
        Scan(stamp_ns=0, angle_min=0, angle_increment=0.01, range_min=0, range_max=25, ranges=r).model_dump()
        for r in ranges
    ]
    with open_bus(Link(robot=ROBOT, connect=(os.environ["PRESAGE_CONNECT"],))) as bus:
        for topic in LOAD_TOPICS:
            if not bus.wait_matching(topic, 20):
                raise SystemExit(f"no subscriber to {topic.name} within 20 s")
        sums, late = _send(bus, load, bodies)
        sent = {topic.key(ROBOT): {"count": load.per_topic, "crc": sums[topic]} for topic in LOAD_TOPICS}
        Path(job["result"]).write_text(json.dumps({"sent": sent, "late_s": late}), encoding="utf-8")
        while True:  # keep the session open until the recorder has received everything; the parent ends this process
            time.sleep(60)


def _send(bus: Bus, load: RecorderLoad, bodies: list[dict[str, Any]]) -> tuple[dict[Topic, int], float]:
    """Sends the load. Returns each topic's checksum over its payloads in order, and the last message's delay in s."""
    sums, began = dict.fromkeys(LOAD_TOPICS, 0), time.monotonic()
    for number in range(load.count):
        due = began + number / load.rate
        if due - time.monotonic() > SEND_INTERVAL_S:
            time.sleep(SEND_INTERVAL_S)
        topic, body = LOAD_TOPICS[number % len(LOAD_TOPICS)], bodies[number % len(bodies)]
        body["seq"], body["stamp_ns"] = number // len(LOAD_TOPICS), int(number / load.rate * 1e9)
        payload = bytes(msgpack.packb(body))
        bus.put(topic, payload)
        sums[topic] = zlib.crc32(payload, sums[topic])
    return sums, time.monotonic() - due


def measure(load: RecorderLoad, folder: Path, console: Console) -> dict[str, Any]:
    """Runs the benchmark and returns its results. The recording stays in ``folder``."""
    result = folder / "sent.json"
    job = json.dumps({"load": asdict(load), "result": str(result)})
    with Stack(ROBOT, quiet=True, environment={**os.environ, "BENCH_RECORDER": job}) as stack:
        stack.start_router()
        stack.start("recorder", "--directory", str(folder), "--file", "bench.mcap")
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            messages = LatestMessages(bus, HEALTH)
            recorder = psutil.Process(stack.processes["recorder"].child.pid)
            stack.start_python("publisher", "from lab.benchmarks.recorder import publish_main; publish_main()")
            used = _observe(stack, messages, recorder, load, result, console)
            if (status := stack.stop("recorder")) != 0:
                raise UserError(f"the recorder ended with status {status}")
    return _compare(json.loads(result.read_text(encoding="utf-8")), folder / "bench.mcap") | used


def _observe(
    stack: Stack, messages: LatestMessages, recorder: psutil.Process, load: RecorderLoad, result: Path, console: Console
) -> dict[str, Any]:
    """Processor share and memory of the recorder until its health message reports that it received everything."""
    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    memory, before, began = 0, recorder.cpu_times(), time.monotonic()
    first_mb = recorder.memory_info().rss / 1e6
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("recording", total=load.count)
        received = 0
        while received < load.count:
            stack.check()
            if time.monotonic() - began > 60 + 4 * load.seconds:
                raise UserError(f"only {received} of {load.count} messages arrived: is this machine busy?")
            health = messages.next(0.5)
            memory = max(memory, recorder.memory_info().rss)
            if isinstance(health, Health) and health.service == "recorder":
                received = sum(row.received for row in health.topics if "/health/" not in row.key)
                bar.update(task, completed=received)
            if not result.exists():
                after, ended = recorder.cpu_times(), time.monotonic()
    spent = after.user + after.system - before.user - before.system
    return {
        "core_share": spent / (ended - began),
        "memory_mb": memory / 1e6,
        "memory_before_mb": first_mb,
        "seconds": ended - began,
    }


def _compare(sent: dict[str, Any], file: Path) -> dict[str, Any]:
    """Compares the recording with what was sent: counts, and checksums over the payloads."""
    recording = read_recording(file)
    sums, numbers, intact = dict.fromkeys(sent["sent"], 0), dict.fromkeys(sent["sent"], 0), True
    for raw in recording.payloads(sent["sent"].keys()):
        sums[raw.key] = zlib.crc32(raw.payload, sums[raw.key])
        numbers[raw.key] += 1
    for key, row in sent["sent"].items():
        intact &= numbers[key] == row["count"] and sums[key] == row["crc"]
    counts = from_metadata(recording.metadata["counters"])
    rows = [counts[key] for key in sent["sent"]]
    return {
        "sent": sum(row["count"] for row in sent["sent"].values()),
        "received": sum(row.received for row in rows),
        "written": sum(row.written for row in rows),
        "dropped": sum(row.dropped for row in rows),
        "missing": sum(row.missing for row in rows),
        "in_file": sum(numbers.values()),
        "bytes_as_sent": intact and recording.complete,
        "file_mb": file.stat().st_size / 1e6,
        "publisher_late_s": sent["late_s"],
    }


def bench_recorder(load: RecorderLoad, out: Path | None, json_file: Path | None, console: Console) -> int:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    Returns exit status 1 if a message was lost or altered, or if a limit was exceeded.
    """
    check_file(json_file, "--json")
    if not load.count:
        raise UserError(
            f"--seconds {load.seconds:g} at --rate {load.rate:g} give less than one message per topic: increase either"
        )
    if out is not None:
        make_folder(out)
    with tempfile.TemporaryDirectory() as folder:
        result = measure(load, out or Path(folder), console)
    table = Table(
        title=f"{load.rate:g} messages/s of {load.beams} beams, {load.rate / NORMAL_RATE:g} times the normal load",
        title_justify="left",
    )
    for column in ("", "measured", "limit"):
        table.add_column(column, justify="right" if column else "left")
    for name in ("sent", "received", "written", "in_file"):
        table.add_row(name.replace("_", " "), str(result[name]), str(result["sent"]))
    for name in ("dropped", "missing"):
        table.add_row(name, str(result[name]), "0")
    table.add_row("bytes and order as sent", "yes" if result["bytes_as_sent"] else "NO", "yes")
    table.add_row("share of one core", f"{result['core_share']:.2f}", f"{LIMITS['core_share']:g}")
    table.add_row("memory at most (MB)", f"{result['memory_mb']:.0f}", f"{LIMITS['memory_mb']:g}")
    table.add_row("file (MB)", f"{result['file_mb']:.1f}", "")
    console.print(table)
    write_json(json_file, {**result, "limits": LIMITS, "load": asdict(load), **provenance(seed=0)})
    whole = result["bytes_as_sent"] and result["written"] == result["received"] == result["sent"] == result["in_file"]
    return 0 if whole and not result["dropped"] and all(result[k] <= v for k, v in LIMITS.items()) else 1
