"""`presage bench latency`."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.bus.bus import Bus, Link, open_bus
from common.bus.inbox import Inbox, Sample
from common.bus.security import read_credentials
from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.messages.definitions import CmdVel, Scan
from common.messages.topics import CMD_VEL, ODOM, SCAN, TRUTH
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS, Scanner
from presage.session.running_sessions import credentials_for
from presage.session.stack import Stack
from presage.terminal.output import check_file, machine, provenance, write_json

# The echo process uses the keys of a separate robot: it receives any bytes on `odom` and returns them on `truth`.
ECHO_ROBOT, ECHO = "echo", "simulator"
WARM_UP_SCANS = 30  # at the start, left out of the statistics
TIMEOUT_S = 10.0  # then a payload counts as unanswered


def echo_main() -> None:
    """Entry point of the echo process: returns every payload it receives, in order."""
    inbox = Inbox()
    folder, connect = os.environ.get("PRESAGE_SECURITY"), (os.environ["PRESAGE_CONNECT"],)
    security = read_credentials(Path(folder), ("simulator",), ECHO_ROBOT) if folder else None
    with open_bus(Link(robot=ECHO_ROBOT, connect=connect, security=security)) as bus:
        bus.subscribe(ODOM, inbox, keep_all=True)
        bus.publisher(TRUTH)
        bus.declare_alive(ECHO)
        while True:
            sample = inbox.get(1.0)
            if isinstance(sample, Sample):
                bus.put(TRUTH, sample.payload)


def latency(scans: int, rate: float, beams: int, console: Console) -> dict[str, Any]:
    """Latencies in ms: from scan to velocity command through estimator and controller, and zenoh's own round trip.

    The round trip sends the same payload to an echo process and back.
    """
    world, scanner = load_world("corridor"), SCANNERS["tim571"].with_beams(beams)
    start = world.start_pose(Robot().radius)
    clean = world.ray_distances(se2.compose(start[None], scanner.mount), scanner.angles())[0]
    rng = np.random.default_rng(0)
    # This process publishes scans, and the echo process uses a scanner's keys: both need the simulator's role.
    with Stack("bench", quiet=True, security=credentials_for("bench", ("simulator",))) as stack:
        stack.start_router()
        stack.start("controller")
        stack.start("estimator", "--initial-pose", f"{start[0]},{start[1]}")
        with open_bus(stack.link()) as bus, open_bus(replace(stack.link(), robot=ECHO_ROBOT)) as echo_bus:
            stack.wait_alive(bus)
            stack.start_python("echo", "from lab.benchmarks.latency import echo_main; echo_main()")
            _wait_echo(echo_bus, stack)
            return _measure(bus, echo_bus, scanner, clean, rng, scans, rate, console)


def _wait_echo(echo_bus: Bus, stack: Stack) -> None:
    deadline = time.monotonic() + 30
    while ECHO not in echo_bus.alive(timeout=0.5):
        stack.check()
        if time.monotonic() > deadline:
            raise UserError("the echo process did not start within 30 s")


def _measure(
    bus: Bus,
    echo_bus: Bus,
    scanner: Scanner,
    clean: Array,
    rng: np.random.Generator,
    scans: int,
    rate: float,
    console: Console,
) -> dict[str, Any]:
    commands, returns = Inbox(), Inbox()
    bus.subscribe(CMD_VEL, commands, keep_all=True)
    echo_bus.subscribe(TRUTH, returns, keep_all=True)
    loop_ms, raw_ms, lost = [], [], 0
    for number in track(range(WARM_UP_SCANS + scans), "scan to command", console=console, transient=True):
        stamp = int(number / rate * 1e9)
        noisy = clean + scanner.sigma * rng.standard_normal(len(clean))
        payload = Scan.of_scanner(scanner, noisy, stamp, seq=number, scan_time=1 / rate).encode()
        began = time.perf_counter()
        bus.put(SCAN, payload)
        answered = _wait_for(commands, lambda p, s=stamp: CmdVel.decode(p).stamp_ns == s)
        middle = time.perf_counter()
        echo_bus.put(ODOM, payload)
        echoed = _wait_for(returns, lambda p, sent=payload: p == sent)
        end = time.perf_counter()
        if number >= WARM_UP_SCANS:
            lost += (not answered) + (not echoed)
            loop_ms += [(middle - began) * 1e3] if answered else []
            raw_ms += [(end - middle) * 1e3] if echoed else []
        time.sleep(max(0.0, 1 / rate - (time.perf_counter() - began)))
    if not loop_ms or not raw_ms:
        raise UserError(f"no scan was answered within {TIMEOUT_S:g} s: is this machine busy?")
    return {
        "scan_to_command_median_ms": float(np.median(loop_ms)),
        "scan_to_command_p99_ms": float(np.percentile(loop_ms, 99)),
        "zenoh_round_trip_median_ms": float(np.median(raw_ms)),
        "zenoh_round_trip_p99_ms": float(np.percentile(raw_ms, 99)),
        "payload_bytes": len(payload),
        "beams": len(clean),
        "scans": scans,
        "rate_hz": rate,
        "unanswered": lost,
        "machine": machine(),
        **provenance(seed=0),
    }


def _wait_for(inbox: Inbox, wanted: Any) -> bool:
    deadline = time.monotonic() + TIMEOUT_S
    while (left := deadline - time.monotonic()) > 0:
        sample = inbox.get(left)
        if isinstance(sample, Sample) and wanted(sample.payload):
            return True
    return False


def bench_latency(scans: int, rate: float, beams: int, json_file: Path | None, console: Console) -> int:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    Returns exit status 1 if a payload was not answered.
    """
    check_file(json_file, "--json")
    result = latency(scans, rate, beams, console)
    table = Table(
        title=f"{beams} beams ({result['payload_bytes']} bytes) at {rate:g} Hz, {scans} scans", title_justify="left"
    )
    for column in ("", "median ms", "p99 ms"):
        table.add_column(column, justify="right" if column else "left")
    for name, title in (
        ("scan_to_command", "scan to command, through estimator and controller"),
        ("zenoh_round_trip", "the same payload there and back, zenoh alone"),
    ):
        table.add_row(title, f"{result[name + '_median_ms']:.2f}", f"{result[name + '_p99_ms']:.2f}")
    console.print(table)
    if result["unanswered"]:
        console.print(f"[bold]{result['unanswered']} payloads were not answered within {TIMEOUT_S:g} s[/]")
    write_json(json_file, result)
    return 1 if result["unanswered"] else 0
