"""Child processes that end when their parent ends."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable


def end_with_parent(parent: int, how: int = signal.SIGTERM) -> None:
    """Linux: end this process by the signal ``how`` when its parent ends, even by SIGKILL.

    The kernel looks at the thread that made the child: it has to live as long as the parent.
    """
    pr_set_pdeathsig = 1
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(pr_set_pdeathsig, how)
        if os.getppid() != parent:  # it ended before we asked
            os._exit(1)


def end_with_this_process(how: int = signal.SIGTERM) -> Callable[[], None]:
    """For a child's ``preexec_fn``."""
    parent = os.getpid()
    return lambda: end_with_parent(parent, how)
