"""Writes a status file once a second, for health checks on the same machine.

A health check over the bus would need a zenoh session, which costs half a second of CPU time for each check. This
module imports only the standard library, so that a health check starts in 20 ms.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from common.runtime.service_monitor import CountTimes, Report


class Heartbeat:
    """Writes the heartbeat file of one process. All processes of a machine share its monotonic clock."""

    def __init__(self, folder: Path | None, service: str, robot: str) -> None:
        """Writes into ``folder``, or nowhere if it is None."""
        self._path = None if folder is None else folder / f"{service}@{robot}.beat"
        self._times = CountTimes()

    def beat(
        self, counts: Mapping[str, Mapping[str, int]], *, linked: bool, note: str = "", idle: bool = False
    ) -> None:
        """Writes the current state; ``counts`` are the totals so far, by key and kind.

        Errors in writing are ignored: a health check notices the old time in the file.
        """
        if self._path is None:
            return
        now = time.monotonic()
        self._times.update(counts, now)
        partial = self._path.with_suffix(".partial")
        with suppress(OSError):
            partial.write_text(json.dumps(asdict(Report(now, linked, note, idle, self._times.increased_at))))
            partial.replace(self._path)


def read_beats(folder: Path, service: str) -> dict[str, Report]:
    """Latest heartbeats of a service's processes, by the robot's name."""
    found = {}
    for path in sorted(folder.glob(f"{service}@*.beat")):
        with suppress(OSError, ValueError, TypeError):  # skip files that a Heartbeat did not write
            found[path.stem.removeprefix(f"{service}@")] = Report(**json.loads(path.read_text()))
    return found
