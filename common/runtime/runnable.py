"""Protocol of anything with run() and stop()."""

from __future__ import annotations

from typing import Protocol


class Runnable(Protocol):
    """Whatever runs until it is told to stop."""

    def run(self) -> None:
        """Until `stop`."""
        ...

    def stop(self) -> None:
        """End after the current step; safe from a signal handler."""
        ...
