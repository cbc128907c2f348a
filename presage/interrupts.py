"""Signals that end a command: raised as KeyboardInterrupt, or ignored while it cleans up."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTS = [signal.SIGINT, signal.SIGTERM]
if sys.platform != "win32":
    INTERRUPTS.append(signal.SIGHUP)


@contextmanager
def interruptible() -> Iterator[None]:
    """Makes `INTERRUPTS` raise KeyboardInterrupt in the block, so that it cleans up as after Ctrl-C.

    A script's shell starts background commands with SIGINT ignored, which is undone here. SIGHUP stays ignored where
    it is, as under nohup.
    """

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    handled = [
        number
        for number in INTERRUPTS
        if number in {signal.SIGINT, signal.SIGTERM} or signal.getsignal(number) != signal.SIG_IGN
    ]
    previous = {s: signal.signal(s, interrupt) for s in handled}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def deferring_interrupts() -> Iterator[None]:
    """Handles `INTERRUPTS` that come in the block only at its end, as they would be without it.

    Needed around the start of a process: an exception that a signal raises while Python forks is lost. In other threads
    than the main one, which receive no signals, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    previous = {
        s: signal.signal(s, lambda number, _frame: received.append(number))
        for s in INTERRUPTS
        if signal.getsignal(s) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if received:
        signal.raise_signal(received[0])


@contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """Ignores `INTERRUPTS` in the block, so that a second Ctrl-C does not interrupt the cleanup."""
    previous: dict[int, Callable[[int, FrameType | None], object] | int | None] = {
        s: signal.signal(s, signal.SIG_IGN) for s in INTERRUPTS
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
