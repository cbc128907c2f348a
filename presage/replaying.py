"""`presage replay`: a recording's bytes back on their keys, with progress."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from common.bus import Link
from common.errors import UserError
from presage.watch import session
from services.recorder.replay import replay


def run_replay(file: Path, link: Link, only: str, rate: float, console: Console) -> None:
    """Replay until the end or Ctrl-C."""
    names = {part.strip() for part in only.split(",") if part.strip()} or None
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task(file.name, total=1.0)
        counts = replay(
            file,
            link,
            only=names,
            rate=rate,
            on_progress=lambda done: bar.update(task, completed=done),
            opening=session,
        )
    if not counts:
        raise UserError(f"{file}: nothing to replay")
    console.print("replayed " + ", ".join(f"{key} {count}" for key, count in sorted(counts.items())))
