"""`presage replay`: publishes a recording on the bus, controlled by keys."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from common.bus.bus import Link
from common.messages.requests import PlayerReply
from common.names import split_names
from presage.live.latest_messages import session_bus
from presage.replay.keyboard import HELP, keyboard
from presage.session.running_sessions import check_robot_name
from services.recorder.replaying.replay import ReplayControl, ReplayOptions, replay

REFRESH_PERIOD_S = 0.1  # of the progress bar


def run_replay(file: Path, link: Link, options: ReplayOptions, console: Console) -> None:
    """Replays the recording onto the bus until its end, the key q, or Ctrl-C."""

    @contextmanager
    def show_progress(control: ReplayControl) -> Iterator[None]:
        with keyboard(control) as available:
            if available:
                console.print(HELP, style="dim", highlight=False)
            with bar:
                yield

    bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}"), console=console)
    task, shown = bar.add_task(file.name, total=1.0, status=""), 0.0

    def show(state: PlayerReply) -> None:
        nonlocal shown
        if (now := time.monotonic()) - shown >= REFRESH_PERIOD_S or state.paused:
            shown = now
            bar.update(task, completed=state.position_s, total=max(state.duration_s, 1e-9), status=describe(state))

    counts = replay(file, link, options, on_progress=show, open_session=session_bus, control_context=show_progress)
    console.print("replayed " + (", ".join(f"{key} {count}" for key, count in sorted(counts.items())) or "nothing"))


def describe(state: PlayerReply) -> str:
    """Position and mode of the replay, for the progress bar."""
    rate = f" x {state.rate:g}" if state.rate != 1 else ""
    mode = " paused" if state.paused else rate + (" looping" if state.loop else "")
    return f"{state.position_s:.1f} of {state.duration_s:.1f} s{mode}"


def replay_options(
    only: str,
    leave_out: str,
    rate: float | None,
    start: float | None,
    end: float | None,
    robot: str,
    *,
    loop: bool,
    force: bool,
    paused: bool = False,
) -> ReplayOptions:
    """Options of the replay from those of the command line; raises UserError if the robot's name is not allowed."""
    if robot:
        check_robot_name(robot)
    names, without = frozenset(split_names(only)), frozenset(split_names(leave_out))
    return ReplayOptions(names or None, without, 1.0 if rate is None else rate, start, end, loop, robot, force, paused)
