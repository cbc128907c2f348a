"""Tables of the members and of the rights of each role."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence

from rich.table import Table

from common.bus.security import ROLES, ROUTER, Member, may_answer, may_put, may_query
from common.messages.topics import QUERIES, TOPICS


def members_table(members: Sequence[Member], ends: Mapping[str, dt.datetime], now: dt.datetime) -> Table:
    """A table with one row for each member; ``ends`` holds the known expiry dates of certificates, by name."""
    table = Table(title="members", title_justify="left")
    for column in ("name", "role", "robots", "certificate ends", "days left"):
        table.add_column(column)
    for member in members:
        end = ends.get(member.name)
        when = (f"{end:%Y-%m-%d}", str((end - now).days)) if end else ("not here", "")
        table.add_row(member.name, member.role, ", ".join(member.robots).replace("*", "all"), *when)
    return table


def rights_table() -> Table:
    """A table with one row for each role: topics it may publish, queries it may send and answer.

    Every role may subscribe to everything.
    """
    table = Table(title="roles (each may also listen)", title_justify="left", show_lines=True)
    for column in ("role", "puts", "asks", "answers", "for"):
        table.add_column(column)
    for role, about in ROLES.items():
        if role == ROUTER:
            table.add_row(role, "all", "all", "all", about)
            continue
        table.add_row(
            role,
            ", ".join(t.name for t in TOPICS if may_put(role, t)) or "-",
            ", ".join(q.name for q in QUERIES if may_query(role, q)) or "-",
            ", ".join(q.name for q in QUERIES if may_answer(role, q)) or "-",
            about,
        )
    return table
