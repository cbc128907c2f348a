"""`presage bench fleet`."""

from __future__ import annotations

import os
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
from lab.benchmarks.fleet_load import AnswerStatistics, FleetLoad
from lab.benchmarks.fleet_table import DEPLOYMENTS, ONE_PROCESS, show
from presage.session.stack import Stack
from presage.terminal.output import check_file, machine, provenance, write_json

STARTUP_TIMEOUT_S = 120.0
# Before a measurement, scans at a low rate let the estimators localise; repeated until all robots track.
SETTLING_TIME_S = 4.0
SETTLING_RATE_HZ = 3.0
MAX_SETTLING_ROUNDS = 5


@dataclass(frozen=True)
class FleetPlan:
    """Parameters of the benchmark."""

    world: str
    beams: int
    rate: float  # Hz
    seconds: float  # duration of the measurement for each number of robots
    max_robots: int
    share: float  # share of the scans that must be answered within a period
    seed: int


@dataclass
class DeploymentResult:
    """Measurements of one estimator in one deployment: one process for all robots, or one process per robot."""

    estimator: str
    deployment: str
    rate: float  # Hz
    windows: list[dict[str, Any]] = field(default_factory=list)
    served: int = 0  # largest number of robots that was served
    searching: dict[str, Any] | None = None  # with half as many robots, one of which starts a global search each second
    bytes: dict[str, int] = field(default_factory=dict)  # message size by topic
    memory_mb: dict[int, float] = field(default_factory=dict)  # unique set size of the estimators by number of robots

    def row(self) -> dict[str, Any]:
        """The result as a row of the table and of the JSON file."""
        best = next((w for w in reversed(self.windows) if w["robots"] == self.served and w["served"]), None)
        # Other processes can only increase the processor time (cache misses), so the smallest value is the best one.
        busiest = max(window["robots"] for window in self.windows)
        cpu_ms = min(window["cpu_ms_per_scan"] for window in self.windows if window["robots"] == busiest)
        fewest, most = min(self.memory_mb), max(self.memory_mb)
        per_robot = self.memory_mb[most] / most
        if self.deployment == ONE_PROCESS:
            per_robot = (self.memory_mb[most] - self.memory_mb[fewest]) / max(1, most - fewest)
        return {
            "estimator": self.estimator,
            "deployment": self.deployment,
            "robots_served": self.served,
            "at_most_tried": most,
            "memory_per_robot_mb": per_robot,
            "memory_mb": self.memory_mb[most],
            "p50_ms": best and best["p50_ms"],
            "p99_ms": best and best["p99_ms"],
            "cpu_ms_per_scan": cpu_ms,
            "robots_by_cpu": 1e3 / self.rate / cpu_ms,
            "windows": self.windows,
            "while_one_searches": self.searching,
            "message_bytes": self.bytes,
        }


class EstimatorDeployment:
    """The running estimators of one deployment, pinned to one core."""

    def __init__(self, stack: Stack, load: FleetLoad, plan: FleetPlan, result: DeploymentResult, core: int) -> None:
        """Does not start any process yet."""
        self.stack, self.load, self.plan, self.result, self.core = stack, load, plan, result, core
        self.ready = 0  # number of robots that are localised

    def prepare(self, count: int) -> None:
        """Starts estimators for the first ``count`` robots and lets them localise (preset paper may fail to)."""
        if count <= self.ready:
            return
        arguments = ["--world", self.plan.world, "--estimator", self.result.estimator]
        if self.result.deployment == ONE_PROCESS:
            if not self.ready:
                names = ",".join(robot.name for robot in self.load.robots)
                self.stack.start("estimator", *arguments, "--robots", names)
        else:
            for robot in self.load.robots[self.ready : count]:
                self.stack.start_instance(robot.name, "estimator", robot.name, *arguments)
        if not self.load.wait_matching(count, STARTUP_TIMEOUT_S):
            self.stack.check()
            raise UserError(f"not all of {count} estimators subscribed to scans within {STARTUP_TIMEOUT_S:g} s")
        for process in self.processes():
            _pin_threads(process, {self.core})
        for _ in range(MAX_SETTLING_ROUNDS):
            if (
                self.load.play(count, SETTLING_TIME_S, SETTLING_RATE_HZ).tracking == count
                or self.result.estimator == "paper"
            ):
                break
        self.ready = count
        self.result.memory_mb[count] = sum(each.memory_full_info().uss for each in self.processes()) / 1e6

    def processes(self) -> list[psutil.Process]:
        """The estimator processes."""
        return [psutil.Process(p.child.pid) for name, p in self.stack.processes.items() if name != "router"]

    def can_serve(self, count: int) -> bool:
        """Whether ``count`` robots are answered in time. Measures a second time if the first fails."""
        self.prepare(count)
        for _ in range(2):
            before, others = self._estimators_cpu_s(), self._core_busy_s()
            window = self.load.play(count, self.plan.seconds)
            self.stack.check()
            used = self._estimators_cpu_s() - before
            row = _row(window, used, self.plan)
            row["others_share"] = max(0.0, self._core_busy_s() - others - used) / self.plan.seconds
            self.result.windows.append(row)
            if row["served"]:
                return True
        return False

    def measure_search(self) -> None:
        """Measures how one robot's global searches delay the others. Skips preset paper, which has no global search."""
        count = max(2, self.result.served // 2)
        if self.result.estimator != "paper" and count <= self.plan.max_robots:
            self.prepare(count)
            before = self._estimators_cpu_s()
            window = self.load.play(count, self.plan.seconds, searching=True)
            self.result.searching = _row(window, self._estimators_cpu_s() - before, self.plan)

    def _core_busy_s(self) -> float:
        """Busy time of the core in s, for all processes of the machine."""
        times = psutil.cpu_times(percpu=True)[self.core]
        return float(sum(times) - times.idle - getattr(times, "iowait", 0.0))

    def _estimators_cpu_s(self) -> float:
        return sum(t.user + t.system for t in (process.cpu_times() for process in self.processes()))


def _row(window: AnswerStatistics, cpu_s: float, plan: FleetPlan) -> dict[str, Any]:
    return {
        "robots": window.robots,
        "sent": window.sent,
        "answered_share": window.answered / window.sent,
        "in_time_share": window.in_time_share,
        "p50_ms": window.percentile(50),
        "p99_ms": window.percentile(99),
        "cpu_ms_per_scan": 1e3 * cpu_s / max(1, window.answered),
        "core_share": cpu_s / plan.seconds,
        "tracking": window.tracking,
        "served": window.in_time_share >= plan.share,
    }


def max_robots_served(served: Callable[[int], bool], most: int) -> int:
    """The largest count in 1 ... ``most`` for which ``served`` is true, by doubling and then bisection; 0 if none."""
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


def measure(estimator: str, deployment: str, plan: FleetPlan, console: Console) -> DeploymentResult:
    """Measures one estimator in one deployment, with its own router."""
    result, cores = DeploymentResult(estimator, deployment, plan.rate), sorted(os.sched_getaffinity(0))
    with Stack("bench", quiet=True) as stack:
        stack.start_router()
        with open_bus(stack.link()) as bus:
            load = FleetLoad(bus, load_world(plan.world), plan.beams, plan.rate, plan.max_robots, plan.seed)
            estimators = EstimatorDeployment(stack, load, plan, result, cores[-1])
            estimators.prepare(1)
            if deployment == ONE_PROCESS:
                # Measures the memory of all robots; a robot without scans takes no processor time.
                estimators.prepare(plan.max_robots)
            result.bytes = load.message_sizes()
            with _harness_on_other_cores(cores), console.status(f"{estimator}, {deployment}") as status:

                def served(count: int) -> bool:
                    status.update(f"{estimator}, {deployment}: {count} robots")
                    answer = estimators.can_serve(count)
                    last = result.windows[-1]
                    console.print(
                        f"{estimator}, {deployment}: {count} robots, {100 * last['in_time_share']:.2f} % in time",
                        highlight=False,
                    )
                    return answer

                result.served = max_robots_served(served, plan.max_robots)
                estimators.measure_search()
    return result


@contextmanager
def _harness_on_other_cores(cores: list[int]) -> Iterator[None]:
    """Keeps the threads of this process off the last core, if there are several cores."""
    _pin_threads(psutil.Process(), set(cores[:-1] or cores))
    try:
        yield
    finally:
        _pin_threads(psutil.Process(), set(cores))


def _pin_threads(process: psutil.Process, cores: set[int]) -> None:
    """Pins every thread of the process to the cores; threads that are created later inherit the setting."""
    for thread in process.threads():
        with suppress(ProcessLookupError):  # the thread has just ended
            os.sched_setaffinity(thread.id, cores)


def bench_fleet(estimators: str, plan: FleetPlan, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    rows = [
        measure(name, deployment, plan, console).row() for name in estimators.split(",") for deployment in DEPLOYMENTS
    ]
    ratios = show(rows, plan, console)
    load_average = os.getloadavg()[0]
    console.print(f"load of the machine at the end: {load_average:.1f} on {os.cpu_count()} cores", highlight=False)
    write_json(
        json_file,
        {
            "rows": rows,
            "ratio_one_process_to_one_each": ratios,
            "load_average_1min": load_average,
            "machine": machine(),
            **provenance(plan.seed),
        },
    )
