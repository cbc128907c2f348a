"""Roles, access rules derived from the table of topics, and credentials.

In secure mode every session but the router's is a zenoh client: all goes through routers, which check certificate,
password and, message by message, the role. docs/security.md says what that protects, and what not.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from common.errors import UserError, first_fault
from common.messages.topics import ALL_ROLES, QUERIES, ROOT, TOPICS, Query, Topic

ROUTER = "router"
IDENTITY, AUTHORITY, CERTIFICATE, KEY, PASSWORD = "identity.json", "ca.crt", "own.crt", "own.key", "password"
MEMBERS, PASSWORDS = "members.json", "passwords"  # the router's alone
NAME = r"^[a-z0-9][a-z0-9_-]{0,62}$"  # no dot: no public authority certifies it, so a certificate of theirs fits nobody
ROLES: dict[str, str] = {
    ROUTER: "passes on what the others may send; trusted with all of it",
    "simulator": "the robot: scanner, odometry, wheels",
    "bridge_ros2": "a robot in ROS 2, and who sits at its rviz: scanner, odometry, wheels, goals",
    "estimator": "says where the robot is",
    "controller": "drives the robot",
    "recorder": "hears everything, keeps it",
    "viewer": "the live page, to look at",
    "viewer-control": "the live page, whose visitors may drive",
    "operator": "people and tools that may drive, teleport, reset, record",
    "observer": "people and tools that look on",
    "remote": "waits for the scans of a robot elsewhere, and says whether they come",
    "replay": "puts a recording back on its keys: in place of the whole robot",
}
EVERY_ROBOT = ("*",)
READ = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
ANSWER = ("declare_queryable", "reply")
EVERYTHING = (*READ, *ANSWER, "put", "delete", "query", "liveliness_token")
Rule = tuple[tuple[str, ...], list[str]]  # messages, key expressions


class Member(BaseModel):
    """One name a certificate can show."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    role: str
    robots: tuple[str, ...] = EVERY_ROBOT  # whose keys it may use


class Members(BaseModel):
    """Everybody whom a router lets in; who is not in it has no rights, whatever their certificate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    members: tuple[Member, ...]


def service_of(role: str) -> str:
    """The service that has the role, under whose name it speaks; empty for people, tools and the router."""
    return "" if role in {ROUTER, "operator", "observer"} else role.removesuffix("-control")


def may_put(role: str, topic: Topic) -> bool:
    """Whether the role may publish the topic."""
    if topic.per_service:
        return bool(service_of(role))
    return role in (topic.publisher_roles or (topic.publisher,)) or (role == "replay" and topic.recorded)


def may_ask(role: str, query: Query) -> bool:
    """Whether the role may ask the query."""
    return role in query.requester_roles


def may_answer(role: str, query: Query) -> bool:
    """Whether the role serves the query; a replay speaks for the world it was recorded in."""
    if query.per_service:
        return bool(service_of(role))
    return role == query.server or (role == "replay" and query.name == "world")


def rules_of(member: Member) -> list[Rule]:
    """What a member may send: kinds of messages, on which keys. All else is refused."""
    role, service = member.role, service_of(member.role)
    if role == ROUTER:
        return [(EVERYTHING, [f"{ROOT}/**"])]

    def keys(rows: Sequence[Topic | Query], who: str = "*") -> list[str]:
        return [row.key(robot, who) for robot in member.robots for row in rows]

    # A kept topic is told by services that heard it to those that come later.
    kept = [t for t in TOPICS if t.latched] if service else []
    # A replay's health is that of the services it speaks for.
    own = "*" if role == "replay" else service
    rules: list[Rule] = [
        (READ[:1], [f"{ROOT}/{robot}/**" for robot in member.robots]),
        (READ[1:], [f"{ROOT}/**"]),
        (("put",), keys([t for t in TOPICS if may_put(role, t)], own)),
        (("query",), keys([*(q for q in QUERIES if may_ask(role, q)), *kept])),
        (ANSWER, keys([*(q for q in QUERIES if may_answer(role, q)), *kept], service)),
        (
            ("liveliness_token",),
            [f"{ROOT}/{robot}/{kind}/{service}/**" for robot in member.robots for kind in ("alive", "standby")]
            if service
            else [],
        ),
    ]
    return [(messages, expressions) for messages, expressions in rules if expressions]


def router_rules(members: Sequence[Member]) -> dict[str, Any]:
    """A router's ``access_control``: by certificate and password of the same name; who is unknown gets nothing."""
    rules, policies = [], []
    for member in members:
        mine = [("ingress", *rule) for rule in rules_of(member)] + [("egress", EVERYTHING, [f"{ROOT}/**"])]
        ids = [f"{member.name}/{number}" for number in range(len(mine))]
        rules += [
            {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": expressions}
            for name, (flow, messages, expressions) in zip(ids, mine, strict=True)
        ]
        policies.append({"subjects": [member.name], "rules": ids})
    subjects = [
        # Who dials learns the other's certificate, not its user; all routers are one.
        {"id": m.name, "cert_common_names": [m.name]} | ({} if m.role == ROUTER else {"usernames": [m.name]})
        for m in members
    ]
    return _access(rules, subjects, policies)


def client_rules() -> dict[str, Any]:
    """Everybody else's: to and from routers alone, so that nobody's certificate passes for a router's."""
    rule = {
        "id": "all", "permission": "allow", "flows": ["ingress", "egress"], "messages": EVERYTHING,
        "key_exprs": [f"{ROOT}/**"],
    }  # fmt: skip
    subject = {"id": ROUTER, "cert_common_names": [ROUTER]}
    return _access([rule], [subject], [{"subjects": [ROUTER], "rules": ["all"]}])


def _access(rules: list[Any], subjects: list[Any], policies: list[Any]) -> dict[str, Any]:
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


@dataclass(frozen=True)
class Credentials:
    """A member's folder, read."""

    folder: Path
    member: Member
    password: str = field(repr=False)
    members: tuple[Member, ...] = ()  # a router's

    def zenoh(self) -> dict[str, Any]:
        """Settings of a zenoh session, by key; the rest of its configuration stays as it is, but for its mode."""
        own = {"certificate": str(self.folder / CERTIFICATE), "private_key": str(self.folder / KEY)}
        user = {"user": self.member.name, "password": self.password}
        router = self.member.role == ROUTER
        if router:
            user["dictionary_file"] = str(self.folder / PASSWORDS)
        return {
            "scouting/multicast/enabled": False,
            "transport/link/tls": {
                "root_ca_certificate": str(self.folder / AUTHORITY),
                "enable_mtls": True,
                **{f"{side}_{what}": path for side in ("listen", "connect") for what, path in own.items()},
                # The rules ask for a router's certificate by name; by which address it is reached says nothing more.
                "verify_name_on_connect": False,
                "close_link_on_expiration": True,
            },
            "transport/auth/usrpwd": user,
            "access_control": router_rules(self.members) if router else client_rules(),
        }

    def check(self, allowed: Callable[[str, Any], bool], row: Topic | Query, robot: str) -> None:
        """Raises UserError where the rules refuse it anyway: the router would do so without a word."""
        member = self.member
        if member.robots != EVERY_ROBOT and robot not in member.robots:
            raise UserError(f"{member.name!r} is for {', '.join(member.robots)}, not for robot {robot!r}")
        if member.role != ROUTER and not allowed(member.role, row):
            what, who = ("ask", row.requester_roles) if isinstance(row, Query) else ("put", row.publisher_roles or (row.publisher,))
            raise UserError(
                f"role {member.role!r} may not {what} {row.name}: "
                f"it takes one of {', '.join(who)} (--role, PRESAGE_ROLE; `presage secure show` lists all)"
            )


def credentials(folder: Path, names: Sequence[str], robot: str = "*") -> Credentials:
    """Those of the first name that the folder holds, a robot's own (NAME-ROBOT) before the common one.

    Raises UserError where there is none, or a file is missing or does not make sense.
    """
    wanted = [each for name in names for each in (f"{name}-{robot}", name)]
    for name in wanted:
        if (folder / name / IDENTITY).exists():
            return _read(folder / name)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder (--security, PRESAGE_SECURITY); `presage secure init` makes one")
    raise UserError(
        f"{folder}: no credentials of {' or '.join(map(repr, names))}, but of {', '.join(_held(folder)) or 'nobody'}:"
        " --role chooses, `presage secure add` makes more"
    )


def _held(folder: Path) -> Iterator[str]:
    return (path.parent.name for path in sorted(folder.glob(f"*/{IDENTITY}")))


def _read(folder: Path) -> Credentials:
    try:
        member = Member.model_validate_json((folder / IDENTITY).read_text(encoding="utf-8"))
        password = (folder / PASSWORD).read_text(encoding="utf-8").strip()
        files = [AUTHORITY, CERTIFICATE, KEY]
        members: tuple[Member, ...] = ()
        if member.role == ROUTER:
            members = read_members(folder)
            files.append(PASSWORDS)
        for file in files:
            with (folder / file).open("rb"):
                pass
    except OSError as error:
        raise UserError(
            f"{error.filename}: {error.strerror} (read by user {os.geteuid()}): whose are the files?"
        ) from None
    except ValidationError as error:
        raise UserError(f"{folder / IDENTITY}: {first_fault(error)}") from None
    if member.role not in (ROUTER, *ALL_ROLES):
        raise UserError(f"{folder / IDENTITY}: no role {member.role!r}; there are {', '.join(ROLES)}")
    return Credentials(folder.resolve(), member, password, members)


def read_members(folder: Path) -> tuple[Member, ...]:
    """A router's list; raises UserError where it makes no sense."""
    path = folder / MEMBERS
    try:
        return Members.model_validate_json(path.read_text(encoding="utf-8")).members
    except ValidationError as error:
        raise UserError(f"{path}: {first_fault(error)}") from None
