"""`presage bench recorder`."""

from __future__ import annotations

import json
import os
import sys
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

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.messages.definitions import Health, Scan
from common.messages.topics import HEALTH, TOPICS, Topic
from common.versions import commit, versions
from presage.live.bus_watch import Watch
from presage.session.stack import Stack
from presage.terminal.output import check_file, make_folder, write_json
from services.recorder.files.message_counts import from_metadata
from services.recorder.reader import read_recording

NORMAL = 100.0  # messages/s of a running session: seven topics at 15 Hz, and health
SENT = tuple(topic for topic in TOPICS if topic.recorded and not topic.per_service)
LIMITS = {"core_share": 1.0, "memory_mb": 512.0}
BURST = 0.005  # s
ROBOT = "bench"


@dataclass(frozen=True)
class Load:
    """What is sent."""

    rate: float = 20 * NORMAL  # messages/s, over all topics
    seconds: float = 60.0
    beams: int = 811  # of each message, a scan of noise: 3.4 kB that hardly compress

    @property
    def count(self) -> int:
        """Messages in all."""
        return int(self.rate * self.seconds)


def publish_main() -> None:
    """Child process: sends the load, and leaves how many and their checksums by key."""
    job = json.loads(os.environ["BENCH_RECORDER"])
    load, rng = Load(**job["load"]), np.random.default_rng(0)
    ranges = rng.uniform(0.1, 25.0, (64, load.beams)).astype(np.float32)
    bodies = [Scan(stamp_ns=0, angle_min=0, angle_increment=0, range_min=0, range_max=25, ranges=r).model_dump()
              for r in ranges]  # fmt: skip
    from common.bus.bus import Link  # noqa: PLC0415

    with open_bus(Link(robot=ROBOT, connect=(os.environ["PRESAGE_CONNECT"],))) as bus:
        for topic in SENT:
            if not bus.wait_matching(topic, 20):
                raise SystemExit(f"nobody listens to {topic.name}")
        sums, late = _send(bus, load, bodies)
        sent = {topic.key(ROBOT): {"count": load.count // len(SENT), "crc": sums[topic]} for topic in SENT}
        Path(job["result"]).write_text(json.dumps({"sent": sent, "late_s": late}), encoding="utf-8")
        while True:  # the session stays open until all has been received; the parent ends us
            time.sleep(60)


def _send(bus: Bus, load: Load, bodies: list[dict[str, Any]]) -> tuple[dict[Topic, int], float]:
    """Checksum of each topic's bytes in their order, and how far behind the schedule the last message was, s."""
    sums, began = dict.fromkeys(SENT, 0), time.monotonic()
    for number in range(load.count // len(SENT) * len(SENT)):
        due = began + number / load.rate
        if due - time.monotonic() > BURST:
            time.sleep(BURST)
        topic, body = SENT[number % len(SENT)], bodies[number % len(bodies)]
        body["seq"], body["stamp_ns"] = number // len(SENT), int(number / load.rate * 1e9)
        payload = bytes(msgpack.packb(body))
        bus.put(topic, payload)
        sums[topic] = zlib.crc32(payload, sums[topic])
    return sums, time.monotonic() - due


def measure(load: Load, folder: Path, console: Console) -> dict[str, Any]:
    """Everything that is reported; the recording is left in ``folder``."""
    result = folder / "sent.json"
    job = json.dumps({"load": asdict(load), "result": str(result)})
    with Stack(ROBOT, quiet=True, environment={**os.environ, "BENCH_RECORDER": job}) as stack:
        stack.start_router()
        stack.start("recorder", "--directory", str(folder), "--file", "bench.mcap")
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            watch = Watch(bus, HEALTH)
            recorder = psutil.Process(stack.processes["recorder"].child.pid)
            stack.start_code("publisher", "from lab.benchmarks.recorder import publish_main; publish_main()")
            used = _observe(stack, watch, recorder, load, result, console)
            if (status := stack.stop("recorder")) != 0:
                raise UserError(f"the recorder ended with status {status}")
    return _compare(json.loads(result.read_text(encoding="utf-8")), folder / "bench.mcap") | used


def _observe(
    stack: Stack, watch: Watch, recorder: psutil.Process, load: Load, result: Path, console: Console
) -> dict[str, Any]:
    """Processor time and memory of the recorder until it says that it has received everything."""
    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    memory, before, began = 0, recorder.cpu_times(), time.monotonic()
    first_mb = recorder.memory_info().rss / 1e6
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("recording", total=load.count)
        received = 0
        while received < load.count // len(SENT) * len(SENT):
            stack.check()
            if time.monotonic() - began > 60 + 4 * load.seconds:
                raise UserError(f"only {received} of {load.count} messages arrived: is this machine busy?")
            health = watch.next(0.5)
            memory = max(memory, recorder.memory_info().rss)
            if isinstance(health, Health) and health.service == "recorder":
                received = sum(row.received for row in health.topics if "/health/" not in row.key)
                bar.update(task, completed=received)
            if not result.exists():
                after, ended = recorder.cpu_times(), time.monotonic()
    spent = after.user + after.system - before.user - before.system
    return {
        "core_share": spent / (ended - began), "memory_mb": memory / 1e6, "memory_before_mb": first_mb,
        "seconds": ended - began,
    }  # fmt: skip


def _compare(sent: dict[str, Any], file: Path) -> dict[str, Any]:
    """What is in the file against what was sent, by count, by number and by the bytes' checksum."""
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


def bench_recorder(load: Load, out: Path | None, json_file: Path | None, console: Console) -> int:
    """Print, and write as JSON where asked; status 1 where anything is lost or a limit is passed."""
    check_file(json_file, "--json")
    if load.count < len(SENT):
        raise UserError(f"--seconds {load.seconds:g} at --rate {load.rate:g} are too few messages: ask for more")
    if out is not None:
        make_folder(out, "--out")
    with tempfile.TemporaryDirectory() as folder:
        found = measure(load, out or Path(folder), console)
    table = Table(
        title=f"{load.rate:g} messages/s of {load.beams} beams, {load.rate / NORMAL:g} times the normal load",
        title_justify="left",
    )
    for column in ("", "measured", "limit"):
        table.add_column(column, justify="right" if column else "left")
    for name in ("sent", "received", "written", "in_file"):
        table.add_row(name.replace("_", " "), str(found[name]), str(found["sent"]))
    for name in ("dropped", "missing"):
        table.add_row(name, str(found[name]), "0")
    table.add_row("bytes and order as sent", "yes" if found["bytes_as_sent"] else "NO", "yes")
    table.add_row("share of one core", f"{found['core_share']:.2f}", f"{LIMITS['core_share']:g}")
    table.add_row("memory at most (MB)", f"{found['memory_mb']:.0f}", f"{LIMITS['memory_mb']:g}")
    table.add_row("file (MB)", f"{found['file_mb']:.1f}", "")
    console.print(table)
    about = {"limits": LIMITS, "load": asdict(load), "commit": commit(), "versions": versions(), "seed": 0}
    write_json(json_file, found | about | {"arguments": sys.argv[1:]})
    whole = found["bytes_as_sent"] and found["written"] == found["received"] == found["sent"] == found["in_file"]
    return 0 if whole and not found["dropped"] and all(found[k] <= v for k, v in LIMITS.items()) else 1
