"""`presage bench hosts`: traffic and delay of each link."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from common.errors import UserError
from common.versions import commit, versions
from lab.fault_injection.hosts import (
    Network,
    enter_own_namespaces,
    namespaces_unavailable_reason,
    port_of,
    run,
)
from lab.fault_injection.system import System
from lab.fault_injection.timeline import Row
from presage.terminal.output import check_file, write_json

WARM_UP_S = 3.0
SERVICES_ON_HOST = {"robot": "simulator, controller", "brain": "estimator"}


def bench_hosts(seconds: float, beams: int, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints traffic and delays and writes them to ``json_file`` if given.

    Raises UserError if this machine permits no network namespaces.
    """
    check_file(json_file, "--json")
    if reason := namespaces_unavailable_reason():
        raise UserError(f"several hosts on one machine need network namespaces: {reason}")
    enter_own_namespaces(["-m", "presage", *sys.argv[1:]])
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="presage-hosts-")))
        network = stack.enter_context(Network())
        with console.status("starting the system"):
            system = stack.enter_context(System(folder, network, clean, beams=beams))
        with console.status("driving"):
            links, rows, took = _measure_links(system, network, seconds)
    delays_by_topic = {what: delays(rows, what) for what in ("belief", "cmd_vel")}
    table = Table("link of", "with", "out kB/s", "in kB/s", title=f"{beams} beams at 15 Hz, {took:.0f} s")
    for name, link in links.items():
        table.add_row(name, SERVICES_ON_HOST[name], f"{link['out'] / 1e3:.0f}", f"{link['in'] / 1e3:.0f}")
    console.print(table)
    for what, each in delays_by_topic.items():
        console.print(f"scan to {what}, at the robot: {each['median_ms']:.1f} ms median, {each['p99_ms']:.1f} ms p99")
    data: dict[str, Any] = {
        "command": "presage bench hosts",
        "arguments": {"seconds": seconds, "beams": beams},
        "links_bytes_per_s": links,
        "delays": delays_by_topic,
        "versions": versions(),
        "commit": commit(),
    }
    write_json(json_file, data)


def _measure_links(
    system: System, network: Network, seconds: float
) -> tuple[dict[str, dict[str, float]], list[Row], float]:
    """Bytes per second of each link and way while the robot drives, the events meanwhile, and the time taken in s."""
    system.drive_fast()
    time.sleep(WARM_UP_S)
    before, began = {name: traffic(name) for name in network.hosts}, time.monotonic()
    while time.monotonic() < began + seconds:
        system.drive_fast()
        time.sleep(1.0)
    took, after = time.monotonic() - began, {name: traffic(name) for name in network.hosts}
    links = {
        name: {way: (after[name][way] - count) / took for way, count in counts.items()}
        for name, counts in before.items()
    }
    return links, [row for row in system.timeline.rows if row["t"] >= began], took


def traffic(host: str) -> dict[str, int]:
    """Bytes sent and received by the host so far, with headers, as counted by the switch."""
    (device,) = json.loads(run("ip", "-s", "-j", "link", "show", port_of(host)))
    counts = device["stats64"]
    return {"out": counts["rx"]["bytes"], "in": counts["tx"]["bytes"]}


def delays(rows: list[Row], what: str) -> dict[str, float]:
    """Statistics of the time in ms from a scan to the message that answers it, both received at the robot's host."""
    scans = {row["stamp"]: row["t"] for row in rows if row["what"] == "scan"}
    found = [row["t"] - scans[row["stamp"]] for row in rows if row["what"] == what and row["stamp"] in scans]
    if not found:
        raise UserError(f"no scan was answered by a {what}")
    ms = 1e3 * np.array(found)
    return {"median_ms": float(np.median(ms)), "p99_ms": float(np.percentile(ms, 99)), "count": len(found)}
