"""Children that do not outlive their parent."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable


def die_with(parent: int) -> None:
    """Linux: end this process when its parent ends, even by SIGKILL.

    The kernel looks at the thread that made the child: it has to live as long as the parent.
    """
    pr_set_pdeathsig = 1
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(pr_set_pdeathsig, signal.SIGTERM)
        if os.getppid() != parent:  # it ended before we asked
            os._exit(1)


def dying_with_us() -> Callable[[], None]:
    """For a child's ``preexec_fn``."""
    parent = os.getpid()
    return lambda: die_with(parent)
