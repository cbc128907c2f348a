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
from rich.table import Table

from common.errors import UserError
from common.versions import commit, versions
from lab.fault_injection.faults import FAULTS, Fault
from lab.fault_injection.hosts import INSIDE, Network, enter_own_namespaces, why_no_hosts
from lab.fault_injection.measure import AGAIN_WITHIN, STOP_WITHIN, Outcome, measure
from lab.fault_injection.system import System
from presage.terminal.output import check_file, write_json


def chosen(names: Sequence[str]) -> list[Fault]:
    """Rows whose names match, such as ``killed*``; raises UserError where none does."""
    rows = [fault for fault in FAULTS if not names or any(fnmatch(fault.name, name) for name in names)]
    if not rows:
        raise UserError(f"no fault is called {', '.join(names)}; there are: {', '.join(f.name for f in FAULTS)}")
    return rows


def bench_chaos(
    names: Sequence[str],
    repeats: int,
    json_file: Path | None,
    console: Console,
    *,
    one_host: bool = False,
    quiet: bool = True,
    in_markdown: bool = False,
) -> int:
    """Print the table; 0 where everything is as expected."""
    faults = chosen(names)
    check_file(json_file, "--json")
    missing = "asked for" if one_host else why_no_hosts()
    if not missing and not os.environ.get(INSIDE):
        enter_own_namespaces(["-m", "presage", *sys.argv[1:]])
    outcomes: list[Outcome] = []
    skipped: dict[str, str] = {}
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="presage-chaos-")))
        network = None if missing else stack.enter_context(Network())
        with console.status("starting the system"):
            system = stack.enter_context(System(folder, network, clean, quiet=quiet))
        for fault in faults:
            why = (f"one host alone: {missing}" if fault.hosts and missing else "") or fault.why_not()
            if why:
                skipped[fault.name] = why
                console.print(f"[yellow]not tried[/] {fault.name}: {why}", highlight=False)
                continue
            for number in range(repeats):
                with console.status(f"{fault.name} ({number + 1} of {repeats}): {fault.about}"):
                    outcomes.append(measure(system, fault))
                said = outcomes[-1].why
                console.print(f"{'[red]no[/]' if said else '[green]ok[/]'} {fault.name} {said}", highlight=False)
    if in_markdown:
        print(markdown(outcomes))
    else:
        console.print(table(outcomes))
    data = {
        "command": "presage bench chaos", "arguments": {"faults": list(names), "repeats": repeats},
        "hosts": not missing, "rows": [outcome.row() for outcome in outcomes], "skipped": skipped,
        "limits": {"stopped_s": STOP_WITHIN, "again_s": AGAIN_WITHIN},
        "versions": versions(), "commit": commit(), "machine": platform.processor() or platform.machine(),
    }  # fmt: skip
    write_json(json_file, data)
    return 1 if any(outcome.why for outcome in outcomes) else 0


HEAD = ("fault", "detected", "robot stands", "new process", "at work again", "least speed meanwhile", "as expected")


def rows_of(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """The worst of each fault's repeats."""
    found = []
    for name in dict.fromkeys(outcome.fault for outcome in outcomes):
        rows = [outcome for outcome in outcomes if outcome.fault == name]

        def worst(what: str, rows: Sequence[Outcome] = rows) -> str:
            known = [value for row in rows if (value := getattr(row, what)) is not None]
            return f"{max(known):.2f} s" if known else ""

        slow = [row.least_speed for row in rows if row.least_speed is not None]
        good = sum(not row.why for row in rows)
        speed = f"{min(slow):.2f} m/s" if slow else ""
        times = [worst(what) for what in ("detected_s", "stopped_s", "start_s", "again_s")]
        found.append((name, *times, speed, f"{good} of {len(rows)}"))
    return found


def table(outcomes: Sequence[Outcome]) -> Table:
    """For a terminal."""
    shown = Table(*HEAD)
    for row in rows_of(outcomes):
        shown.add_row(*row)
    return shown


def markdown(outcomes: Sequence[Outcome]) -> str:
    """For a page."""
    lines = [HEAD, ("---",) * len(HEAD), *rows_of(outcomes)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
