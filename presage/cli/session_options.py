"""The options of `presage` that choose a session and a robot; they stand before the command."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from common.bus.bus import Link
from presage.session.running_sessions import OPERATOR, link_of

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
    """Link to the chosen robot and session; ``robot`` replaces the option `--robot`."""
    options = context.find_root().params
    return link_of(options["connect"], robot or options["robot"], roles)
