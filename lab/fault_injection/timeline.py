"""Events in order, and the times between them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from common.errors import UserError

Row = dict[str, Any]
STANDING = 0.01  # m/s
MOVING = 0.05  # m/s


class Timeline:
    """Rows as they come from the observer; filled by one thread, read by another."""

    def __init__(self) -> None:
        """Empty."""
        self.rows: list[Row] = []
        self._lock = threading.RLock()  # entered by itself: Ctrl-C in Condition's __enter__ would leave it locked
        self._changed = threading.Condition(self._lock)

    def add(self, row: Row) -> None:
        """A row came."""
        with self._lock:
            self.rows.append(row)
            self._changed.notify_all()

    def first(self, since: float, wanted: Callable[[Row], bool], until: float = float("inf")) -> Row | None:
        """The first row from ``since`` s on that is wanted."""
        with self._lock:
            rows = list(self.rows)
        return next((row for row in rows if since <= row["t"] < until and wanted(row)), None)

    def wait(self, since: float, wanted: Callable[[Row], bool], timeout: float, what: str) -> Row:
        """The first such row, as soon as it is there; raises UserError naming ``what`` did not happen."""
        deadline = time.monotonic() + timeout
        at = 0
        while True:
            with self._lock:
                new, at = self.rows[at:], len(self.rows)
                for row in new:
                    if row["t"] >= since and wanted(row):
                        return row
                if not self._changed.wait(max(0.0, min(0.5, deadline - time.monotonic()))) and (
                    time.monotonic() >= deadline
                ):
                    raise UserError(f"{what}: not within {timeout:g} s")

    def forget(self, before: float) -> None:
        """Rows older than ``before`` s, which nobody will ask for."""
        with self._lock:
            self.rows = [row for row in self.rows if row["t"] >= before]


def truth(row: Row) -> bool:
    """Of the robot itself."""
    return bool(row["what"] == "truth")


def standing(row: Row) -> bool:
    """The robot stands."""
    return truth(row) and row["speed"] < STANDING


def moving(row: Row) -> bool:
    """It moves."""
    return truth(row) and row["speed"] > MOVING


def gone(service: str) -> Callable[[Row], bool]:
    """The service's liveliness token is gone."""
    return lambda row: row["what"] == "alive" and row["service"] == service and not row["there"]


def back(service: str) -> Callable[[Row], bool]:
    """It is there."""
    return lambda row: row["what"] == "alive" and row["service"] == service and bool(row["there"])


def worried(row: Row) -> bool:
    """The controller says that it lost its belief."""
    return bool(row["what"] == "status" and row["state"] == "lost")
