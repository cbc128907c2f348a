"""Prints the address of the live page and opens it."""

from __future__ import annotations

import os
import sys
import webbrowser
from contextlib import suppress

from rich.console import Console

from presage.session.stack import Stack


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
