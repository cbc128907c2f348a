"""Starts the live page beside a session."""

from __future__ import annotations

import os
import sys
import webbrowser
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from presage.session.stack import Stack


def start_page(stack: Stack, recordings: Path, console: Console) -> bool:
    """Start the viewer, over a folder of recordings; False, and a word why, where its packages are not installed."""
    if any(find_spec(name) is None for name in ("starlette", "uvicorn", "websockets")):
        console.print("no live page: its packages are not installed (pip install 'presage\\[viewer]')")
        return False
    stack.start("viewer", "--recordings", str(recordings))
    return True


def say_page(stack: Stack, console: Console, *, open_it: bool) -> None:
    """Print the link, and open it for whoever sits at a display."""
    link = stack.said("viewer", "page: ")
    console.print(f"[bold]page:[/] {link}", soft_wrap=True)
    if open_it and has_display():
        with suppress(webbrowser.Error, OSError):
            webbrowser.open(link)


def has_display() -> bool:
    """Whether a browser would have a window to open in; elsewhere it might take over the terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
