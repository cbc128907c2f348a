"""`presage secure`."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from common.names import split_names
from presage.terminal.options import console

app = typer.Typer(
    help="Manage the certificates, passwords and access rights of secure mode (docs/security.md).", no_args_is_help=True
)

Folder = Annotated[Path, typer.Argument(help="Folder of credentials.")]
Days = Annotated[int, typer.Option(min=1, max=36_500, help="Days until the certificates expire.")]
Robots = Annotated[str, typer.Option(help="Names of robots, separated by commas. Defaults to all robots.")]
Hosts = Annotated[str, typer.Option(help="Host names or addresses in the router's certificate, separated by commas.")]
EXPIRY_WARNING = dt.timedelta(days=30)


@app.command()
def init(
    folder: Folder,
    hosts: Hosts = "",
    robots: Robots = "",
    days: Days = 365,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the existing authority; its certificates become invalid.")
    ] = False,
) -> None:
    """Create a certificate authority, and a certificate, key and password for every role.

    With `--robots`, the services of each robot get credentials that are valid for that robot only.

    Examples: `presage secure init keys`; `presage secure init keys --robots one,two --days 90`.
    """
    from presage.session import credentials as secure

    members = secure.init(folder, split_names(hosts), split_names(robots), days, force=force)
    console.print(
        f"{len(members)} members in {folder}, valid until {_expiry_date(folder, members[0].name):%Y-%m-%d}. Keep "
        f"{folder / secure.AUTHORITY_FOLDER} secret. Copy to each host only the folders of the programs that run "
        f"there, and set PRESAGE_SECURITY to the folder. `presage secure show {folder}` lists the rights of each role.",
        soft_wrap=True,
        highlight=False,
    )


@app.command()
def add(
    folder: Folder,
    role: Annotated[str, typer.Argument(help="Role of the member; it determines the rights.")],
    name: Annotated[str, typer.Argument(help="Name of the member.")],
    robots: Robots = "",
    hosts: Hosts = "",
    days: Days = 365,
    force: Annotated[
        bool, typer.Option("--force", help="Issue a new certificate, key and password to an existing member.")
    ] = False,
) -> None:
    """Add a member, or with --force renew the credentials of one.

    Examples: `presage secure add keys operator anna`; `presage secure add keys estimator region --robots one,two`;
    `presage secure add keys controller controller --force` (a new certificate before the old one expires).
    """
    from common.bus.security import ROUTER
    from presage.session import credentials as secure

    member = secure.add(folder, role, name, split_names(robots), days, hosts=split_names(hosts), force=force)
    console.print(
        f"{folder / member.name}: {member.role}, valid until {_expiry_date(folder, member.name):%Y-%m-%d}. Copy "
        f"{folder / ROUTER} to the routers and restart them.",
        soft_wrap=True,
        highlight=False,
    )


@app.command()
def remove(folder: Folder, name: Annotated[str, typer.Argument(help="Name of the member.")]) -> None:
    """Revoke the access of a member, for example of a lost laptop.

    Example: `presage secure remove keys anna`.
    """
    from common.bus.security import ROUTER
    from presage.session import credentials as secure

    secure.remove(folder, name)
    console.print(
        f"{name} is removed. Copy {folder / ROUTER} to the routers and restart them; until then {name} has access.",
        soft_wrap=True,
        highlight=False,
    )


@app.command()
def show(
    folder: Folder,
    zenoh: Annotated[
        str, typer.Option(help="Print the zenoh configuration of this member, for use in other programs.")
    ] = "",
) -> None:
    """Show all members, their rights and when their certificates expire.

    Exits with status 1 if a certificate expires within 30 days.

    Examples: `presage secure show keys`; `presage secure show keys --zenoh observer`.
    """
    from common.bus.security import ROUTER, read_credentials, read_members
    from presage.session.access_tables import members_table, rights_table

    if zenoh:
        of_member = read_credentials(folder, (zenoh,))
        mode = "router" if of_member.member.role == ROUTER else "client"
        typer.echo(json.dumps(_nested({"mode": mode, **of_member.zenoh()}), indent=2))
        return
    members, now = read_members(read_credentials(folder, (ROUTER,)).folder), dt.datetime.now(dt.timezone.utc)
    ends = {member.name: _expiry_date(folder, member.name) for member in members if (folder / member.name).is_dir()}
    console.print(members_table(members, ends, now))
    console.print(rights_table())
    expiring = [name for name, end in ends.items() if end - now < EXPIRY_WARNING]
    if expiring:
        console.print(
            f"[bold red]expired, or expiring within {EXPIRY_WARNING.days} days: {', '.join(expiring)}[/]; "
            "renew each with `presage secure add FOLDER ROLE NAME --force`",
            soft_wrap=True,
        )
    raise typer.Exit(1 if expiring else 0)


def _nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with keys such as ``a/b`` as nested dictionaries: ``{"a/b": c}`` becomes ``{"a": {"b": c}}``."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, key = path.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[key] = value
    return tree


def _expiry_date(folder: Path, name: str) -> dt.datetime:
    from common.bus.security import CERTIFICATE
    from presage.session.credentials import expiry

    return expiry(folder / name / CERTIFICATE)
