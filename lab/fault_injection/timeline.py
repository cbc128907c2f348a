"""Events in order, and the times between them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from common.errors import UserError

Row = dict[str, Any]
MAX_STANDING_SPEED = 0.01  # m/s
MIN_MOVING_SPEED = 0.05  # m/s


class Timeline:
    """Events from the observer in the order of arrival; one thread adds them, another reads them."""

    def __init__(self) -> None:
        """Starts with an empty list of events."""
        self.rows: list[Row] = []
        self._lock = threading.RLock()  # entered directly, because Ctrl-C in Condition.__enter__ would leave it locked
        self._changed = threading.Condition(self._lock)

    def add(self, row: Row) -> None:
        """Appends an event and wakes up waiting threads."""
        with self._lock:
            self.rows.append(row)
            self._changed.notify_all()

    def first(self, since: float, wanted: Callable[[Row], bool]) -> Row | None:
        """The first event at or after ``since`` (s) for which ``wanted`` is true, if any."""
        with self._lock:
            rows = list(self.rows)
        return next((row for row in rows if row["t"] >= since and wanted(row)), None)

    def wait(self, since: float, wanted: Callable[[Row], bool], timeout: float, what: str) -> Row:
        """Waits for the first event at or after ``since`` (s) for which ``wanted`` is true, and returns it.

        Raises UserError if there is none within ``timeout`` s; ``what`` names the event in the message.
        """
        deadline = time.monotonic() + timeout
        next_index = 0
        while True:
            with self._lock:
                new, next_index = self.rows[next_index:], len(self.rows)
                for row in new:
                    if row["t"] >= since and wanted(row):
                        return row
                if not self._changed.wait(max(0.0, min(0.5, deadline - time.monotonic()))) and (
                    time.monotonic() >= deadline
                ):
                    raise UserError(f"{what}: did not happen within {timeout:g} s")

    def forget(self, before: float) -> None:
        """Removes events before the time ``before`` (s)."""
        with self._lock:
            self.rows = [row for row in self.rows if row["t"] >= before]


def is_truth(row: Row) -> bool:
    """Whether the event is the robot's true state."""
    return bool(row["what"] == "truth")


def is_standing(row: Row) -> bool:
    """Whether the event shows that the robot stands."""
    return is_truth(row) and row["speed"] < MAX_STANDING_SPEED


def is_moving(row: Row) -> bool:
    """Whether the event shows that the robot moves."""
    return is_truth(row) and row["speed"] > MIN_MOVING_SPEED


def is_gone(service: str) -> Callable[[Row], bool]:
    """Returns a predicate: whether an event shows that the service's liveliness token disappeared."""
    return lambda row: row["what"] == "alive" and row["service"] == service and not row["there"]


def is_back(service: str) -> Callable[[Row], bool]:
    """Returns a predicate: whether an event shows that the service's liveliness token appeared."""
    return lambda row: row["what"] == "alive" and row["service"] == service and bool(row["there"])


def is_standing_by(process: str) -> Callable[[Row], bool]:
    """Returns a predicate: whether an event is the log line of a process that waits for the active instance to end."""
    return lambda row: row["what"] == "log" and row["name"] == process and "leads" in row["fields"]


def is_error(process: str) -> Callable[[Row], bool]:
    """Returns a predicate: whether an event is an error that the process logged."""
    return lambda row: row["what"] == "log" and row["name"] == process and row["fields"].get("level") == "error"


def is_lost(row: Row) -> bool:
    """Whether the event is a controller status `lost`."""
    return bool(row["what"] == "status" and row["state"] == "lost")
