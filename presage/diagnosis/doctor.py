"""`presage doctor`."""

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
from presage.diagnosis.bus_observation import Observed, listen
from presage.diagnosis.findings import Finding
from presage.diagnosis.installation import look_at_installation
from presage.diagnosis.machine import look_at_machine, look_for_stopped
from presage.diagnosis.rules import judge
from presage.terminal.output import check_file, write_json

MARKS = {True: "[green]ok[/]", False: "[bold red]no[/]", None: "[yellow]-[/]"}


def running(link: Link, seconds: float) -> Iterator[Finding]:
    """What runs at the endpoint."""
    seen = listen(link, seconds)
    if isinstance(seen, Observed):
        where = ", ".join(link.connect)
        yield Finding("no_router", True, f"session at {where}", where)
        for finding in judge(seen, build_config_reply("doctor", "{}")):
            yield finding
            if finding.code == "missing" and not finding.ok:
                yield from look_for_stopped(finding.where)
    else:
        yield from seen


def examine(
    link: Link, seconds: float, console: Console, *, world: str, recordings: Path, json_file: Path | None = None
) -> int:
    """Print the findings, and write them as JSON where asked; 0 when nothing is wrong."""
    check_file(json_file, "--json")
    with console.status("looking"):
        findings = [*look_at_installation(world), *look_at_machine(recordings), *running(link, seconds)]
    table = Table(show_header=False, box=None)
    for finding in findings:
        table.add_row(MARKS[finding.ok], *(escape(_printable(text)) for text in (finding.what, finding.advice)))
    console.print(table)
    here = {"protocol": str(PROTOCOL), **versions()}
    console.print("versions: " + ", ".join(f"{name} {version}" for name, version in here.items()), highlight=False)
    write_json(
        json_file,
        {
            "findings": [asdict(finding) for finding in findings], "robot": link.robot, "connect": link.connect,
            "seconds": seconds, "versions": versions(), "protocol": PROTOCOL, "arguments": sys.argv[1:],
        },
    )  # fmt: skip
    return 1 if any(finding.ok is False for finding in findings) else 0


def _printable(text: str) -> str:
    """Words from the bus, which must not steer the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)
