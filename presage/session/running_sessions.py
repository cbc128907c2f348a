"""How a command finds the session and the robot that it is for."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from common.bus.bus import DEFAULT_ENDPOINT, Link
from common.bus.security import Credentials, read_credentials
from common.errors import UserError
from common.messages.topics import ROBOT_NAME_PATTERN
from common.names import split_names
from common.runtime.session_files import RunningSession, running_sessions

OPERATOR, OBSERVER = ("operator",), ("observer", "operator")  # roles for commands that act, and that only read


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
