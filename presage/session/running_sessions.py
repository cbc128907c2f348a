"""The running sessions of this user, and how a command finds the one it is for."""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import psutil

from common.bus.bus import DEFAULT_ENDPOINT, Link
from common.bus.security import Credentials, read_credentials
from common.errors import UserError
from common.messages.topics import ROBOT_NAME_PATTERN
from common.names import split_names

OPERATOR, OBSERVER = ("operator",), ("observer", "operator")  # roles for commands that act, and that only read


@dataclass(frozen=True)
class RunningSession:
    """A session that `presage up` or `presage demo` started on this machine."""

    endpoint: str = DEFAULT_ENDPOINT
    robots: tuple[str, ...] = ("robot",)
    security: str = ""  # folder of credentials
    pid: int = 0
    started: float = 0.0  # creation time of the process: a later process may have the same pid


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
def session_file(endpoint: str, robots: Sequence[str], security: Credentials | None) -> Iterator[None]:
    """Keeps a file that describes this process's session while the block runs."""
    process, folder = psutil.Process(), runtime_folder()
    keys = "" if security is None else str(security.folder.parent)
    session = RunningSession(endpoint, tuple(robots), keys, process.pid, process.create_time())
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


def find_session(connect: str) -> RunningSession:
    """The session at the endpoints ``connect``; if these are empty, the running one, or else the default endpoint.

    Raises UserError if several sessions run.
    """
    sessions = [session for session in running_sessions() if connect in {"", session.endpoint}]
    if len(sessions) > 1:
        known = "; ".join(f"{session.endpoint} ({', '.join(session.robots)})" for session in sessions)
        raise UserError(f"several sessions run on this machine, choose one with `presage --connect`: {known}")
    return sessions[0] if sessions else RunningSession(connect or DEFAULT_ENDPOINT)


def link_of(connect: str, robot: str, roles: Sequence[str] = OPERATOR) -> Link:
    """Link to a robot of the session that `find_session` finds; ``robot`` defaults to the session's only one.

    Raises UserError for a name that no robot can have, such as `*`, which would address all robots.
    """
    if robot:
        check_robot_name(robot)
    session = find_session(connect)
    if not robot and len(session.robots) > 1:
        raise UserError(
            f"several robots run in this session, choose one with `presage --robot`: {', '.join(session.robots)}"
        )
    robot = robot or session.robots[0]
    return Link(
        robot, tuple(split_names(session.endpoint)), security=credentials_for(robot, roles, folder=session.security)
    )


def check_robot_name(name: str) -> None:
    """Raises UserError if no robot can have the name."""
    if not re.fullmatch(ROBOT_NAME_PATTERN, name):
        raise UserError(f"robot {name!r}: give the name of one robot, of up to 64 letters, digits, -, _ and .")


def credentials_for(robot: str, roles: Sequence[str] = OPERATOR, *, folder: str = "") -> Credentials | None:
    """Credentials of the first of ``roles`` that the folder PRESAGE_SECURITY has, by default ``folder``.

    Returns None without a folder. PRESAGE_ROLE replaces ``roles``.
    """
    folder = os.environ.get("PRESAGE_SECURITY") or folder
    role = os.environ.get("PRESAGE_ROLE")
    return read_credentials(Path(folder), (role,) if role else roles, robot) if folder else None
