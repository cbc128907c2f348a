"""Methods of the messages, and JSON schemas compared with encoded messages."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings

from common.messages.definitions import Belief, BeliefHypothesis, Pose, Scan, Stamped, Twist
from common.messages.topics import QUERIES, TOPICS
from tests.common.samples import all_messages

CLASSES = list(
    dict.fromkeys([*(t.message for t in TOPICS), *(c for query in QUERIES for c in (query.request, query.reply))])
)
JSON_TYPES = {
    bool: "boolean", int: "integer", float: "number", str: "string", bytes: "string", list: "array", dict: "object",
    type(None): "null",
}  # fmt: skip


def allowed(schema: dict, root: dict) -> list[dict]:
    """The alternatives of a schema, with references resolved."""
    if "$ref" in schema:
        return allowed(root["$defs"][schema["$ref"].rsplit("/", 1)[-1]], root)
    if "anyOf" in schema:
        return [a for option in schema["anyOf"] for a in allowed(option, root)]
    return [schema]


def check(value, schema: dict, root: dict, where: str) -> None:
    """Checks the part of JSON schema that messages use; bytes match a string with ``contentEncoding: binary``."""
    kind = JSON_TYPES[type(value)]
    options = allowed(schema, root)
    fitting = [o for o in options if o.get("type") in (kind, None) or (kind == "integer" and o.get("type") == "number")]
    assert fitting, f"{where}: {kind} is none of {options}"
    assert isinstance(value, bytes) == any(o.get("contentEncoding") == "binary" for o in fitting), where
    schema = fitting[0]
    if "enum" in schema:
        assert value in schema["enum"], where
    if kind == "object" and "properties" in schema:
        assert value.keys() >= set(schema.get("required", ())), where
        assert value.keys() <= schema["properties"].keys(), f"{where}: fields the schema does not know"
        for name, part in value.items():
            check(part, schema["properties"][name], root, f"{where}.{name}")
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        for name, part in value.items():
            check(part, schema["additionalProperties"], root, f"{where}.{name}")
    if kind == "array" and "items" in schema:
        for i, part in enumerate(value):
            check(part, schema["items"], root, f"{where}[{i}]")


@settings(max_examples=300)
@given(all_messages())
def test_encoded_messages_match_their_schema(message):
    schema = type(message).json_schema()
    check(msgpack.unpackb(message.encode()), schema, schema, type(message).__name__)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_schemas(cls):
    schema = cls.json_schema()
    assert schema["type"] == "object"
    assert schema.get("properties", {}).keys() == cls.model_fields.keys()
    for part in schema.get("properties", {}).values():
        for option in allowed(part, schema):
            if option.get("contentEncoding") == "binary":
                assert option["x-dtype"] in ("<f4", "<f8", "u1")
                assert option["x-shape"][0] == "N"


@pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.name)
def test_stamp_and_sequence(topic):
    assert issubclass(topic.message, Stamped)
    assert list(topic.message.model_fields)[:2] == ["stamp_ns", "seq"]


def test_poses_and_twists_convert_to_arrays():
    assert Pose.of([1, 2, 3]).array().tolist() == [1.0, 2.0, 3.0]
    assert Twist(vx=1.0, wz=-1.0).array().tolist() == [1.0, 0.0, -1.0]
    with pytest.raises(ValueError, match="finite"):
        Pose.of([1, 2, np.nan])


def test_beam_angles_follow_laserscan():
    scan = Scan(stamp_ns=0, angle_min=-1.0, angle_increment=0.25, range_min=0.0, range_max=9.0, ranges=np.ones(5))
    assert scan.angles().tolist() == [-1.0, -0.75, -0.5, -0.25, 0.0]


@pytest.mark.parametrize(
    ("covariance", "problem"),
    [
        (-np.eye(3), "not positive semidefinite"),
        ([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "not positive semidefinite"),
        (np.diag([1.0, 1.0, -1e-12]), "not positive semidefinite"),
        (np.triu(np.ones((3, 3))), "not symmetric"),
        (np.eye(2, 3), r"shape \(2, 3\)"),
    ],
)
def test_invalid_covariances(covariance, problem):
    """The controller's arithmetic ends in NaN with a negative variance."""
    with pytest.raises(ValueError, match=problem):
        Belief(stamp_ns=0, state="tracking", pose=Pose(x=0.0, y=0.0), covariance=covariance)
    with pytest.raises(ValueError, match=problem):
        BeliefHypothesis(pose=Pose(x=0.0, y=0.0), covariance=covariance, weight=1.0)


def test_rounded_covariances():
    """Covariances of single precision are valid, also if one deviation is 0 or far smaller than another."""
    for deviation in ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1e6, 1e-6, 1e-3], [1e150, 1e150, 1e150]):
        turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
        factor = turn @ np.diag(deviation)
        covariance = factor @ factor.T * np.random.default_rng(2).uniform(1 - 1e-7, 1 + 1e-7, (3, 3))
        assert BeliefHypothesis(pose=Pose(x=0.0, y=0.0), covariance=covariance, weight=1.0).covariance is not None
