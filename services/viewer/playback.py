"""Opens a recording as a robot of its own."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from common.bus.bus import wait_until
from common.errors import UserError
from common.processes import end_with_this_process

START_TIMEOUT_S = 30.0  # s; a large file without an index is read through
STOP_TIMEOUT_S = 5.0  # s


@dataclass(frozen=True)
class Child:
    """The replay, and what it complains of."""

    process: subprocess.Popen[bytes]
    complaints: IO[bytes]
    name: str


class Playback:
    """At most one recording is open. Blocks: to be called from threads that may wait."""

    def __init__(self, folder: Path, robot: str, connect: str) -> None:
        """Recordings in ``folder``; shown as ``robot``-replay, over the endpoints ``connect``."""
        self.folder, self._connect = folder, connect
        self.robot = f"{robot[:57]}-replay"  # a name has 64 characters at most
        self._child: Child | None = None
        self._lock = threading.Lock()
        self._leaving = False

    @property
    def name(self) -> str:
        """Of the open recording; empty where none is."""
        child = self._child
        return child.name if child is not None else ""

    def files(self) -> list[dict[str, Any]]:
        """Name, size in bytes and, where it can be read quickly, duration in s; the newest first."""
        try:
            paths = [path for path in self.folder.glob("*.mcap") if path.is_file()]
            dated = sorted(((path.stat().st_mtime, path) for path in paths), reverse=True)
        except OSError:
            return []
        return [described(path) for _, path in dated[:500]]

    def open(self, name: str, alive: Callable[[], bool]) -> None:
        """Start; raises UserError where there is no such recording or it cannot be played. One open before is closed.

        ``alive``: whether the replay's service is there.
        """
        if name not in {path.name for path in self.folder.glob("*.mcap")}:
            raise UserError(f"no recording {name!r} in {self.folder}")
        with self._lock:
            self._end()
            wait_until(lambda: not alive() or self._leaving, STOP_TIMEOUT_S)
            if self._leaving:
                raise UserError("the viewer ends")
            child = self._child = self._start(name)
            over = lambda: alive() or self._leaving or child.process.poll() is not None  # noqa: E731
            if wait_until(over, START_TIMEOUT_S) and alive():
                return
            why = self._end() or f"it did not start within {START_TIMEOUT_S:g} s"
        raise UserError(f"{name} cannot be played: {why}")

    def close(self) -> None:
        """End it, if there is one."""
        with self._lock:
            self._end()

    def leave(self) -> None:
        """Close it, and open none any more: the viewer ends."""
        self._leaving = True
        self.close()

    def ended(self) -> str | None:
        """The last complaint of a replay that ended by itself, which is closed then; None where all is well."""
        child = self._child
        if child is None or child.process.poll() is None:
            return None
        with self._lock:
            return self._end() if self._child is child else None

    def _start(self, name: str) -> Child:
        command = [sys.executable, "-m", "presage", "replay", str(self.folder / name), "--robot", self.robot]
        command += ["--connect", self._connect, "--force", "--paused", "--stay"]
        complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed in _end
        process = subprocess.Popen(  # noqa: S603 - our own module; the name is one of the folder's
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=complaints,
            start_new_session=True,
            preexec_fn=end_with_this_process(),  # noqa: PLW1509 - one call, before any thread of the child
        )
        return Child(process, complaints, name)

    def _end(self) -> str:
        """Its last complaint."""
        child, self._child = self._child, None
        if child is None:
            return ""
        if child.process.poll() is None:
            child.process.terminate()
            try:
                child.process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        child.complaints.seek(0)
        lines = child.complaints.read(100_000).decode(errors="replace").strip().splitlines()
        child.complaints.close()
        return lines[-1].removeprefix("presage: ")[:500] if lines else ""


def described(path: Path) -> dict[str, Any]:
    """Of a file: name, size in bytes, when it was last written to (s since 1970), duration in s where it is known."""
    status = path.stat()
    row = {"name": path.name, "size": status.st_size, "modified": status.st_mtime}
    # Without mcap, or of a file without an end, the duration is not known: the list is no place to complain.
    with suppress(Exception):
        from mcap.reader import make_reader  # noqa: PLC0415 - the viewer runs without it

        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is not None and summary.statistics is not None:
            times = summary.statistics
            row["duration"] = (times.message_end_time - times.message_start_time) * 1e-9
    return row
