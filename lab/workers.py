"""Worker processes with one thread each."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from common.processes import end_with_parent

THREAD_COUNT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
TERMINATION_TIMEOUT_S = 10.0


@contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Context manager that yields an executor of ``workers`` single-threaded processes.

    If the block raises, Ctrl-C included, it terminates the processes at once instead of waiting for running tasks.
    """
    for variable in THREAD_COUNT_VARIABLES:
        os.environ[variable] = "1"
    executor = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_initialise_worker, initargs=(os.getpid(),)
    )
    try:
        yield executor
    except BaseException:
        children = list(executor._processes.values())  # noqa: SLF001 - there is no public way to end a running task
        executor.shutdown(wait=False, cancel_futures=True)
        for child in children:
            child.terminate()
        deadline = time.monotonic() + TERMINATION_TIMEOUT_S
        for child in children:
            child.join(max(0.0, deadline - time.monotonic()))
        for child in children:
            if child.is_alive():  # busy with its own clean-up, after which it would start the next task
                child.kill()
                child.join()
        raise
    executor.shutdown()


def _initialise_worker(parent: int) -> None:
    # Ctrl-C reaches the whole process group. Workers ignore it: the parent ends them with SIGTERM, and the processes
    # of a `Stack` that a worker started end with the worker.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent(parent)  # other workers keep the queue's pipe open, so a worker would not notice its parent's death
