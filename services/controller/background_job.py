"""Runs jobs that take longer than a scan period in a background thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

R = TypeVar("R")


class BackgroundJob(Generic[R]):
    """Runs one job at a time. Of the jobs that are submitted meanwhile, only the newest is kept, and runs next."""

    def __init__(self, wake: Callable[[], None]) -> None:
        """``wake`` is called from the thread when a result is ready."""
        self._wake = wake
        self._waiting: Callable[[], R] | None = None
        self._running: Future[R] | None = None
        self._pool = ThreadPoolExecutor(1, "background")

    def submit(self, job: Callable[[], R]) -> None:
        """Starts a job, or keeps it until the running one is done."""
        self._waiting = job
        self._start()

    def _start(self) -> None:
        if self._running is None and self._waiting is not None:
            job, self._waiting = self._waiting, None
            self._running = self._pool.submit(job)
            self._running.add_done_callback(lambda _: self._wake())

    @property
    def ready(self) -> bool:
        """Whether `take` returns a result."""
        return self._running is not None and self._running.done()

    def take(self) -> R:
        """Returns the result of the finished job and starts the waiting one; raises the job's exception."""
        assert self._running is not None  # noqa: S101 - only called when `ready`
        done, self._running = self._running, None
        self._start()
        return done.result()

    def close(self) -> None:
        """Waits for the running job, and drops the waiting one."""
        self._pool.shutdown(cancel_futures=True)
