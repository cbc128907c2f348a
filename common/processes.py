"""Child processes that end when their parent ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable

INTERRUPTS: list[int] = [signal.SIGINT, signal.SIGTERM]  # end a process: Ctrl-C, `kill`, and a closed terminal
if sys.platform != "win32":
    INTERRUPTS.append(signal.SIGHUP)


def interrupts_to_handle() -> list[int]:
    """`INTERRUPTS`, without SIGHUP where it is ignored, as under nohup.

    A script's shell starts background commands with SIGINT ignored, but they should still end cleanly.
    """
    always = {signal.SIGINT, signal.SIGTERM}
    return [number for number in INTERRUPTS if number in always or signal.getsignal(number) != signal.SIG_IGN]


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
