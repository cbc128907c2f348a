"""Starts the live page beside a session."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec

from rich.console import Console

from presage.session.stack import Stack


def start_page(stack: Stack, arguments: Sequence[str], console: Console) -> bool:
    """Starts the viewer with these arguments; prints a note and returns False if its packages are missing."""
    if any(find_spec(name) is None for name in ("starlette", "uvicorn", "websockets")):
        console.print("no live page: its packages are not installed; run pip install 'presage\\[viewer]'")
        return False
    stack.start("viewer", *arguments)
    return True


def show_page_link(stack: Stack, console: Console, *, open_it: bool) -> None:
    """Prints the address of the live page; with ``open_it``, also opens it in a browser if there is a display."""
    link = stack.wait_for_line("viewer", "page: ")
    console.print(f"[bold]page:[/] {link}", soft_wrap=True)
    if open_it and has_display():
        with suppress(webbrowser.Error, OSError):
            webbrowser.open(link)


def has_display() -> bool:
    """Whether a graphical browser can open; without a display, a text browser might take over the terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
