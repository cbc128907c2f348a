"""Progress on a terminal and in a pipe."""

from __future__ import annotations

import io
import sys
from contextlib import closing

import pytest
from rich.console import Console

from presage.terminal.progress import progress, status_line, working


def lines(interval_s, stop_at=None):
    console = Console(file=io.StringIO(), width=40)
    with (
        working("reading drive.log", console),
        closing(progress(range(5), "localising", 5, console, interval_s=interval_s)) as numbers,
    ):
        seen = []
        for k in numbers:
            if k == stop_at:
                break
            seen.append(k)
    return seen, console.file.getvalue().splitlines()


def test_a_pipe_gets_plain_lines():
    seen, written = lines(0.0)
    assert seen == list(range(5))
    assert written[0] == "reading drive.log"
    assert [line.split(",")[0] for line in written[1:]] == [f"localising: {k} of 5 scans" for k in range(1, 5)]


def test_lines_come_at_a_modest_rate():
    assert lines(3600.0)[1] == ["reading drive.log"]


@pytest.mark.parametrize(
    ("interval_s", "written"),
    [(0.0, ["waiting at (1, 2)", "navigating", "waiting at (1, 5)"]), (3600.0, ["waiting at (1, 2)"])],
)
def test_changes_of_a_status_as_lines(interval_s, written):
    console = Console(file=io.StringIO(), width=40)
    with status_line("navigating", console, interval_s=interval_s) as show:
        for status in ("navigating", "waiting at (1, 2)", "waiting at (1.5, 2)", "navigating", "waiting at (1, 5)"):
            show(status, status)
    assert console.file.getvalue().splitlines() == written


def test_a_status_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=40)
    with status_line("navigating", console) as show:
        show("navigating, 3 m to go", "navigating")
    assert "navigating, 3 m to go" in console.file.getvalue()
    assert console.file.getvalue().endswith("\x1b[2K")  # the line is erased


def test_a_terminal_gets_a_bar_that_goes_away(capsys):
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    before = sys.stdout
    with closing(progress(range(5), "localising", 5, console)) as numbers:
        for _ in numbers:
            assert sys.stdout is before  # results may go there
            print("row")
            break
    assert "localising" in console.file.getvalue()
    assert console.file.getvalue().endswith("\x1b[2K")  # the bar is erased
    assert capsys.readouterr().out == "row\n"
