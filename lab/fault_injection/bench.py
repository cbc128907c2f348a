"""`presage bench chaos`."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from fnmatch import fnmatch
from pathlib import Path

from rich.console import Console

from common.errors import UserError
from common.versions import commit, versions
from lab.experiments.results import markdown
from lab.fault_injection.faults import FAULTS, Fault
from lab.fault_injection.hosts import Network, enter_own_namespaces, namespaces_unavailable_reason
from lab.fault_injection.measure import MAX_RECOVERY_TIME_S, MAX_STOP_TIME_S, FaultOutcome, measure
from lab.fault_injection.system import System
from presage.terminal.output import check_file, write_json

HEADS = ("fault", "detected (s)", "stopped (s)", "restarted (s)", "recovered (s)", "lowest speed (m/s)", "as expected")


def select_faults(names: Sequence[str]) -> list[Fault]:
    """The faults whose names match a pattern such as ``killed*``; all by default. Raises UserError if none matches."""
    rows = [fault for fault in FAULTS if not names or any(fnmatch(fault.name, name) for name in names)]
    if not rows:
        raise UserError(f"no fault is called {', '.join(names)}: choose from {', '.join(f.name for f in FAULTS)}")
    return rows


def bench_chaos(
    names: Sequence[str],
    repeats: int,
    json_file: Path | None,
    console: Console,
    *,
    one_host: bool,
    quiet: bool,
) -> int:
    """Injects the faults, prints the table and writes it to ``json_file`` if given.

    Returns exit status 0 if the system reacted to every fault as expected, otherwise 1.
    """
    faults = select_faults(names)
    check_file(json_file, "--json")
    one_host_reason = "--one-host was given" if one_host else namespaces_unavailable_reason()
    if not one_host_reason:
        enter_own_namespaces(["-m", "presage", *sys.argv[1:]])
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="presage-chaos-")))
        network = None if one_host_reason else stack.enter_context(Network())
        with console.status("starting the system"):
            system = stack.enter_context(System(folder, network, environment, quiet=quiet))
        outcomes, skipped = _inject(faults, repeats, system, one_host_reason, console)
    print(markdown(HEADS, fault_rows(outcomes)))
    data = {
        "command": "presage bench chaos",
        "arguments": {"faults": list(names), "repeats": repeats},
        "hosts": not one_host_reason,
        "rows": [outcome.row() for outcome in outcomes],
        "skipped": skipped,
        "limits": {"stopped_s": MAX_STOP_TIME_S, "again_s": MAX_RECOVERY_TIME_S},
        "versions": versions(),
        "commit": commit(),
        "machine": platform.processor() or platform.machine(),
    }
    write_json(json_file, data)
    return 1 if any(outcome.deviations for outcome in outcomes) else 0


def _inject(
    faults: Sequence[Fault], repeats: int, system: System, one_host_reason: str, console: Console
) -> tuple[list[FaultOutcome], dict[str, str]]:
    """Injects all faults that are possible here; returns the outcomes, and by name why others were skipped.

    ``one_host_reason`` states why all services run on one host; it is empty if they run on several.
    """
    outcomes: list[FaultOutcome] = []
    skipped: dict[str, str] = {}
    for fault in faults:
        reason = fault.unavailable_reason()
        if fault.needs_hosts and one_host_reason:
            reason = f"needs several hosts: {one_host_reason}"
        if reason:
            skipped[fault.name] = reason
            console.print(f"[yellow]not tried[/] {fault.name}: {reason}", highlight=False)
            continue
        for repeat in range(repeats):
            with console.status(f"{fault.name} ({repeat + 1} of {repeats}): {fault.about}"):
                outcomes.append(measure(system, fault))
            problem = outcomes[-1].deviations
            console.print(f"{'[red]no[/]' if problem else '[green]ok[/]'} {fault.name} {problem}", highlight=False)
    return outcomes, skipped


def fault_rows(outcomes: Sequence[FaultOutcome]) -> list[tuple[str, ...]]:
    """Rows of the table: for each fault the worst of its repeats."""
    table_rows = []
    for name in dict.fromkeys(outcome.fault for outcome in outcomes):
        rows = [outcome for outcome in outcomes if outcome.fault == name]

        def worst(what: str, rows: Sequence[FaultOutcome] = rows) -> str:
            known = [value for row in rows if (value := getattr(row, what)) is not None]
            return f"{max(known):.2f}" if known else ""

        speeds = [row.least_speed for row in rows if row.least_speed is not None]
        as_expected = sum(not row.deviations for row in rows)
        speed = f"{min(speeds):.2f}" if speeds else ""
        times = [worst(what) for what in ("detected_s", "stopped_s", "start_s", "again_s")]
        table_rows.append((name, *times, speed, f"{as_expected}/{len(rows)}"))
    return table_rows
