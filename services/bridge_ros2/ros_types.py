"""CDR encoding and type hashes of ROS 2 messages.

The types used here have had the same fields in every distribution from Humble on, so one table serves all.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

from rosbags.typesys import Stores, get_typestore

LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TF_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
TWIST: Final = "geometry_msgs/msg/Twist"
TWIST_STAMPED: Final = "geometry_msgs/msg/TwistStamped"
POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_ARRAY: Final = "geometry_msgs/msg/PoseArray"
OCCUPANCY_GRID: Final = "nav_msgs/msg/OccupancyGrid"
USED: Final = (
    LASER_SCAN,
    ODOMETRY,
    TF_MESSAGE,
    TWIST,
    TWIST_STAMPED,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    POSE_ARRAY,
    OCCUPANCY_GRID,
)
NO_HASH: Final = "TypeHashNotSupported"  # placeholder of Humble, which has no type hashes

_STORE = get_typestore(Stores.ROS2_HUMBLE)


class CdrError(ValueError):
    """Bytes that are not a valid CDR message of the expected type."""


@cache
def type_hash(name: str) -> str:
    """RIHS01 hash of a type (REP-2016), which rmw_zenoh has in its keys from Iron on."""
    return str(_STORE.hash_rihs01(name))


def dds_name(name: str) -> str:
    """Name of the type ``a/msg/B`` in DDS and rmw_zenoh: ``a::msg::dds_::B_``."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_name(dds: str) -> str:
    """Inverse of `dds_name`. Any other name is returned unchanged."""
    parts = dds.split("::")
    return "/".join([*parts[:-2], parts[-1].removesuffix("_")]) if parts[-2:-1] == ["dds_"] else dds


def make(name: str, **fields: Any) -> Any:
    """Creates a message. Every field must be given."""
    return _STORE.types[name](**fields)


def encode(name: str, message: Any) -> bytes:
    """Encodes a message as little-endian CDR, with the four bytes of its encapsulation header."""
    return bytes(_STORE.serialize_cdr(message, name))


def decode(name: str, payload: bytes) -> Any:
    """Decodes a message. Raises CdrError if the bytes are invalid."""
    if len(payload) < 4 or payload[0] != 0 or payload[1] not in (0, 1):
        raise CdrError(f"{name}: {len(payload)} bytes without the header of plain CDR")
    try:
        return _STORE.deserialize_cdr(payload, name)
    except Exception as error:  # noqa: BLE001 - the library raises any error on invalid bytes
        raise CdrError(f"{name}: {len(payload)} bytes that cannot be decoded ({type(error).__name__})") from None


def header(stamp_ns: int, frame: str) -> Any:
    """A std_msgs/Header."""
    time = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame)
