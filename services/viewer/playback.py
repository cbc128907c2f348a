"""Opens a recording and replays it as a separate robot."""

from __future__ import annotations

import os
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

START_TIMEOUT_S = 30.0  # long, because a file without an index is read completely
STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class ReplayProcess:
    """The process of a replay."""

    process: subprocess.Popen[bytes]
    stderr: IO[bytes]
    name: str  # file name of the recording


class Playback:
    """Replays at most one recording in a child process. Its methods block, so call them from a worker thread."""

    def __init__(self, folder: Path, robot: str, connect: str, security: Path | None = None) -> None:
        """Replays files of ``folder`` under the robot name ``robot``-replay, over the endpoints ``connect``.

        ``security`` is the folder of credentials, if the bus needs them.
        """
        self.folder, self._connect, self._security = folder, connect, security
        self.robot = f"{robot[:57]}-replay"  # a robot's name has at most 64 characters
        self._child: ReplayProcess | None = None
        self._lock = threading.Lock()
        self._leaving = False

    @property
    def name(self) -> str:
        """File name of the open recording; empty if none is open."""
        child = self._child
        return child.name if child is not None else ""

    def files(self) -> list[dict[str, Any]]:
        """Recordings of the folder as rows of `describe_file`, the newest first, at most 500."""
        try:
            paths = [path for path in self.folder.glob("*.mcap") if path.is_file()]
            dated = sorted(((path.stat().st_mtime, path) for path in paths), reverse=True)
        except OSError:
            return []
        return [describe_file(path) for _, path in dated[:500]]

    def open(self, name: str, alive: Callable[[], bool]) -> None:
        """Closes the open recording, if any, and starts to replay another.

        ``alive`` returns whether the replay's service is alive. Raises UserError if there is no such recording or it
        cannot be played.
        """
        self.check(name)
        with self._lock:
            self._end()
            wait_until(lambda: not alive() or self._leaving, STOP_TIMEOUT_S)
            if self._leaving:
                raise UserError("the viewer is shutting down")
            child = self._child = self._start(name)
            wait_until(lambda: alive() or self._leaving or child.process.poll() is not None, START_TIMEOUT_S)
            if alive():
                return
            reason = self._end() or f"it did not start within {START_TIMEOUT_S:g} s"
        raise UserError(f"{name} cannot be played: {reason}")

    def check(self, name: str) -> None:
        """Raises UserError if there is no such recording."""
        if name not in {path.name for path in self.folder.glob("*.mcap")}:
            raise UserError(f"no recording {name!r} in {self.folder}")

    def close(self) -> None:
        """Ends the replay, if there is one."""
        with self._lock:
            self._end()

    def leave(self) -> None:
        """Ends the replay and refuses to start another, because the viewer is shutting down."""
        self._leaving = True
        self.close()

    def ended(self) -> str | None:
        """Closes a replay that ended by itself and returns its last error line. Returns None if it is still running."""
        child = self._child
        if child is None or child.process.poll() is None:
            return None
        with self._lock:
            return self._end() if self._child is child else None

    def _start(self, name: str) -> ReplayProcess:
        command = [sys.executable, "-m", "presage", "--connect", self._connect, "replay", str(self.folder / name)]
        command += ["--robot", self.robot, "--force", "--paused"]
        # The role is chosen by `presage replay`: the viewer's own may not publish a recording.
        environment = {name: value for name, value in os.environ.items() if name != "PRESAGE_ROLE"}
        if self._security is not None:
            environment["PRESAGE_SECURITY"] = str(self._security)
        stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed in _end
        process = subprocess.Popen(  # noqa: S603 - runs this package; `open` checked the name against the folder
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            env=environment,
            start_new_session=True,
            preexec_fn=end_with_this_process(),  # noqa: PLW1509 - one call, before any thread of the child
        )
        return ReplayProcess(process, stderr, name)

    def _end(self) -> str:
        """Ends the child process and returns its last error line, or an empty string."""
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
        child.stderr.seek(0)
        lines = child.stderr.read(100_000).decode(errors="replace").strip().splitlines()
        child.stderr.close()
        return lines[-1].removeprefix("presage: ")[:500] if lines else ""


def describe_file(path: Path) -> dict[str, Any]:
    """Name, size in bytes, time of the last modification (s since 1970) and, if known, duration in s."""
    status = path.stat()
    row = {"name": path.name, "size": status.st_size, "modified": status.st_mtime}
    # Without the package mcap, or for an unfinished file, the duration stays unknown. A list is no place for an error.
    with suppress(Exception):
        from mcap.reader import make_reader  # optional for the viewer

        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is not None and summary.statistics is not None:
            statistics = summary.statistics
            row["duration"] = (statistics.message_end_time - statistics.message_start_time) * 1e-9
    return row
