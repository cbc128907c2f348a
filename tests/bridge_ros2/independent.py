"""ROS 2 messages encoded by Foxglove's CDR library, independent of the bridge, from the published definitions."""

from __future__ import annotations

from functools import cache

from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_typestore


@cache
def _definition(name: str) -> str:
    """The .msg text with all referenced types. test_ros_types.py compares its hash with the published one."""
    return get_typestore(Stores.ROS2_JAZZY).generate_msgdef(name, ros_version=2)[0]


@cache
def _codec(name: str):
    short = name.replace("/msg/", "/")
    text = _definition(name)
    encoders, decoders = serialize_dynamic(short, text), generate_dynamic(short, text)
    return encoders.get(short) or encoders[name], decoders.get(short) or decoders[name]


def encode(name: str, message: dict) -> bytes:
    """Encodes a message given as dictionaries to CDR."""
    return bytes(_codec(name)[0](message))


def decode(name: str, payload: bytes):
    """Decodes CDR to a message with attributes."""
    return _codec(name)[1](payload)


def header(stamp_ns: int, frame: str) -> dict:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict:
    return {"x": float(x), "y": float(y), "z": float(z)}


def quaternion(x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0) -> dict:
    return {"x": float(x), "y": float(y), "z": float(z), "w": float(w)}
