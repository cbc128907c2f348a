"""Child processes that end when their parent ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable


def ending_signals() -> list[int]:
    """The signals that end a process: SIGTERM, Ctrl-C, and that of a closed terminal, unless it is ignored (nohup)."""
    numbers: list[int] = [signal.SIGTERM, signal.SIGINT]
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    return numbers


def end_with_parent(parent: int, signal_number: int = signal.SIGTERM) -> None:
    """On Linux, make the kernel send ``signal_number`` to this process when its parent ends, even if it is killed.

    ``parent`` is the parent's process id. The kernel sends the signal when the thread that started this process ends,
    so that thread has to live as long as the parent.
    """
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal_number)
        if os.getppid() != parent:  # the parent ended before the call above
            os._exit(1)


def end_with_this_process(signal_number: int = signal.SIGTERM) -> Callable[[], None] | None:
    """On Linux, a function for ``preexec_fn`` of subprocess.Popen with which the child ends when this process ends."""
    parent = os.getpid()
    return (lambda: end_with_parent(parent, signal_number)) if sys.platform == "linux" else None
