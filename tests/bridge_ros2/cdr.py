"""ROS 2 messages encoded by Foxglove's CDR library, independent of the bridge, from the published definitions."""

from __future__ import annotations

import math
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


def laser_scan(stamp_ns: int, ranges: list[float], frame: str = "laser", **fields: float) -> bytes:
    """An encoded LaserScan; by default of five beams from -1 to 1 rad."""
    defaults = {
        "angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.5, "time_increment": 0.0, "scan_time": 0.1,
        "range_min": 0.1, "range_max": 10.0, "ranges": ranges, "intensities": [],
    }  # fmt: skip
    return encode("sensor_msgs/msg/LaserScan", {"header": header(stamp_ns, frame), **defaults, **fields})


def odometry(
    stamp_ns: int, pose: dict, twist: tuple[float, float, float], child: str = "base_link", covariance=(0.0,) * 36
) -> bytes:
    """An encoded Odometry; ``pose`` as of `planar_pose`, ``twist`` is vx, vy and wz in the child frame."""
    velocity = {"linear": vector(*twist[:2]), "angular": vector(z=twist[2])}
    six = list(covariance)
    message = {"pose": {"pose": pose, "covariance": six}, "twist": {"twist": velocity, "covariance": six}}
    return encode("nav_msgs/msg/Odometry", {"header": header(stamp_ns, "odom"), "child_frame_id": child, **message})


def planar_pose(x: float, y: float, yaw: float = 0.0) -> dict:
    return {"position": vector(x, y), "orientation": quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))}


def pose_stamped(pose: dict, frame: str) -> bytes:
    return encode("geometry_msgs/msg/PoseStamped", {"header": header(0, frame), "pose": pose})
