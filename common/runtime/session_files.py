"""Files that describe the sessions running on this machine: one for each `presage up` or `presage demo`."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import psutil

from common.bus.bus import DEFAULT_ENDPOINT
from common.bus.security import Credentials

# What the command of a service lacks if its session is not known.
MISSING_OPTIONS = {
    "simulator": "--world",
    "estimator": "--world and --estimator",
    "controller": "--world",
}


@dataclass(frozen=True)
class RunningSession:
    """A session that `presage up` or `presage demo` started on this machine."""

    endpoint: str = DEFAULT_ENDPOINT
    robots: tuple[str, ...] = ("robot",)
    security: str = ""  # folder of credentials
    pid: int = 0
    started: float = 0.0  # creation time of the process: a later process may have the same pid
    # Shell command that starts a service again, by service, or by ROBOT/SERVICE for a service of a further robot.
    commands: dict[str, str] = field(default_factory=dict)

    def start_command(self, service: str, robot: str) -> str:
        """The shell command that starts a service again; empty if the session was started without it."""
        return self.commands.get(f"{robot}/{service}") or self.commands.get(service, "")


def runtime_folder() -> Path:
    """Folder with one file for each session: PRESAGE_RUNTIME_DIR, or a folder of this user for temporary files."""
    if chosen := os.environ.get("PRESAGE_RUNTIME_DIR"):
        return Path(chosen)
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.access(runtime, os.W_OK):
        return Path(runtime, "presage")
    if sys.platform == "win32":
        name = "presage"  # each user has a folder for temporary files
    else:
        name = f"presage-{os.getuid()}"
    return Path(tempfile.gettempdir(), name)


@contextmanager
def session_file(
    endpoint: str, robots: Sequence[str], security: Credentials | None, commands: Mapping[str, str]
) -> Iterator[None]:
    """Keeps a file that describes this process's session while the block runs; see `RunningSession`."""
    process, folder = psutil.Process(), runtime_folder()
    keys = "" if security is None else str(security.folder.parent)
    session = RunningSession(endpoint, tuple(robots), keys, process.pid, process.create_time(), dict(commands))
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{process.pid}.json"
    path.write_text(json.dumps(asdict(session)), encoding="utf-8")
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def running_sessions() -> list[RunningSession]:
    """The running sessions of this user; ignores files that ended processes left behind."""
    sessions = []
    for path in sorted(runtime_folder().glob("*.json")):
        with suppress(OSError, ValueError, TypeError, psutil.Error):
            session = RunningSession(**json.loads(path.read_text(encoding="utf-8")))
            if _is_own(path) and psutil.Process(session.pid).create_time() == session.started:
                sessions.append(replace(session, robots=tuple(session.robots)))
    return sessions


def _is_own(path: Path) -> bool:
    """False if another user wrote the file; except on Windows, anyone may write into a folder for temporary files."""
    return sys.platform == "win32" or path.stat().st_uid == os.getuid()


def session_of(robot: str, connect: str = "") -> RunningSession | None:
    """The running session with this robot at the endpoints ``connect``, which default to the usual one."""
    endpoint = connect or DEFAULT_ENDPOINT
    found = (each for each in running_sessions() if each.endpoint == endpoint and robot in each.robots)
    return next(found, None)


def start_command(service: str, robot: str, connect: str, session: RunningSession | None) -> str:
    """The shell command that starts a service, with the options that its ``session`` was started with if it is known.

    Otherwise, a comment at its end says which options must be those of the session. ``connect``: endpoints, or empty
    for the default.
    """
    if session is not None and (command := session.start_command(service, robot)):
        return command
    if service == "router":
        return "python -m common.router"
    command = f"python -m services.{service}"
    if robot != "robot":
        command += f" --robot {robot}"
    if connect:
        command += f" --connect {connect}"
    if missing := MISSING_OPTIONS.get(service):
        command += f"  # add {missing} of the session"
    return command


def is_left_out(service: str, robot: str, session: RunningSession | None) -> bool:
    """Whether the robot's session was started without the service, as with `presage up --no-viewer`."""
    return session is not None and not session.start_command(service, robot)
