"""A status file written once a second, for health checks on the same machine.

Asking over the bus would say the same and cost a session, half a second of a core, each time. Only the standard library
here: whoever reads it starts in 20 ms.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

KINDS = ("received", "published", "written")


@dataclass(frozen=True)
class Beat:
    """How a service stood; times are of the machine's monotonic clock, s, which all its processes share."""

    at: float
    linked: bool  # to any other session
    note: str = ""  # of its health
    last: dict[str, dict[str, float]] = field(default_factory=dict)  # by key and kind: when a count last rose


class Heartbeat:
    """Writes the file of one process."""

    def __init__(self, folder: Path | None, service: str, robot: str) -> None:
        """Into ``folder``; None: nothing is written."""
        self._path = None if folder is None else folder / f"{service}@{robot}.beat"
        self._counts: dict[tuple[str, str], int] = {}
        self._last: dict[str, dict[str, float]] = {}

    def beat(self, counts: Mapping[str, Mapping[str, int]], *, linked: bool, note: str = "") -> None:
        """Now, with what was counted so far by key and kind; what cannot be written shows by its age."""
        if self._path is None:
            return
        now = time.monotonic()
        for key, row in counts.items():
            for kind in KINDS:
                count = row.get(kind, 0)
                if count > self._counts.get((key, kind), 0):
                    self._last.setdefault(key, {})[kind] = now
                self._counts[key, kind] = count
        partial = self._path.with_suffix(".partial")
        with suppress(OSError):
            partial.write_text(json.dumps(asdict(Beat(now, linked, note, self._last))))
            partial.replace(self._path)


def read_beats(folder: Path, service: str) -> dict[str, Beat]:
    """What the service's processes last wrote, by the robot's name."""
    found = {}
    for path in sorted(folder.glob(f"{service}@*.beat")):
        with suppress(OSError, ValueError, TypeError):  # a file nobody of ours wrote counts as none
            found[path.stem.removeprefix(f"{service}@")] = Beat(**json.loads(path.read_text()))
    return found
