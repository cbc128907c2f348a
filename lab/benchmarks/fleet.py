"""`presage bench fleet`."""

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

from common.bus.bus import open_bus
from common.errors import UserError
from common.geometry.world import load_world
from common.versions import commit, versions
from lab.benchmarks.fleet_load import Load, Window
from lab.benchmarks.fleet_table import WAYS, show
from presage.session.stack import Stack
from presage.terminal.output import check_file, write_json

PATIENCE = 120.0  # s
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
            before, others = self._cpu(), self._busy()
            window = self.load.play(count, self.plan.seconds)
            self.stack.check()
            used = self._cpu() - before
            row = _row(window, used, self.plan)
            row["others_share"] = max(0.0, self._busy() - others - used) / self.plan.seconds
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

    def _busy(self) -> float:
        """S that the core has worked, for whomever."""
        times = psutil.cpu_times(percpu=True)[self.core]
        return float(sum(times) - times.idle - getattr(times, "iowait", 0.0))

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
    ratios = show(rows, plan, console)
    load_average = os.getloadavg()[0]
    console.print(f"load of the machine at the end: {load_average:.1f} on {os.cpu_count()} cores", highlight=False)
    write_json(json_file, {
        "rows": rows, "ratio_one_process_to_one_each": ratios, "load_average_1min": load_average,
        "arguments": sys.argv[1:], "seed": plan.seed, "commit": commit(), "versions": versions(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    })  # fmt: skip
    return 0
