"""A status file written once a second, for health checks on the same machine.

A health check over the bus would need a zenoh session, which costs half a second of CPU time for each check. This
module imports only the standard library, so that a health check starts in 20 ms.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

COUNT_KINDS = ("received", "published", "written")


@dataclass(frozen=True)
class Beat:
    """State of a service at one moment. Times are s of the monotonic clock, which all processes of a machine share."""

    at: float  # when it was written
    linked: bool  # connected to at least one other session
    note: str = ""  # the note of its health message
    last: dict[str, dict[str, float]] = field(default_factory=dict)  # by key and kind: when the count last increased


class Heartbeat:
    """Writes the heartbeat file of one process."""

    def __init__(self, folder: Path | None, service: str, robot: str) -> None:
        """Write into ``folder``, or nowhere if it is None."""
        self._path = None if folder is None else folder / f"{service}@{robot}.beat"
        self._counts: dict[tuple[str, str], int] = {}
        self._last: dict[str, dict[str, float]] = {}

    def beat(self, counts: Mapping[str, Mapping[str, int]], *, linked: bool, note: str = "") -> None:
        """Write the current state; ``counts`` are the totals so far, by key and kind.

        Errors in writing are ignored: a health check notices the old time in the file.
        """
        if self._path is None:
            return
        now = time.monotonic()
        for key, row in counts.items():
            for kind in COUNT_KINDS:
                count = row.get(kind, 0)
                if count > self._counts.get((key, kind), 0):
                    self._last.setdefault(key, {})[kind] = now
                self._counts[key, kind] = count
        partial = self._path.with_suffix(".partial")
        with suppress(OSError):
            partial.write_text(json.dumps(asdict(Beat(now, linked, note, self._last))))
            partial.replace(self._path)


def read_beats(folder: Path, service: str) -> dict[str, Beat]:
    """Latest heartbeats of a service's processes, by the robot's name."""
    found = {}
    for path in sorted(folder.glob(f"{service}@*.beat")):
        with suppress(OSError, ValueError, TypeError):  # skip files that a Heartbeat did not write
            found[path.stem.removeprefix(f"{service}@")] = Beat(**json.loads(path.read_text()))
    return found
