"""What the controller said it does, and why, lately. Statuses in, rows out."""

from __future__ import annotations

import re
from collections import deque
from typing import Any

from common.messages import Status

MOST = 20  # rows
NUMBERS = re.compile(r"[-+\d.,()]+")


class Journal:
    """One row for each change of state, or of reason; none for one that is over or has other numbers in it."""

    def __init__(self) -> None:
        """Empty."""
        self._rows: deque[dict[str, Any]] = deque(maxlen=MOST)

    def add(self, status: Status) -> bool:
        """Take a status; whether it made a row."""
        reason = status.reason[:500]
        last = self._rows[-1] if self._rows else None
        same = last is not None and last["state"] == status.state
        if last is not None and same and (not reason or _kind(last["reason"]) == _kind(reason)):
            return False
        self._rows.append({"t": status.stamp_ns * 1e-9, "state": status.state, "reason": reason})
        return True

    def clear(self) -> None:
        """Time went back."""
        self._rows.clear()

    def rows(self) -> list[dict[str, Any]]:
        """Time in s, state and reason; the oldest first."""
        return list(self._rows)


def _kind(reason: str) -> str:
    return NUMBERS.sub("#", reason)
