"""The options of `presage` that choose a session and a robot; they stand before the command."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from common.bus.bus import Link
from common.runtime.session_files import running_sessions
from presage.session.running_sessions import OBSERVER, OPERATOR, link_of

RobotName = Annotated[
    str, typer.Option(envvar="PRESAGE_ROBOT", help="Robot name. Defaults to the only robot of the session.")
]
Connect = Annotated[
    str,
    typer.Option(
        envvar="PRESAGE_CONNECT",
        help="Zenoh endpoints, separated by commas. Defaults to the session that runs on this machine.",
    ),
]


def chosen_link(context: typer.Context, roles: Sequence[str] = OPERATOR, robot: str = "") -> Link:
    """Link to the chosen robot and session; ``robot`` replaces the option `--robot`.

    Says which session it is if a command acts on a running one that the user has not chosen.
    """
    options = context.find_root().params
    link = link_of(options["connect"], robot or options["robot"], roles)
    if not options["connect"] and roles != OBSERVER and running_sessions():
        # Not to stdout, which may be read by a program.
        typer.echo(f"using session {', '.join(link.connect)}, robot {link.robot}", err=True)
    return link
