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
ZENOH = re.compile(r"\d{4}-\d\d-\d\dT\S+\s+(?P<level>[A-Z]+)\s.*?(?P<logger>zenoh[\w:]*):\s+(?P<text>.*)")


@dataclass(frozen=True)
class Line:
    """One line of somebody who does not know our log."""

    level: str  # debug, info, warning, error
    logger: str  # zenoh's module, or the stream it came from
    text: str


def parse_line(raw: str, stream: str) -> Line | None:
    """Of zenoh what it says of itself; of others: on stderr a warning, on stdout worth knowing. None: nothing in it."""
    text = COLOUR.sub("", raw).rstrip()
    if (found := ZENOH.fullmatch(text)) is not None:
        level = found["level"].lower()
        return Line({"warn": "warning", "trace": "debug"}.get(level, level), found["logger"], found["text"])
    return Line("warning" if stream == "stderr" else "info", stream, text) if text else None


def capture(tell: Callable[[Line], None]) -> TextIO:
    """From now on file descriptors 1 and 2 feed ``tell``, from threads of their own; the stream that is the old stderr.

    Python's `print` still reaches the old stdout. What waits is told before the interpreter ends.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    old = {"stdout": os.dup(1), "stderr": os.dup(2)}
    threads = [_follow(number, name, tell) for number, name in ((1, "stdout"), (2, "stderr"))]
    # Of its own descriptor: `print` is for who asked for the text (--help, the page's link).
    sys.stdout = os.fdopen(os.dup(old["stdout"]), "w", buffering=1, encoding="utf-8", errors="replace")

    def release() -> None:
        sys.stderr.flush()
        os.dup2(old["stdout"], 1)
        os.dup2(old["stderr"], 2)
        for thread in threads:  # the pipe's last writer is gone, unless a child has it
            thread.join(timeout=1.0)

    atexit.register(release)
    return os.fdopen(os.dup(old["stderr"]), "w", buffering=1, encoding="utf-8", errors="backslashreplace")


def _follow(number: int, name: str, tell: Callable[[Line], None]) -> threading.Thread:
    reading, writing = os.pipe()
    os.dup2(writing, number)
    os.close(writing)

    def run() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for raw in lines:
                if (line := parse_line(raw, name)) is not None:
                    tell(line)

    thread = threading.Thread(target=run, name=f"log-{name}", daemon=True)
    thread.start()
    return thread
