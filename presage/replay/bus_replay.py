"""`presage replay`: a recording onto the bus, steered by keys."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from common.bus.bus import Link
from common.errors import UserError
from common.messages.requests import PlayerReply
from presage.live.bus_watch import session
from presage.replay.keyboard import HELP, keyboard
from services.recorder.replaying.replay import ReplayControl, ReplayOptions, names_of, replay

PERIOD = 0.1  # s between two looks of the bar
ROBOT = r"[A-Za-z0-9_.-]{1,64}"


def run_replay(file: Path, link: Link, choice: ReplayOptions, console: Console) -> None:
    """Replay until the end, q or Ctrl-C."""

    @contextmanager
    def steering(remote: ReplayControl) -> Iterator[None]:
        with keyboard(remote) as there:
            if there:
                console.print(HELP, style="dim", highlight=False)
            with bar:
                yield

    bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"), console=console)
    task, shown = bar.add_task(file.name, total=1.0, said=""), 0.0

    def show(state: PlayerReply) -> None:
        nonlocal shown
        if (now := time.monotonic()) - shown >= PERIOD or state.paused:
            shown = now
            bar.update(task, completed=state.position_s, total=max(state.duration_s, 1e-9), said=words(state))

    counts = replay(file, link, choice, on_progress=show, opening=session, steering=steering)
    console.print("replayed " + (", ".join(f"{key} {count}" for key, count in sorted(counts.items())) or "nothing"))


def words(state: PlayerReply) -> str:
    """Where it stands, for a line."""
    rate = f" x {state.rate:g}" if state.rate != 1 else ""
    how = " paused" if state.paused else rate + (" looping" if state.loop else "")
    return f"{state.position_s:.1f} of {state.duration_s:.1f} s{how}"


def checked_robot(name: str) -> str:
    """The same; raises UserError where no key can hold it."""
    if not re.fullmatch(ROBOT, name):
        raise UserError(f"--robot {name!r}: letters, digits and _ . - only, 64 at most")
    return name


def choice_of(
    only: str, leave_out: str, rate: float | None, start: float | None, end: float | None, robot: str, *,
    loop: bool, force: bool, paused: bool = False, stay: bool = False,
) -> ReplayOptions:  # fmt: skip
    """From the command line's words; raises UserError on a robot no key can hold."""
    if robot:
        checked_robot(robot)
    names, without = names_of(only), names_of(leave_out)
    return ReplayOptions(
        names or None, without, 1.0 if rate is None else rate, start, end, loop, robot, force, paused, stay
    )
