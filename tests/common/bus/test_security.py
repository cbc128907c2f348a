"""Rules derived from the table; credentials read from a folder."""

from __future__ import annotations

import json

import pytest
from zenoh import KeyExpr

from common.bus.endpoints import on_loopback, refuse_exposure, with_tls
from common.bus.security import (
    ROLES,
    ROUTER,
    Member,
    client_rules,
    may_answer,
    may_put,
    may_query,
    read_credentials,
    router_rules,
    rules_of,
    service_of,
)
from common.errors import UserError
from common.messages.topics import ALL_ROLES, CMD_VEL, CONTROL_ROLES, HEALTH, QUERIES, SCAN, TELEPORT, TOPICS, WORLD
from presage.session import credentials as secure


def included(key: str, expression: str) -> bool:
    """Whether an expression includes all keys of ``key``, which may be an expression too, as zenoh decides it."""
    return KeyExpr(expression).includes(KeyExpr(key))


def may_send(role: str, message: str, key: str, robots: tuple[str, ...] = ("*",)) -> bool:
    member = Member(name=role, role=role, robots=robots)
    return any(
        message in messages and any(included(key, each) for each in expressions)
        for messages, expressions in rules_of(member)
    )


def test_roles_of_topics_and_queries():
    named = {role for topic in TOPICS for role in topic.publisher_roles} | {
        role for query in QUERIES for role in query.requester_roles
    }
    assert named <= set(ROLES)
    assert set(ALL_ROLES) == set(ROLES) - {ROUTER}
    for topic in TOPICS:
        assert [role for role in ROLES if may_put(role, topic)], topic.name
    for query in QUERIES:
        assert [role for role in ROLES if may_answer(role, query)], query.name
        assert [role for role in ROLES if may_query(role, query)], query.name


def test_publishers_of_scans_and_commands():
    stands_in = {"replay"}
    assert {role for role in ROLES if may_put(role, CMD_VEL)} - stands_in == {"controller"}
    assert {role for role in ROLES if may_put(role, SCAN)} - stands_in == {"simulator", "bridge_ros2"}


def test_requests_that_need_a_control_role():
    free = {"sample", "world", "model", "predict", "config"}
    rviz = {"localise": "bridge_ros2"}  # whose "2D Pose Estimate" the bridge passes on
    others = {q.name: set(q.requester_roles) - {rviz.get(q.name)} for q in QUERIES}
    assert {name for name, roles in others.items() if roles != set(CONTROL_ROLES)} == free
    assert not {"viewer", "observer"} & set(CONTROL_ROLES)


@pytest.mark.parametrize("role", sorted(set(ROLES) - {ROUTER}))
def test_rules_for_publishing(role):
    for topic in TOPICS:
        key = topic.key("r1", service_of(role) or "other")
        assert may_send(role, "put", key) == may_put(role, topic)
        assert not may_send(role, "delete", key)
    assert not may_send(role, "put", "presage/**")
    assert not may_send(role, "put", "presage/r1/unknown")


@pytest.mark.parametrize(
    ("role", "message", "key", "allowed"),
    [
        ("estimator", "put", HEALTH.key("r1", "estimator"), True),
        ("estimator", "put", HEALTH.key("r1", "simulator"), False),
        ("viewer-control", "put", HEALTH.key("r1", "viewer"), True),
        ("estimator", "liveliness_token", "presage/r1/alive/estimator", True),
        ("estimator", "liveliness_token", "presage/r1/alive/estimator/instance", True),
        ("estimator", "liveliness_token", "presage/r1/alive/simulator", False),
        ("observer", "liveliness_token", "presage/r1/alive/estimator", False),
        ("operator", "query", TELEPORT.key("r1"), True),
        ("observer", "query", TELEPORT.key("r1"), False),
        ("observer", "query", WORLD.key("r1"), True),
        ("simulator", "declare_queryable", TELEPORT.key("r1"), True),
        ("controller", "declare_queryable", TELEPORT.key("r1"), False),
        ("controller", "reply", WORLD.key("r1"), False),
    ],
)
def test_rules_for_names_and_queries(role, message, key, allowed):
    assert may_send(role, message, key) == allowed


@pytest.mark.parametrize(
    ("message", "key"), [("put", "cmd_vel"), ("declare_subscriber", "scan"), ("liveliness_token", "alive/controller")]
)
def test_rules_for_one_robot(message, key):
    allowed = {
        robot for robot in ("one", "two", "*") if may_send("controller", message, f"presage/{robot}/{key}", ("one",))
    }
    assert allowed == {"one"}


def test_default_rules():
    members = [Member(name=role, role=role) for role in ROLES]
    for access in (router_rules(members), client_rules()):
        assert access["enabled"]
        assert access["default_permission"] == "deny"
        assert {rule["permission"] for rule in access["rules"]} == {"allow"}
    assert client_rules()["subjects"] == [{"id": "router", "cert_common_names": ["router"]}]
    subjects = {each["id"]: each for each in router_rules(members)["subjects"]}
    assert subjects["controller"] == {
        "id": "controller",
        "cert_common_names": ["controller"],
        "usernames": ["controller"],
    }


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    secure.init(folder, robots=["one"])
    return folder


def test_credentials_of_a_robot(keys):
    assert read_credentials(keys, ("controller",), "one").member.robots == ("one",)
    with pytest.raises(UserError, match="no credentials of 'controller', but of controller-one, estimator-one"):
        read_credentials(keys, ("controller",), "two")
    assert read_credentials(keys, ("missing", "observer"), "one").member.name == "observer"


def test_invalid_folders_are_explained(keys, tmp_path):
    with pytest.raises(UserError, match=r"no such folder \(--security"):
        read_credentials(tmp_path / "none", ("observer",))
    secure.init(tmp_path)
    (tmp_path / "observer" / "own.key").unlink()
    with pytest.raises(UserError, match=r"own\.key: No such file"):
        read_credentials(tmp_path, ("observer",))
    (tmp_path / "viewer" / "identity.json").write_text(json.dumps({"name": "viewer", "role": "king"}))
    with pytest.raises(UserError, match="no role 'king'"):
        read_credentials(tmp_path, ("viewer",))
    (tmp_path / "router" / "members.json").write_text("{}")
    with pytest.raises(UserError, match="members"):
        read_credentials(tmp_path, ("router",))


def test_passwords_are_not_printed(keys):
    mine = read_credentials(keys, ("observer",))
    assert mine.password not in repr(mine)


def test_missing_rights(keys):
    mine = read_credentials(keys, ("controller",), "one")
    mine.check(may_put, CMD_VEL, "one")
    with pytest.raises(UserError, match="'controller-one' is for one, not for robot 'two'"):
        mine.check(may_put, CMD_VEL, "two")
    with pytest.raises(UserError, match="may not publish scan; allowed roles: simulator"):
        mine.check(may_put, SCAN, "one")


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp/127.0.0.1:7447", True), ("tcp/127.1.2.3:0", True), ("tcp/[::1]:7447", True), ("tcp/localhost:0", True),
        ("unixsock-stream//tmp/x", True), ("tcp/0.0.0.0:0", False), ("tcp/[::]:0", False), ("tcp/10.0.0.1:1", False),
        ("udp/0.0.0.0:1", False), ("tcp/robot.lan:7447", False), ("tls/:::7447", False),
    ],
)  # fmt: skip
def test_exposed_endpoints_are_refused(endpoint, here):
    assert on_loopback(endpoint) == here
    if not here:
        with pytest.raises(UserError, match="--insecure"):
            refuse_exposure(["tcp/127.0.0.1:0", endpoint])


def test_endpoints_use_tls():
    assert with_tls("tcp/host:1") == "tls/host:1"
    assert with_tls("quic/host:1") == "quic/host:1"
