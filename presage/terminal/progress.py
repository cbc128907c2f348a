"""Progress bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

LINE_INTERVAL_S = 10.0
Item = TypeVar("Item")


def working(what: str, console: Console) -> AbstractContextManager[object]:
    """Shows what is done while the block runs: a spinner on a terminal, elsewhere a line."""
    if console.is_terminal:
        return console.status(what)
    console.print(what, highlight=False, soft_wrap=True)
    return nullcontext()


def progress(
    items: Iterable[Item], what: str, total: int, console: Console, *, interval_s: float = LINE_INTERVAL_S
) -> Generator[Item]:
    """Yields the items. Close it (`contextlib.closing`) where the loop can end early, or the bar stays drawn."""
    if console.is_terminal:
        columns = Progress.get_default_columns()
        # Standard output may be a file of results; rich would redirect it to the console.
        with Progress(*columns, console=console, transient=True, redirect_stdout=False) as bar:
            yield from bar.track(items, total, description=what)
        return
    began = last = time.monotonic()
    for done, item in enumerate(items):
        now = time.monotonic()
        if done and now - last >= interval_s:
            left = (now - began) / done * max(0, total - done)
            console.print(f"{what}: {done} of {total} scans, about {left:.0f} s left", highlight=False, soft_wrap=True)
            last = now
        yield item
