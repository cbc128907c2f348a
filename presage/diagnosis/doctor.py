"""`presage doctor`: checks the installation, this machine and a session."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common.bus.bus import Link
from common.runtime.protocol_check import build_config_reply
from common.versions import PROTOCOL, versions
from presage.diagnosis.bus_observation import BusObservation, observe_bus
from presage.diagnosis.findings import Finding
from presage.diagnosis.installation import check_installation
from presage.diagnosis.machine import check_machine, find_stopped_processes
from presage.diagnosis.rules import evaluate_observation
from presage.terminal.output import check_file, printable, write_json

MARKS = {True: "[green]ok[/]", False: "[bold red]no[/]", None: "[yellow]-[/]"}


def check_session(link: Link, seconds: float) -> Iterator[Finding]:
    """Observes the session of ``link`` for ``seconds`` s and yields what is found."""
    observation = observe_bus(link, seconds)
    if isinstance(observation, BusObservation):
        where = ", ".join(link.connect)
        yield Finding("no_router", True, f"session at {where}", where)
        for finding in evaluate_observation(observation, build_config_reply("doctor", "{}")):
            is_missing = finding.code == "missing" and not finding.ok
            stopped = list(find_stopped_processes(finding.where)) if is_missing else []
            yield from stopped or [finding]  # a stopped process must be resumed, not started again
    else:
        yield from observation


def run_doctor(
    link: Link, seconds: float, console: Console, *, world: str, recordings: Path, json_file: Path | None = None
) -> int:
    """Prints all findings, and writes them to ``json_file`` if given; returns 1 if there is a problem, else 0."""
    check_file(json_file, "--json")
    with console.status("checking"):
        findings = [*check_installation(world), *check_machine(recordings), *check_session(link, seconds)]
    table = Table(show_header=False, box=None)
    for finding in findings:
        table.add_row(MARKS[finding.ok], *(escape(printable(text)) for text in (finding.what, finding.advice)))
    console.print(table)
    local_versions = {"protocol": str(PROTOCOL), **versions()}
    console.print(
        "versions: " + ", ".join(f"{name} {version}" for name, version in local_versions.items()), highlight=False
    )
    write_json(
        json_file,
        {
            "findings": [asdict(finding) for finding in findings],
            "robot": link.robot,
            "connect": link.connect,
            "seconds": seconds,
            "versions": versions(),
            "protocol": PROTOCOL,
            "arguments": sys.argv[1:],
        },
    )
    return 1 if any(finding.ok is False for finding in findings) else 0
