"""`presage secure`, and the security options of other commands."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import typer

from presage.terminal import options
from presage.terminal.options import console

app = typer.Typer(help="Certificates, passwords and access by role (docs/security.md).", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="The folder of credentials.")]
Days = Annotated[int, typer.Option(min=1, max=36_500, help="Until the certificates expire.")]
Robots = Annotated[str, typer.Option(help="Comma-separated names of robots; none: all.")]
Hosts = Annotated[str, typer.Option(help="Comma-separated names or addresses in the router's certificate.")]
SOON = dt.timedelta(days=30)


def with_security(*apps: typer.Typer) -> None:
    """Give `--security` and `--role` to every command that says where to connect, or starts a session of its own."""
    for each in apps:
        for command in each.registered_commands:
            if command.callback is not None and {"connect", "port"} & signature(command.callback).parameters.keys():
                command.callback = secured(command.callback)


def secured(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with two more options, which `presage.terminal.options.credentials_for` reads while it runs."""

    @wraps(command)
    def run(*args: Any, security: Path | None = None, role: str = "", **kwargs: Any) -> Any:
        token = options.asked.set(options.Asked(command.__name__, security, role))
        try:
            return command(*args, **kwargs)
        finally:
            options.asked.reset(token)

    added = (("security", options.Security, None), ("role", options.RoleName, ""))
    return options.with_options(run, command, added)


@app.command()
def init(
    folder: Folder,
    hosts: Hosts = "",
    robots: Robots = "",
    days: Days = 365,
    force: Annotated[bool, typer.Option("--force", help="In place of the authority that is there.")] = False,
) -> None:
    """Make an authority, and certificate, key, password and list of rights for every role.

    With `--robots` each robot's own services get credentials for that robot alone.
    Examples: `presage secure init keys`; `presage secure init keys --robots one,two --days 90`.
    """
    from presage.session import credentials as secure  # noqa: PLC0415

    members = secure.init(folder, _names(hosts), _names(robots), days, force=force)
    console.print(
        f"{len(members)} members in {folder}, until {_until(folder, members[0].name):%Y-%m-%d}. Keep "
        f"{folder / secure.AUTHORITY_FOLDER} to yourself; give each host the folders of what runs there, and start all "
        f"with --security. `presage secure show {folder}` says who may do what.",
        soft_wrap=True, highlight=False,
    )  # fmt: skip


@app.command()
def add(
    folder: Folder,
    role: Annotated[str, typer.Argument(help="What it may do.")],
    name: Annotated[str, typer.Argument(help="What it is called.")],
    robots: Robots = "",
    hosts: Hosts = "",
    days: Days = 365,
    force: Annotated[bool, typer.Option("--force", help="New credentials for one that is there.")] = False,
) -> None:
    """One more member, or with --force new credentials for one.

    Examples: `presage secure add keys operator anna`; `presage secure add keys estimator region --robots one,two`;
    `presage secure add keys controller controller --force` (a new certificate before the old one expires).
    """
    from common.bus.security import ROUTER  # noqa: PLC0415
    from presage.session import credentials as secure  # noqa: PLC0415

    member = secure.add(folder, role, name, _names(robots), days, hosts=_names(hosts), force=force)
    console.print(
        f"{folder / member.name}: {member.role} until {_until(folder, member.name):%Y-%m-%d}. Give the routers "
        f"{folder / ROUTER} as it is now, and start them again.",
        soft_wrap=True, highlight=False,
    )  # fmt: skip


@app.command()
def remove(folder: Folder, name: Annotated[str, typer.Argument(help="Who is no longer let in.")]) -> None:
    """Strike a member from the routers' list: a lost laptop, somebody who left.

    Example: `presage secure remove keys anna`.
    """
    from common.bus.security import ROUTER  # noqa: PLC0415
    from presage.session import credentials as secure  # noqa: PLC0415

    secure.remove(folder, name)
    console.print(
        f"{name} is struck off. Give the routers {folder / ROUTER} as it is now, and start them again: "
        "until then it is let in.",
        soft_wrap=True, highlight=False,
    )  # fmt: skip


@app.command()
def show(
    folder: Folder,
    zenoh: Annotated[str, typer.Option(help="Print this member's zenoh configuration, for programs of your own.")] = "",
) -> None:
    """Who may do what, and until when; status 1 where a certificate ends within 30 days.

    Examples: `presage secure show keys`; `presage secure show keys --zenoh observer`.
    """
    from common.bus.security import ROUTER, credentials, read_members  # noqa: PLC0415
    from presage.session.access_tables import members_table, rights_table  # noqa: PLC0415

    if zenoh:
        mine = credentials(folder, (zenoh,))
        mode = "router" if mine.member.role == ROUTER else "client"
        typer.echo(json.dumps(_nested({"mode": mode, **mine.zenoh()}), indent=2))
        return
    members, now = read_members(credentials(folder, (ROUTER,)).folder), dt.datetime.now(dt.timezone.utc)
    ends = {member.name: _until(folder, member.name) for member in members if (folder / member.name).is_dir()}
    console.print(members_table(members, ends, now))
    console.print(rights_table())
    late = [name for name, end in ends.items() if end - now < SOON]
    if late:
        console.print(f"[bold red]soon to expire:[/] {', '.join(late)}; `presage secure add DIR ROLE NAME --force`")
    raise typer.Exit(1 if late else 0)


def _nested(settings: dict[str, Any]) -> dict[str, Any]:
    """``a/b: c`` as ``a: {b: c}``."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *rooms, last = path.split("/")
        place = tree
        for room in rooms:
            place = place.setdefault(room, {})
        place[last] = value
    return tree


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _until(folder: Path, name: str) -> dt.datetime:
    from common.bus.security import CERTIFICATE  # noqa: PLC0415
    from presage.session.credentials import expiry  # noqa: PLC0415

    return expiry(folder / name / CERTIFICATE)
