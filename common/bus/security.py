"""Roles, access rules derived from the table of topics, and credentials.

In secure mode every session but the router's is a zenoh client: all messages go through routers, which check the
certificate, the password and, for each message, the role. docs/security.md explains what that protects and what not.
"""

from __future__ import annotations

import getpass
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from common.errors import UserError, first_fault
from common.messages.topics import ALL_ROLES, QUERIES, ROOT, TOPICS, Query, Topic

ROUTER = "router"
IDENTITY, AUTHORITY, CERTIFICATE, KEY, PASSWORD = "identity.json", "ca.crt", "own.crt", "own.key", "password"
MEMBERS, PASSWORDS = "members.json", "passwords"  # only in the router's folder
# Names have no dot: public authorities certify only names with dots, so their certificates match no member.
NAME = r"^[a-z0-9][a-z0-9_-]{0,62}$"
ROLES: dict[str, str] = {
    ROUTER: "forwards what the others may send; can read and send everything",
    "simulator": "the simulated robot: scanner, odometry, wheels",
    "bridge_ros2": "a robot in ROS 2 and its rviz: scanner, odometry, wheels, goals",
    "estimator": "estimates where the robot is",
    "mapper": "maps while the robot is driven, in place of the estimator",
    "controller": "drives the robot",
    "recorder": "reads and records everything",
    "viewer": "the live page, read-only",
    "viewer-control": "the live page, whose visitors may drive",
    "operator": "people and tools that may drive, teleport, reset, record",
    "observer": "people and tools that only read",
    "remote": "reports whether scans of a robot outside Docker Compose arrive",
    "replay": "publishes a recording in place of the robot's services",
}
EVERY_ROBOT = ("*",)
# Kinds of zenoh messages.
SUBSCRIBE = ("declare_subscriber",)
WATCH_LIVELINESS = ("liveliness_query", "declare_liveliness_subscriber")
ANSWER = ("declare_queryable", "reply")
EVERYTHING = (*SUBSCRIBE, *WATCH_LIVELINESS, *ANSWER, "put", "delete", "query", "liveliness_token")
Rule = tuple[tuple[str, ...], list[str]]  # kinds of zenoh messages, key expressions


class Member(BaseModel):
    """A holder of credentials, named as in the certificate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    role: str
    robots: tuple[str, ...] = EVERY_ROBOT  # robots whose keys it may use


class Members(BaseModel):
    """All members that a router accepts; others have no rights, even with a valid certificate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    members: tuple[Member, ...]


def service_of(role: str) -> str:
    """Name of the service that has the role, as used in keys; empty for people, tools and the router."""
    return "" if role in {ROUTER, "operator", "observer"} else role.removesuffix("-control")


def may_put(role: str, topic: Topic) -> bool:
    """Whether the role may publish the topic."""
    if topic.per_service:
        return bool(service_of(role))
    return role in (topic.publisher_roles or (topic.publisher,)) or (role == "replay" and topic.recorded)


def may_query(role: str, query: Query) -> bool:
    """Whether the role may send requests of the query."""
    return role in query.requester_roles


def may_answer(role: str, query: Query) -> bool:
    """Whether the role may serve the query; a replay may serve the world of its recording."""
    if query.per_service:
        return bool(service_of(role))
    return role == query.server or (role == "replay" and query.name == "world")


def rules_of(member: Member) -> list[Rule]:
    """Rules of what a member may send: kinds of messages and on which keys. Everything else is refused."""
    role, service = member.role, service_of(member.role)
    if role == ROUTER:
        return [(EVERYTHING, [f"{ROOT}/**"])]

    def keys(rows: Sequence[Topic | Query], service_name: str = "*") -> list[str]:
        return [row.key(robot, service_name) for robot in member.robots for row in rows]

    # Services store latched topics and serve them to services that start later.
    latched = [t for t in TOPICS if t.latched] if service else []
    # A replay publishes the health of all recorded services.
    own = "*" if role == "replay" else service
    rules: list[Rule] = [
        (SUBSCRIBE, [f"{ROOT}/{robot}/**" for robot in member.robots]),
        (WATCH_LIVELINESS, [f"{ROOT}/**"]),
        (("put",), keys([t for t in TOPICS if may_put(role, t)], own)),
        (("query",), keys([*(q for q in QUERIES if may_query(role, q)), *latched])),
        (ANSWER, keys([*(q for q in QUERIES if may_answer(role, q)), *latched], service)),
        (
            ("liveliness_token",),
            [f"{ROOT}/{robot}/{kind}/{service}/**" for robot in member.robots for kind in ("alive", "standby")]
            if service
            else [],
        ),
    ]
    return [(messages, expressions) for messages, expressions in rules if expressions]


def router_rules(members: Sequence[Member]) -> dict[str, Any]:
    """A router's setting ``access_control``: rights by the name that certificate and password share."""
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
        # A router that connects to another learns its certificate but not its user name.
        {"id": m.name, "cert_common_names": [m.name]} | ({} if m.role == ROUTER else {"usernames": [m.name]})
        for m in members
    ]
    return _access(rules, subjects, policies)


def client_rules() -> dict[str, Any]:
    """The setting ``access_control`` of all other sessions: exchange messages only with routers.

    Otherwise, a member could use its certificate to act as a router.
    """
    rule = {
        "id": "all",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": EVERYTHING,
        "key_exprs": [f"{ROOT}/**"],
    }
    subject = {"id": ROUTER, "cert_common_names": [ROUTER]}
    return _access([rule], [subject], [{"subjects": [ROUTER], "rules": ["all"]}])


def _access(rules: list[Any], subjects: list[Any], policies: list[Any]) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


@dataclass(frozen=True)
class Credentials:
    """Credentials of a member, read from its folder."""

    folder: Path
    member: Member
    password: str = field(repr=False)
    members: tuple[Member, ...] = ()  # of a router: the members it accepts

    def zenoh(self) -> dict[str, Any]:
        """Settings to add to the configuration of a zenoh session, by key; the mode is set by the caller."""
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
                # The access rules check a router's certificate by its name, so its address need not match.
                "verify_name_on_connect": False,
                "close_link_on_expiration": True,
            },
            "transport/auth/usrpwd": user,
            "access_control": router_rules(self.members) if router else client_rules(),
        }

    def check(self, allowed: Callable[[str, Any], bool], row: Topic | Query, robot: str) -> None:
        """Raises UserError if the role may not use a topic or query, which the router would drop silently."""
        member = self.member
        if member.robots != EVERY_ROBOT and robot not in member.robots:
            raise UserError(f"{member.name!r} is for {', '.join(member.robots)}, not for robot {robot!r}")
        if member.role != ROUTER and not allowed(member.role, row):
            if isinstance(row, Query):
                verb, roles = "query", row.requester_roles
            else:
                verb, roles = "publish", row.publisher_roles or (row.publisher,)
            raise UserError(
                f"role {member.role!r} may not {verb} {row.name}; allowed roles: {', '.join(roles)} "
                "(--role, PRESAGE_ROLE; `presage secure show` lists all)"
            )


def read_credentials(folder: Path, names: Sequence[str], robot: str = "*") -> Credentials:
    """Reads the credentials of the first of ``names`` that the folder contains.

    Credentials for one robot (NAME-ROBOT) are preferred to those for all robots. Raises UserError if there are none, or
    if a file is missing or invalid.
    """
    wanted = [each for name in names for each in (f"{name}-{robot}", name)]
    for name in wanted:
        if (folder / name / IDENTITY).exists():
            return _read(folder / name)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder (--security, PRESAGE_SECURITY); `presage secure init` creates one")
    raise UserError(
        f"{folder}: no credentials of {' or '.join(map(repr, names))}, "
        f"but of {', '.join(_stored(folder)) or 'no member'}: "
        "choose some with --role, or create more with `presage secure add`"
    )


def _stored(folder: Path) -> Iterator[str]:
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
        if sys.platform == "win32":
            user = getpass.getuser()
        else:
            user = str(os.geteuid())  # a container's user may have no name
        raise UserError(
            f"{error.filename}: {error.strerror} (read by user {user}): check the files' owner and permissions"
        ) from None
    except ValidationError as error:
        raise UserError(f"{folder / IDENTITY}: {first_fault(error)}") from None
    if member.role not in (ROUTER, *ALL_ROLES):
        raise UserError(f"{folder / IDENTITY}: no role {member.role!r}; the roles are {', '.join(ROLES)}")
    return Credentials(folder.resolve(), member, password, members)


def read_members(folder: Path) -> tuple[Member, ...]:
    """The members that a router accepts; raises UserError if the file is invalid."""
    path = folder / MEMBERS
    try:
        return Members.model_validate_json(path.read_text(encoding="utf-8")).members
    except ValidationError as error:
        raise UserError(f"{path}: {first_fault(error)}") from None
