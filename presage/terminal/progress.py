"""Progress bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

LINE_INTERVAL_S = 10.0
CHANGE_INTERVAL_S = 2.0
Item = TypeVar("Item")


def working(what: str, console: Console) -> AbstractContextManager[object]:
    """Shows ``what`` while the block runs: with a spinner on a terminal, as one line elsewhere."""
    if console.is_terminal:
        return console.status(what)
    console.print(what, highlight=False, soft_wrap=True)
    return nullcontext()


@contextmanager
def status_line(
    status: str, console: Console, *, interval_s: float = CHANGE_INTERVAL_S
) -> Iterator[Callable[[str, str], None]]:
    """Yields a function that shows a text: in one line on a terminal; elsewhere in a new line when its status changes.

    The function takes the text and its status. A change of numbers alone does not count. ``status`` is the first one,
    which is shown on a terminal only. Lines come at intervals of at least ``interval_s``.
    """
    if console.is_terminal:
        with console.status(status) as line:
            yield lambda text, _: line.update(text)
        return
    shown, last_line_s = _without_numbers(status), -interval_s

    def show(text: str, status: str) -> None:
        nonlocal shown, last_line_s
        words, now_s = _without_numbers(status), time.monotonic()
        if words != shown and now_s - last_line_s >= interval_s:
            shown, last_line_s = words, now_s
            console.print(text, highlight=False, soft_wrap=True)

    yield show


def _without_numbers(text: str) -> str:
    return re.sub(r"\d[\d.]*", "", text)


def progress(
    items: Iterable[Item],
    what: str,
    total: int,
    console: Console,
    *,
    unit: str = "scans",
    interval_s: float = LINE_INTERVAL_S,
) -> Generator[Item]:
    """Yields the items and shows the progress; on other outputs than a terminal, one line every ``interval_s``.

    Wrap it in `contextlib.closing` if the loop can end early; otherwise the bar stays on the screen.
    """
    if console.is_terminal:
        columns = Progress.get_default_columns()
        # rich would redirect standard output to the console, but it may be a file of results.
        with Progress(*columns, console=console, transient=True, redirect_stdout=False) as bar:
            yield from bar.track(items, total, description=what)
        return
    start_s = last_line_s = time.monotonic()
    for done, item in enumerate(items):
        now_s = time.monotonic()
        if done and now_s - last_line_s >= interval_s:
            left = (now_s - start_s) / done * max(0, total - done)
            line = f"{what}: {done} of {total} {unit}, about {left:.0f} s left"
            console.print(line, highlight=False, soft_wrap=True)
            last_line_s = now_s
        yield item
