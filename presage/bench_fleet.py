"""`presage bench fleet`: how many robots one core serves, by one estimator process, and by one process each."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from common.bus import open_bus
from common.errors import UserError
from common.versions import commit, versions
from common.world import load_world
from presage.fleet_load import Load, Window
from presage.output import check_file, write_json
from presage.stack import Stack

PATIENCE = 120.0  # s
WAYS = ("one process", "one each")
SETTLING = 4.0  # s of slow scans in which robots find their places, and again where some have not
SLOWLY = 3.0  # Hz, those scans
ROUNDS = 5  # of settling


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    world: str
    beams: int
    rate: float  # Hz
    seconds: float  # of one number of robots
    most: int  # robots
    share: float  # of the scans that must be answered within a period
    seed: int


@dataclass
class Found:
    """One way of serving, for one estimator."""

    estimator: str
    way: str
    rate: float  # Hz
    windows: list[dict[str, Any]] = field(default_factory=list)
    served: int = 0  # robots
    searching: dict[str, Any] | None = None  # half as many robots, one of which begins from nothing each second
    bytes: dict[str, int] = field(default_factory=dict)  # of each message, by topic
    memory_mb: dict[int, float] = field(default_factory=dict)  # unique to the estimators, by robots that were served

    def row(self) -> dict[str, Any]:
        """For table and file."""
        best = next((w for w in reversed(self.windows) if w["robots"] == self.served and w["served"]), None)
        # Whoever else is on the machine takes time away, but adds little to what is used: the least is the truest.
        busiest = max(window["robots"] for window in self.windows)
        cpu_ms = min(window["cpu_ms_per_scan"] for window in self.windows if window["robots"] == busiest)
        fewest, most = min(self.memory_mb), max(self.memory_mb)
        per_robot = self.memory_mb[most] / most
        if self.way == WAYS[0]:
            per_robot = (self.memory_mb[most] - self.memory_mb[fewest]) / max(1, most - fewest)
        return {
            "estimator": self.estimator, "way": self.way, "robots_served": self.served,
            "at_most_tried": most, "memory_per_robot_mb": per_robot, "memory_mb": self.memory_mb[most],
            "p50_ms": best and best["p50_ms"], "p99_ms": best and best["p99_ms"],
            "cpu_ms_per_scan": cpu_ms, "robots_by_cpu": 1e3 / self.rate / cpu_ms, "windows": self.windows,
            "while_one_searches": self.searching, "message_bytes": self.bytes,
        }  # fmt: skip


class Side:
    """The estimators of one way, pinned to one core."""

    def __init__(self, stack: Stack, load: Load, plan: Plan, found: Found, core: int) -> None:
        """Nothing runs yet; in one process all robots are named from the start."""
        self.stack, self.load, self.plan, self.found, self.core = stack, load, plan, found, core
        self.ready = 0  # robots that have found their places

    def prepare(self, count: int) -> None:
        """As many robots as that are served, and know where they are (preset paper: or not)."""
        if count <= self.ready:
            return
        arguments = ["--world", self.plan.world, "--estimator", self.found.estimator]
        if self.found.way == WAYS[0]:
            if not self.ready:
                names = ",".join(robot.name for robot in self.load.robots)
                self.stack.start("estimator", *arguments, "--robots", names)
        else:
            for robot in self.load.robots[self.ready : count]:
                self.stack.start_as(robot.name, "estimator", robot.name, *arguments)
        if not self.load.wait_matching(count, PATIENCE):
            self.stack.check()
            raise UserError(f"not all estimators were ready within {PATIENCE:g} s")
        for process in self.processes():
            _keep_on(process, {self.core})
        for _ in range(ROUNDS):
            if self.load.play(count, SETTLING, SLOWLY).tracking == count or self.found.estimator == "paper":
                break
        self.ready = count
        self.found.memory_mb[count] = sum(each.memory_full_info().uss for each in self.processes()) / 1e6

    def processes(self) -> list[psutil.Process]:
        """The estimators."""
        return [psutil.Process(p.child.pid) for name, p in self.stack.processes.items() if name != "router"]

    def served(self, count: int) -> bool:
        """Whether so many robots are answered in time; asked twice before a no, for a machine has hiccups."""
        self.prepare(count)
        for _ in range(2):
            before = self._cpu()
            window = self.load.play(count, self.plan.seconds)
            self.stack.check()
            row = _row(window, self._cpu() - before, self.plan)
            self.found.windows.append(row)
            if row["served"]:
                return True
        return False

    def search(self) -> None:
        """What a robot that searches does to the others; preset paper does not search."""
        count = max(2, self.found.served // 2)
        if self.found.estimator != "paper" and count <= self.plan.most:
            self.prepare(count)
            before = self._cpu()
            window = self.load.play(count, self.plan.seconds, searching=True)
            self.found.searching = _row(window, self._cpu() - before, self.plan)

    def _cpu(self) -> float:
        return sum(t.user + t.system for t in (process.cpu_times() for process in self.processes()))


def _row(window: Window, cpu_s: float, plan: Plan) -> dict[str, Any]:
    return {
        "robots": window.robots, "sent": window.sent, "answered_share": window.answered / window.sent,
        "in_time_share": window.in_time_share, "p50_ms": window.percentile(50), "p99_ms": window.percentile(99),
        "cpu_ms_per_scan": 1e3 * cpu_s / max(1, window.answered), "core_share": cpu_s / plan.seconds,
        "tracking": window.tracking, "served": window.in_time_share >= plan.share,
    }  # fmt: skip


def most_served(served: Callable[[int], bool], most: int) -> int:
    """The largest count in 1 ... ``most`` for which ``served`` says yes: doubled until it says no, then halved."""
    good, bad = 0, most + 1
    count = min(8, most)
    while bad - good > 1:
        if served(count):
            good = count
        else:
            bad = count
        count = min(2 * good, most) if bad > most and good else (good + bad) // 2
        count = min(max(count, good + 1), bad - 1)
    return good


def measure(estimator: str, way: str, plan: Plan, console: Console) -> Found:
    """One way, on a router of its own."""
    found, cores = Found(estimator, way, plan.rate), sorted(os.sched_getaffinity(0))
    with Stack("bench", quiet=True) as stack:
        stack.start_router()
        with open_bus(stack.link()) as bus:
            load = Load(bus, load_world(plan.world), plan.beams, plan.rate, plan.most, plan.seed)
            side = Side(stack, load, plan, found, cores[-1])
            side.prepare(1)
            if way == WAYS[0]:
                side.prepare(plan.most)  # what each costs in memory; who is not played costs no time
            found.bytes = load.sizes()
            with _elsewhere(cores), console.status(f"{estimator}, {way}") as status:

                def served(count: int) -> bool:
                    status.update(f"{estimator}, {way}: {count} robots")
                    answer = side.served(count)
                    last = found.windows[-1]
                    console.print(
                        f"{estimator}, {way}: {count} robots, {100 * last['in_time_share']:.2f} % in time",
                        highlight=False,
                    )
                    return answer

                found.served = most_served(served, plan.most)
                side.search()
    return found


@contextmanager
def _elsewhere(cores: list[int]) -> Iterator[None]:
    """Keep our own threads on the other cores, where there are others."""
    _keep_on(psutil.Process(), set(cores[:-1] or cores))
    try:
        yield
    finally:
        _keep_on(psutil.Process(), set(cores))


def _keep_on(process: psutil.Process, cores: set[int]) -> None:
    """Every thread that is there; those to come inherit it."""
    for thread in process.threads():
        with suppress(ProcessLookupError):  # it has just ended
            os.sched_setaffinity(thread.id, cores)


def bench_fleet(estimators: str, plan: Plan, json_file: Path | None, console: Console) -> int:
    """Print, and write as JSON where asked."""
    check_file(json_file, "--json")
    rows = [measure(name, way, plan, console).row() for name in estimators.split(",") for way in WAYS]
    ratios = _show(rows, plan, console)
    load_average = os.getloadavg()[0]
    console.print(f"load of the machine at the end: {load_average:.1f} on {os.cpu_count()} cores", highlight=False)
    write_json(json_file, {
        "rows": rows, "ratio_one_process_to_one_each": ratios, "load_average_1min": load_average,
        "arguments": sys.argv[1:], "seed": plan.seed, "commit": commit(), "versions": versions(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    })  # fmt: skip
    return 0


def _show(rows: list[dict[str, Any]], plan: Plan, console: Console) -> dict[str, dict[str, float | None]]:
    """The table and what follows from it; by estimator the robots of one process to those of one each."""
    table = Table(
        title=f"{plan.world}, {plan.beams} beams at {plan.rate:g} Hz, one core, "
        f"{100 * plan.share:g} % of the scans answered within {1e3 / plan.rate:.1f} ms",
        title_justify="left",
    )
    for column in (
        "estimator",
        "way",
        "robots",
        "p50 ms",
        "p99 ms",
        "CPU ms a scan",
        "robots by CPU",
        "MB a robot",
        "MB in all",
    ):
        table.add_column(column, justify="left" if column in {"estimator", "way"} else "right")
    for row in rows:
        table.add_row(
            row["estimator"], row["way"], f"{row['robots_served']}",
            *(f"{row[name]:.1f}" if row[name] is not None else "" for name in ("p50_ms", "p99_ms")),
            f"{row['cpu_ms_per_scan']:.2f}",
            f"{row['robots_by_cpu']:.1f}",
            f"{row['memory_per_robot_mb']:.1f}", f"{row['memory_mb']:.0f}",
        )  # fmt: skip
    console.print(table)
    for row in rows:
        if (other := row["while_one_searches"]) is not None and other["p99_ms"] is not None:
            console.print(
                f"{row['estimator']}, {row['way']}: of {other['robots']} robots one searches each second; the others: "
                f"{100 * other['in_time_share']:.1f} % in time, "
                f"p50 {other['p50_ms']:.1f}, p99 {other['p99_ms']:.1f} ms",
                highlight=False,
            )
    size = rows[0]["message_bytes"]
    console.print(
        "bytes a message: "
        + ", ".join(f"{name} {count}" for name, count in size.items())
        + f"; scans to the estimator: {size['scan'] * plan.rate / 1e3:.1f} kB/s a robot",
        highlight=False,
    )
    ratios: dict[str, dict[str, float | None]] = {}
    for name in dict.fromkeys(row["estimator"] for row in rows):
        one, each = (next(r for r in rows if r["estimator"] == name and r["way"] == way) for way in WAYS)
        ratios[name] = {
            "robots_served": one["robots_served"] / each["robots_served"] if each["robots_served"] else None,
            "robots_by_cpu": one["robots_by_cpu"] / each["robots_by_cpu"],
            "memory_per_robot": each["memory_per_robot_mb"] / max(one["memory_per_robot_mb"], 0.1),
        }
        served = f"{ratios[name]['robots_served']:.2f}" if each["robots_served"] else "no number of"
        console.print(
            f"{name}: one process serves {served} times the robots of one each; "
            f"by processor time {ratios[name]['robots_by_cpu']:.2f} times",
            highlight=False,
        )
    return ratios
