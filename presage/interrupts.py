"""Signals that end a command: raised as KeyboardInterrupt, or ignored while it cleans up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from common.processes import INTERRUPTS, interrupts_to_handle


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], object] | int, numbers: Sequence[int]) -> Iterator[None]:
    """Handles the signals ``numbers`` by ``handler`` in the block."""
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Makes `interrupts_to_handle` raise KeyboardInterrupt in the block, so that it cleans up as after Ctrl-C."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handled_by(interrupt, interrupts_to_handle()):
        yield


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
    numbers = [number for number in INTERRUPTS if signal.getsignal(number) != signal.SIG_IGN]
    with _handled_by(lambda number, _frame: received.append(number), numbers):
        yield
    if received:
        signal.raise_signal(received[0])


@contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """Ignores `INTERRUPTS` in the block, so that a second Ctrl-C does not interrupt the cleanup."""
    with _handled_by(signal.SIG_IGN, INTERRUPTS):
        yield
