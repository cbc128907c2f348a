"""Worker processes with one thread each."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from common.processes import die_with

ONE_CORE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
ENDS_WITHIN = 10.0  # s


@contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """An executor whose processes are ended at once where the block is left by an exception, Ctrl-C included."""
    for variable in ONE_CORE:
        os.environ[variable] = "1"
    executor = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_begin, initargs=(os.getpid(),)
    )
    try:
        yield executor
    except BaseException:
        children = list(executor._processes.values())  # noqa: SLF001 - there is no public way to end a running task
        executor.shutdown(wait=False, cancel_futures=True)
        for child in children:
            child.terminate()
        deadline = time.monotonic() + ENDS_WITHIN
        for child in children:
            child.join(max(0.0, deadline - time.monotonic()))
        for child in children:
            if child.is_alive():  # it was ending what it had started, and would take up the next task
                child.kill()
                child.join()
        raise
    executor.shutdown()


def _begin(parent: int) -> None:
    """Ctrl-C reaches the whole group, but the parent ends us, with SIGTERM; a `Stack` of ours ends with us likewise."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with(parent)  # siblings keep the queue's pipe open, so a parent killed would not be noticed
