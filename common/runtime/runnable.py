"""Interface of a loop that can be run and stopped."""

from __future__ import annotations

from typing import Protocol


class Runnable(Protocol):
    """A loop that runs until it is stopped."""

    def run(self) -> None:
        """Runs until `stop` is called."""
        ...

    def stop(self) -> None:
        """Makes `run` return after its current step; safe to call from a signal handler."""
        ...
