"""`presage bench cpu`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from common.bus.bus import open_bus
from common.errors import UserError
from common.messages.definitions import Belief, Goal, Pose, Status
from common.messages.topics import BELIEF, GOAL, STATUS
from lab.benchmarks.viewer import ROBOT, TIMEOUT_S, FrameCounter
from presage.live.latest_messages import LatestMessages
from presage.session.ports import free_port
from presage.session.stack import Stack
from presage.terminal.output import check_file, machine, provenance, write_json

ON_THE_ROBOT = ("router", "estimator", "controller", "recorder")
SERVICES = (*ON_THE_ROBOT, "simulator", "viewer")
WARM_UP_S = 10.0  # before the measurement; it includes global localisation
GOALS = (Pose(x=15.5, y=1.5), Pose(x=3.0, y=1.5))  # in the world corridor


def measure(seconds: float, beams: int) -> dict[str, Any]:
    """Measures each service while the robot drives to and fro. Raises UserError if no belief arrives.

    Returns ``beliefs_hz`` and, by service, ``cpu_share`` (CPU seconds per second) and ``memory_mb`` (resident). Their
    entry ``on_the_robot`` is the sum of the services that run there.
    """
    port = free_port()
    with tempfile.TemporaryDirectory() as folder, Stack(ROBOT, quiet=True) as stack:
        stack.start_router()
        stack.start("viewer", "--port", str(port))
        stack.start("recorder", "--directory", folder)
        stack.start("controller")
        stack.start("estimator")
        stack.start("simulator", "--beams", str(beams))
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            visitor, messages, goals = FrameCounter(port), LatestMessages(bus, STATUS, BELIEF), cycle(GOALS)
            _drive(stack, messages, goals, WARM_UP_S)
            before, began = cpu_seconds(stack, SERVICES), time.monotonic()
            beliefs = _drive(stack, messages, goals, seconds)
            elapsed, after = time.monotonic() - began, cpu_seconds(stack, SERVICES)
            memory = {name: _process(stack, name).memory_info().rss / 1e6 for name in SERVICES}
            visitor.close()
    cpu = {name: (after[name] - before[name]) / elapsed for name in SERVICES}
    for values in (cpu, memory):
        values["on_the_robot"] = sum(values[name] for name in ON_THE_ROBOT)
    return {"beliefs_hz": beliefs / elapsed, "cpu_share": cpu, "memory_mb": memory}


def _drive(stack: Stack, messages: LatestMessages, goals: Iterator[Pose], seconds: float) -> int:
    """Sends the next goal whenever the robot has none; returns the number of beliefs, at least one."""
    beliefs, began = 0, time.monotonic()
    while (spent := time.monotonic() - began) < seconds or not beliefs:
        if spent > seconds + TIMEOUT_S:
            raise UserError(f"the estimator sent no belief within {spent:.0f} s")
        stack.check()
        message = messages.next(0.05)
        beliefs += isinstance(message, Belief)
        if isinstance(message, Status) and message.state in {"idle", "reached"}:
            goal = Goal(stamp_ns=message.stamp_ns, seq=message.goal_seq + 1, pose=next(goals))
            messages.bus.put(GOAL, goal.encode())
    return beliefs


def _process(stack: Stack, name: str) -> psutil.Process:
    """The process of the service with this name."""
    return psutil.Process(stack.processes[name].child.pid)


def cpu_seconds(stack: Stack, names: Sequence[str]) -> dict[str, float]:
    """Processor time in s that each service has used."""
    times = {name: _process(stack, name).cpu_times() for name in names}
    return {name: used.user + used.system for name, used in times.items()}


def bench_cpu(seconds: float, beams: int, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    result = measure(seconds, beams)
    title = f"{beams} beams, {result['beliefs_hz']:.1f} beliefs/s, {seconds:g} s"
    table = Table(title=title, title_justify="left")
    for column in ("service", "CPU s/s", "memory MB"):
        table.add_column(column, justify="left" if column == "service" else "right")
    for name, share in result["cpu_share"].items():
        table.add_row(
            name.replace("_", " "), f"{share:.3f}", f"{result['memory_mb'][name]:.0f}", end_section=name == SERVICES[-1]
        )
    console.print(table)
    console.print(f"on the robot: {', '.join(ON_THE_ROBOT)}", highlight=False)
    result |= {
        "seconds": seconds,
        "beams": beams,
        "machine": machine(),
        **provenance(),
    }
    write_json(json_file, result)
