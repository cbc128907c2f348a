"""Redirects what native code (zenoh, pybullet) prints into the log."""

from __future__ import annotations

import atexit
import os
import re
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TextIO

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
PYBULLET = re.compile(r"pybullet build time: .*")  # printed to stderr when it is imported
ZENOH = re.compile(r"\d{4}-\d\d-\d\dT\S+\s+(?P<level>[A-Z]+)\s.*?(?P<logger>zenoh[\w:]*):\s+(?P<text>.*)")


@dataclass(frozen=True)
class CapturedLine:
    """A line that native code wrote to stdout or stderr."""

    level: str  # debug, info, warning, error
    logger: str  # zenoh's module, or the name of the stream
    text: str


def parse_line(raw: str, stream: str) -> CapturedLine | None:
    """Parses a line: zenoh's lines state level and module; others are warnings on stderr and information on stdout.

    pybullet's version is information, too. Returns None for an empty line.
    """
    text = COLOUR.sub("", raw).rstrip()
    if (found := ZENOH.fullmatch(text)) is not None:
        level = found["level"].lower()
        return CapturedLine({"warn": "warning", "trace": "debug"}.get(level, level), found["logger"], found["text"])
    is_warning = stream == "stderr" and not PYBULLET.fullmatch(text)
    return CapturedLine("warning" if is_warning else "info", stream, text) if text else None


def capture(handle: Callable[[CapturedLine], None]) -> TextIO:
    """Redirects file descriptors 1 and 2 to ``handle``, which is called from other threads.

    Returns a stream that writes to the original stderr. Python's `print` still writes to the original stdout. Pending
    lines are handled before the interpreter exits.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    original = {"stdout": os.dup(1), "stderr": os.dup(2)}
    threads = [_redirect(number, name, handle) for number, name in ((1, "stdout"), (2, "stderr"))]
    # `print` keeps its destination: it is used for text that the user requested (--help, the page's link).
    sys.stdout = printed = os.fdopen(os.dup(original["stdout"]), "w", buffering=1, encoding="utf-8", errors="replace")

    def release() -> None:
        sys.stderr.flush()
        os.dup2(original["stdout"], 1)
        os.dup2(original["stderr"], 2)
        sys.stdout = sys.__stdout__
        printed.close()
        for thread in threads:  # they end when the last writer closes the pipe; a child process may keep it open
            thread.join(timeout=1.0)

    atexit.register(release)
    return os.fdopen(os.dup(original["stderr"]), "w", buffering=1, encoding="utf-8", errors="backslashreplace")


def _redirect(number: int, name: str, handle: Callable[[CapturedLine], None]) -> threading.Thread:
    reading, writing = os.pipe()
    os.dup2(writing, number)
    os.close(writing)

    def run() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for raw in lines:
                if (line := parse_line(raw, name)) is not None:
                    handle(line)

    thread = threading.Thread(target=run, name=f"log-{name}", daemon=True)
    thread.start()
    return thread
