"""Encoding and decoding of messages, including invalid payloads."""

from __future__ import annotations

import contextlib
import math
import struct

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry.occupancy_grid import OccupancyGrid
from common.limits import MAX_BEAMS, MAX_COORDINATE_M, MAX_DISTANCE_M
from common.messages import definitions as messages
from common.messages.definitions import Belief, CmdVel, Goal, Map, Odom, Plan, Pose, Prediction, Scan, Status, Twist
from common.messages.requests import PredictRequest, SampleReply
from common.messages.topics import QUERIES, TOPICS
from common.messages.wire import DecodeError
from tests.common.samples import all_messages, message_of

CLASSES = [*(topic.message for topic in TOPICS), *(c for query in QUERIES for c in (query.request, query.reply))]
CLASSES = list(dict.fromkeys(CLASSES))


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_messages_are_decoded_as_encoded(cls):
    @settings(max_examples=40)
    @given(message_of(cls))
    def check(message):
        payload = message.encode()
        again = cls.decode(payload)
        assert again == message
        assert again.encode() == payload
        assert hash(again) == hash(message)

    check()


def a_scan(**changes) -> Scan:
    fields = {"stamp_ns": 7, "angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.05, "range_max": 25.0}
    return Scan(**{**fields, "ranges": np.array([1.5, np.inf, -np.inf, 0.1], np.float32), **changes})


def test_bytes_of_arrays():
    ranges = np.array([1.1, np.inf, -np.inf, 1e-45, -0.0], np.float32)
    got = Scan.decode(a_scan(ranges=ranges).encode()).ranges
    assert got.dtype == np.dtype("<f4")
    assert got.tobytes() == ranges.tobytes()
    scan = a_scan(ranges=ranges)
    for stored in (got, scan.ranges):
        with pytest.raises(ValueError, match="read-only"):
            stored[0] = 2.0
    ranges[:] = 9.0
    assert scan.ranges.tobytes() == got.tobytes()  # a copy
    packed = msgpack.unpackb(a_scan(ranges=[1.0, 2.0]).encode())["ranges"]
    assert packed == struct.pack("<2f", 1.0, 2.0)  # little-endian


def encoded_with(message, **changes) -> bytes:
    """The payload of a message after changes of its fields; `...` leaves a field out."""
    data = msgpack.unpackb(message.encode())
    for name, value in changes.items():
        if value is ...:
            del data[name]
        else:
            data[name] = value
    return msgpack.packb(data)


ODOM = Odom(stamp_ns=1, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=np.eye(3))
POSE = Pose(x=0.0, y=0.0)
BELIEF = Belief(
    stamp_ns=1, state="tracking", pose=POSE, xi=np.zeros(3), covariance=np.eye(3), free_energy=1.0, accuracy=1.0
)
MAP = Map(
    stamp_ns=1,
    grid=OccupancyGrid.of(np.zeros((1, 1), np.uint8), 0.05, (0.0, 0.0, 0.0)),
    poses=np.zeros((2, 3)),
    connected=np.array([0, 1, 1], np.uint8),
)
GOAL = Goal(stamp_ns=1, pose=Pose(x=0.0, y=0.0))
REQUEST = PredictRequest(poses=np.zeros((1, 3)))
COMMAND = CmdVel(stamp_ns=1, twist=Twist(vx=0.5))
INVALID_PAYLOADS = {
    "a missing field": encoded_with(COMMAND, twist=...),
    "a missing stamp": encoded_with(COMMAND, stamp_ns=...),
    "a negative stamp": encoded_with(COMMAND, stamp_ns=-1),
    "a stamp that is a float": encoded_with(COMMAND, stamp_ns=1.0),
    "a stamp that is a bool": encoded_with(COMMAND, stamp_ns=True),
    "a stamp of 64 bits": encoded_with(COMMAND, stamp_ns=2**64 - 1),
    "NaN as velocity": encoded_with(COMMAND, twist={"vx": math.nan, "vy": 0.0, "wz": 0.0}),
    "infinity as velocity": encoded_with(COMMAND, twist={"vx": math.inf, "vy": 0.0, "wz": 0.0}),
    "text as velocity": encoded_with(COMMAND, twist={"vx": "1", "vy": 0.0, "wz": 0.0}),
    "None as velocity": encoded_with(COMMAND, twist={"vx": None, "vy": 0.0, "wz": 0.0}),
    "a list for a map": encoded_with(COMMAND, twist=[0.0, 0.0, 0.0]),
    "no map at all": msgpack.packb([1, 2, 3]),
    "nil": msgpack.packb(None),
    "keys that are numbers": msgpack.packb({1: 2}),
    "two messages": COMMAND.encode() * 2,
    "half a message": COMMAND.encode()[:-5],
    "nothing": b"",
    "text that is no UTF-8": msgpack.packb({"stamp_ns": 1}) + b"\xa3\xff\xff\xff",
    "broken UTF-8 in a name": b"\x81\xa3\xff\xfe\xfd\x01",
    "deep nesting": b"\x91" * 100_000 + b"\xc0",
    "a deep map": b"\x81\xa1a" * 100_000 + b"\xc0",
    "four gigabytes announced": b"\xc6\xff\xff\xff\xff",
    "four billion elements announced": b"\xdd\xff\xff\xff\xff",
    "four billion entries announced": b"\xdf\xff\xff\xff\xff",
    "an extension type": b"\xc7\x04\x05abcd",
    "a time stamp": b"\xd6\xff\x00\x00\x00\x00",
    "an impossible time stamp": b"\xc7\x0c\xff" + b"\xff" * 12,
    "a reserved byte": b"\xc1",
}
INVALID_VALUES = {
    "bytes that are no whole number": (Scan, encoded_with(a_scan(), ranges=b"12345")),
    "NaN in a scan": (Scan, encoded_with(a_scan(), ranges=np.float32([1, np.nan]).tobytes())),
    "a list for an array": (Scan, encoded_with(a_scan(), ranges=[1.0, 2.0])),
    "text for an array": (Scan, encoded_with(a_scan(), ranges="1234")),
    "infinity in a covariance": (Odom, encoded_with(ODOM, covariance=np.full((3, 3), np.inf).tobytes())),
    "rows of the wrong length": (Odom, encoded_with(ODOM, covariance=np.zeros(4).tobytes())),
    "a gradient of four": (Belief, encoded_with(BELIEF, xi=np.zeros(4, np.float32).tobytes())),
    "a protection level of two": (Belief, encoded_with(BELIEF, protection=np.zeros(2, np.float32).tobytes())),
    "a probability above one": (Belief, encoded_with(BELIEF, probability=1.5)),
    "a covariance of two rows": (Belief, encoded_with(BELIEF, covariance=np.zeros((2, 3)).tobytes())),
    "a negative variance": (Belief, encoded_with(BELIEF, covariance=np.diag([1.0, 1.0, -1.0]).tobytes())),
    "a covariance that is not symmetric": (Belief, encoded_with(BELIEF, covariance=np.triu(np.ones((3, 3))).tobytes())),
    "an unknown state": (Belief, encoded_with(BELIEF, state="asleep")),
    "a range_max of nought": (Scan, encoded_with(a_scan(), range_max=0.0)),
    "a negative range_min": (Scan, encoded_with(a_scan(), range_min=-0.1)),
    "a scan without beams": (Scan, encoded_with(a_scan(), ranges=b"")),
    "a scan of one beam": (Scan, encoded_with(a_scan(), ranges=np.float32([1.0]).tobytes())),
    "beams in one direction": (Scan, encoded_with(a_scan(), angle_increment=0.0)),
    "a scan of more beams than any scanner has": (Scan, encoded_with(a_scan(), ranges=bytes(4 * (MAX_BEAMS + 1)))),
    "a range of a million kilometres": (Scan, encoded_with(a_scan(), ranges=np.float32([1, 1e9]).tobytes())),
    "an absurd range_max": (Scan, encoded_with(a_scan(), range_max=1e300)),
    "an absurd sigma": (Scan, encoded_with(a_scan(), sigma=1e308)),
    "an absurd angle": (Scan, encoded_with(a_scan(), angle_increment=1e300)),
    "a scanner mounted outside the solar system": (
        Scan,
        encoded_with(a_scan(), mount={"x": 1e300, "y": 0.0, "yaw": 0.0}),
    ),
    "a goal beyond all maps": (Goal, encoded_with(GOAL, pose={"x": 0.0, "y": -1e300, "yaw": 0.0})),
    "a goal's absurd heading": (Goal, encoded_with(GOAL, pose={"x": 0.0, "y": 0.0, "yaw": 1e300})),
    "a goal's absurd tolerance": (Goal, encoded_with(GOAL, tolerance=1e300)),
    "an absurd velocity": (Odom, encoded_with(ODOM, twist={"vx": 1e300})),
    "a path beyond all maps": (Plan, encoded_with(Plan(stamp_ns=1), path=np.float32([0, 1e20]).tobytes())),
    "poses beyond all maps": (PredictRequest, encoded_with(REQUEST, poses=np.full(3, 1e300).tobytes())),
    "more poses than connected key scans": (Map, encoded_with(MAP, connected=b"\0\1\0")),
    "a name without end": (Scan, encoded_with(a_scan(), frame_id="x" * 201)),
}


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_invalid_payloads(cls):
    errors = []
    for payload in INVALID_PAYLOADS.values():
        try:
            cls.decode(payload)
        except DecodeError as error:
            errors.append(str(error))
    assert all(cls.__name__ in error and "\n" not in error for error in errors)


def test_invalid_values_are_refused():
    cases = {**{what: (CmdVel, payload) for what, payload in INVALID_PAYLOADS.items()}, **INVALID_VALUES}
    accepted = []
    for what, (cls, payload) in cases.items():
        with contextlib.suppress(DecodeError):
            cls.decode(payload)
            accepted.append(what)
    assert not accepted


def test_values_at_the_limits_are_accepted():
    far = Pose(x=-MAX_COORDINATE_M, y=MAX_COORDINATE_M, yaw=7.0)
    assert Goal.decode(Goal(stamp_ns=1, pose=far).encode()).pose == far
    ranges = np.full(MAX_BEAMS, MAX_DISTANCE_M, np.float32)
    scan = a_scan(ranges=ranges, range_max=MAX_DISTANCE_M, sigma=MAX_DISTANCE_M)
    assert Scan.decode(scan.encode()) == scan
    from_corner_to_corner = Status(stamp_ns=1, state="idle", distance=float(np.hypot(*(far.array() * 2)[:2])))
    assert Status.decode(from_corner_to_corner.encode()) == from_corner_to_corner


def test_the_error_names_the_field():
    with pytest.raises(DecodeError, match=r"CmdVel\.twist\.vx: .*finite"):
        CmdVel.decode(INVALID_PAYLOADS["NaN as velocity"])
    with pytest.raises(DecodeError, match=r"Scan\.ranges: .*1 values are NaN"):
        Scan.decode(INVALID_VALUES["NaN in a scan"][1])
    with pytest.raises(DecodeError, match=rf"Scan\.ranges: .*{MAX_BEAMS + 1} values are more than {MAX_BEAMS}"):
        Scan.decode(INVALID_VALUES["a scan of more beams than any scanner has"][1])
    with pytest.raises(DecodeError, match=r"Goal\.pose\.y: .*greater than or equal to -10000"):
        Goal.decode(INVALID_VALUES["a goal beyond all maps"][1])


def test_numbers_of_key_scans():
    assert Map.decode(MAP.encode()).numbers.tolist() == [1, 2]
    recorded_before = Map.decode(encoded_with(MAP, connected=...))
    assert recorded_before.numbers.tolist() == [0, 1]


def test_unknown_and_missing_fields():
    assert CmdVel.decode(encoded_with(COMMAND, colour="red")) == COMMAND
    assert Scan.decode(encoded_with(a_scan(), scan_time=..., time_increment=..., mount=..., seq=...)) == a_scan()


@settings(max_examples=600)
@given(st.sampled_from(CLASSES), st.binary(max_size=200))
def test_random_bytes(cls, payload):
    with contextlib.suppress(DecodeError):
        cls.decode(payload)


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=30),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=300)
@given(all_messages(), st.data())
def test_one_field_replaced_by_any_value(message, data):
    fields = msgpack.unpackb(message.encode())
    if fields:
        fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(values)
    try:
        again = type(message).decode(msgpack.packb(fields))
    except DecodeError:
        return
    type(message).decode(again.encode())  # what was accepted is a whole message


@settings(max_examples=300)
@given(all_messages(), st.data())
def test_truncated_or_changed_bytes(message, data):
    payload = bytearray(message.encode())
    at = data.draw(st.integers(0, len(payload) - 1))
    if data.draw(st.booleans()):
        with pytest.raises(DecodeError):
            type(message).decode(bytes(payload[:at]))
    else:
        payload[at] ^= 1 << data.draw(st.integers(0, 7))
        with contextlib.suppress(DecodeError):
            type(message).decode(bytes(payload))


def test_equality():
    assert a_scan() == a_scan()
    assert a_scan() != a_scan(seq=1)
    assert Pose(x=0.0, y=0.0) != Twist()
    assert len({a_scan(), a_scan(), a_scan(seq=1)}) == 2


def test_empty_arrays_are_valid():
    reply = SampleReply(ok=False, reason="no")
    assert SampleReply.decode(reply.encode()).ranges.shape == (0,)
    assert Prediction.decode(
        Prediction(stamp_ns=0, angle_min=0.0, angle_increment=0.1, ranges=np.zeros(0)).encode()
    ).sigma.shape == (0,)


def test_every_message_class_is_tested():
    stamped = {c for c in vars(messages).values() if isinstance(c, type) and issubclass(c, messages.Stamped)}
    assert stamped - {messages.Stamped} == {topic.message for topic in TOPICS}
