"""`presage bench viewer`."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.progress import track
from rich.table import Table
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from common.bus.bus import Bus, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.topics import CMD_VEL, SCAN
from presage.session.ports import free_port
from presage.session.stack import Stack
from presage.terminal.output import check_file, machine, provenance, write_json

WARM_UP_S = 3.0  # at the start of every round, left out of the statistics
TIMEOUT_S = 60.0
ROBOT = "bench"


class FrameCounter:
    """A client that receives every frame, as a browser would, and only counts them."""

    def __init__(self, port: int) -> None:
        """Connects, and subscribes to the robot. Raises UserError if the viewer's web socket does not answer."""
        self.frames = self.bytes = 0
        try:
            origin, where = Origin(f"http://127.0.0.1:{port}"), f"ws://127.0.0.1:{port}/ws"
            # As a context manager, because later versions of websockets warn of any other use.
            self._socket: ClientConnection = connect(where, origin=origin, open_timeout=TIMEOUT_S).__enter__()
        except (OSError, TimeoutError) as error:
            raise UserError(f"the viewer's socket at port {port} does not answer: {error}") from None
        self._socket.send(json.dumps({"id": 1, "do": "watch", "robot": ROBOT}))
        self._thread = threading.Thread(target=self._read, name="visitor", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        try:
            for message in self._socket:
                if isinstance(message, bytes):
                    self.frames += 1
                    self.bytes += len(message)
        except ConnectionClosed:
            return

    def close(self) -> None:
        """Closes the web socket."""
        self._socket.close()
        self._thread.join(5)


@dataclass
class ViewerCost:
    """Totals over all rounds with, or all rounds without, the viewer."""

    latency_ms: list[float] = field(default_factory=list)
    unanswered: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0  # of the viewer
    memory_mb: float = 0.0
    frames: int = 0
    bytes: int = 0


def measure(seconds: float, rounds: int, beams: int, console: Console) -> dict[str, Any]:
    """Runs rounds of ``seconds`` s without and with the viewer, alternating, in one session. Returns the results."""
    without, viewed = ViewerCost(), ViewerCost()
    with Stack(ROBOT, quiet=True) as stack:
        stack.start_router()
        stack.start("controller")
        stack.start("estimator", "--initial-pose", "3,1.5")
        stack.start("simulator", "--beams", str(beams))
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            _first_command(bus, stack)
            for number in track(range(2 * rounds), "without, with", console=console, transient=True):
                if number % 2:
                    _measure_with_viewer(bus, stack, seconds, viewed)
                else:
                    time.sleep(WARM_UP_S)
                    _measure_latency(bus, stack, seconds, without)
    return _report(without, viewed, seconds, rounds, beams)


def _first_command(bus: Bus, stack: Stack) -> None:
    inbox = Inbox()
    bus.subscribe(CMD_VEL, inbox)
    deadline = time.monotonic() + TIMEOUT_S
    while inbox.get(0.5) is None:
        stack.check()
        if time.monotonic() > deadline:
            raise UserError(f"the controller sent no velocity command within {TIMEOUT_S:g} s")


def _measure_with_viewer(bus: Bus, stack: Stack, seconds: float, cost: ViewerCost) -> None:
    port = free_port()
    stack.start("viewer", "--port", str(port))
    stack.wait_alive(bus)
    visitor = FrameCounter(port)
    try:
        if not wait_until(lambda: visitor.frames > 0, TIMEOUT_S):
            raise UserError(f"the viewer sent no frame within {TIMEOUT_S:g} s")
        time.sleep(WARM_UP_S)
        process = psutil.Process(stack.processes["viewer"].child.pid)
        before, frames, size = process.cpu_times(), visitor.frames, visitor.bytes
        _measure_latency(bus, stack, seconds, cost)
        after = process.cpu_times()
        cost.cpu_s += after.user + after.system - before.user - before.system
        cost.memory_mb = max(cost.memory_mb, process.memory_info().rss / 1e6)
        cost.frames, cost.bytes = cost.frames + visitor.frames - frames, cost.bytes + visitor.bytes - size
    finally:
        visitor.close()
    stack.stop("viewer")


def _measure_latency(bus: Bus, stack: Stack, seconds: float, cost: ViewerCost) -> None:
    """Records the time from each scan's publication to its command's. All publishers use this machine's clock.

    Takes ``seconds`` s, and as long as the first answer takes: on a busy machine a short round may have none.
    """
    inbox, scans = Inbox(), dict[int, int]()
    ends = [bus.subscribe(topic, inbox, keep_all=True) for topic in (SCAN, CMD_VEL)]
    began, answered = time.monotonic(), len(cost.latency_ms)
    while (spent := time.monotonic() - began) < seconds or len(cost.latency_ms) == answered:
        if spent > seconds + TIMEOUT_S:
            raise UserError(f"no scan was answered within {spent:.0f} s")
        sample = inbox.get(0.05)
        if not isinstance(sample, Sample):
            stack.check()
            continue
        stamp = sample.topic.message.decode(sample.payload).stamp_ns
        if sample.topic is SCAN:
            scans[stamp] = sample.published_ns
        elif stamp in scans:
            cost.latency_ms.append((sample.published_ns - scans.pop(stamp)) * 1e-6)
    cost.seconds += time.monotonic() - began
    cost.unanswered += max(0, len(scans) - 1)  # the last scan's command may still be under way
    for end in ends:
        end()


def _report(without: ViewerCost, viewed: ViewerCost, seconds: float, rounds: int, beams: int) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, cost in (("without", without), ("with", viewed)):
        numbers[f"scan_to_command_median_{name}_ms"] = float(np.median(cost.latency_ms))
        numbers[f"scan_to_command_p99_{name}_ms"] = float(np.percentile(cost.latency_ms, 99))
        numbers[f"unanswered_{name}"] = cost.unanswered
    return {
        **numbers,
        "viewer_cpu_share": viewed.cpu_s / viewed.seconds,
        "viewer_memory_mb": viewed.memory_mb,
        "frames_hz": viewed.frames / viewed.seconds,
        "frame_bytes": viewed.bytes / max(1, viewed.frames),
        "seconds": seconds,
        "rounds": rounds,
        "beams": beams,
        "machine": machine(),
        **provenance(),
    }


def bench_viewer(seconds: float, rounds: int, beams: int, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    result = measure(seconds, rounds, beams, console)
    table = Table(title=f"{beams} beams, {rounds} x {seconds:g} s each, one visitor", title_justify="left")
    for column in ("scan to command", "median ms", "p99 ms", "unanswered"):
        table.add_column(column, justify="left" if column == "scan to command" else "right")
    for name in ("without", "with"):
        numbers = [f"{result[f'scan_to_command_{kind}_{name}_ms']:.2f}" for kind in ("median", "p99")]
        table.add_row(f"{name} the viewer", *numbers, str(result[f"unanswered_{name}"]))
    console.print(table)
    console.print(
        f"the viewer: {100 * result['viewer_cpu_share']:.1f} % of a core, {result['viewer_memory_mb']:.0f} MB; "
        f"its visitor: {result['frames_hz']:.1f} frames/s of {result['frame_bytes'] / 1e3:.1f} kB",
        highlight=False,
    )
    write_json(json_file, result)
