"""`presage doctor`: finds what is wrong with an installation or a running session, and says what to do."""

from __future__ import annotations

import importlib.util
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from common.bus import Link, open_bus, wait_until
from common.topics import CMD_VEL, TOPICS
from common.versions import versions
from common.world import known_worlds
from presage.tools import measure_rates

NEEDED = {
    "simulator": ("pybullet",),
    "estimator": ("torch", "safetensors"),
    "controller": ("scipy",),
    "recorder": ("mcap", "zstandard", "lz4"),
}
OPTIONAL = {"recorder": "needed only to record, with"}  # a healthy session can do without
SLOW = 0.8  # of the nominal rate


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    ok: bool | None  # None: worth knowing, no fault
    what: str
    advice: str = ""


def installation() -> Iterator[Finding]:
    """What is installed here."""
    python = platform.python_version()
    fits = sys.version_info >= (3, 10)
    yield Finding(fits, f"Python {python}", "" if fits else "3.10 or 3.11 is needed; `make install` picks one")
    for service, packages in NEEDED.items():
        missing = [name for name in packages if importlib.util.find_spec(name) is None]
        advice = f"pip install 'presage[{service}]'" if missing else ""
        yield Finding(not missing, f"{service}: {'misses ' + ', '.join(missing) if missing else 'installed'}", advice)
    if importlib.util.find_spec("torch") and importlib.util.find_spec("safetensors"):
        from services.estimator import weights  # noqa: PLC0415 - only where torch is

        for world in known_worlds():
            beams = weights.available(weights.FOLDER, world, "paper")
            text = f"weights for {world}: {', '.join(f'{b} beams' for b in beams) or 'none'}"
            yield Finding(True if beams else None, text, "" if beams else weights.train_command(world, "paper"))
    else:
        yield Finding(None, "weights: not looked at, the estimator is not installed here")


def running(link: Link, seconds: float) -> Iterator[Finding]:
    """What runs at the endpoint."""
    where = ", ".join(link.connect)
    with open_bus(link, patience=3.0) as bus:
        if not wait_until(bus.linked, 3.0):
            yield Finding(
                False, f"no session at {where}", "start one with `presage up`, or name its endpoint with --connect"
            )
            return
        yield Finding(True, f"session at {where}")
        # A session that has just opened hears of the others one by one.
        wait_until(lambda: set(NEEDED) - {"recorder"} <= bus.alive(timeout=0.5), 2.0)
        alive = bus.alive()
    for service in NEEDED:
        there = service in alive
        what = f"{service} of {link.robot!r}: {'alive' if there else 'not there'}"
        advice = "" if there else f"{OPTIONAL.get(service, 'start it with')}: python -m services.{service}"
        yield Finding(there or (None if service in OPTIONAL else False), what, advice)
    times = measure_rates(link, TOPICS, seconds)
    for topic in TOPICS:
        if not topic.rate or topic.per_service:
            continue
        rate = len(times.get(topic.key(link.robot), [])) / seconds
        ok = rate >= SLOW * topic.rate
        advice = (
            "" if ok else f"from the {topic.publisher}: is it alive, paused, or are its inputs missing? see its log"
        )
        if topic is CMD_VEL and rate > 1.5 * topic.rate:
            ok, advice = False, "more than one driver? stop all controllers but one"
        absent = topic.publisher in OPTIONAL and topic.publisher not in alive and not rate
        yield Finding(
            None if absent else ok, f"{topic.name}: {rate:.1f} of {topic.rate:g} Hz", "" if absent else advice
        )


def examine(link: Link, seconds: float, console: Console) -> int:
    """Print the findings; 0 when nothing is wrong."""
    findings = list(installation())
    with console.status("looking"):
        findings += running(link, seconds)
    table = Table(show_header=False, box=None)
    for finding in findings:
        mark = {True: "[green]ok[/]", False: "[bold red]no[/]", None: "[yellow]-[/]"}[finding.ok]
        table.add_row(mark, finding.what, finding.advice)
    console.print(table)
    console.print(
        "versions: " + ", ".join(f"{name} {version}" for name, version in versions().items()), highlight=False
    )
    return 1 if any(finding.ok is False for finding in findings) else 0
