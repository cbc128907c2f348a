"""Keys of ROS 2 topics in rmw_zenoh and zenoh-bridge-ros2dds.

rmw_zenoh_cpp (github.com/ros2/rmw_zenoh: docs/design.md, liveliness_utils.cpp, attachment_helpers.cpp) publishes data
on ``<domain>/<topic>/<type>/<hash>``. Each node, publisher and subscription declares a liveliness token, from which the
other nodes know the graph. Each message has an attachment of 33 bytes (in Jazzy from 0.2.4 on). Humble has no type
hashes.

zenoh-bridge-ros2dds publishes data on the topic's plain name, without attachments, and has its own tokens.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

import xxhash

from services.bridge_ros2.ros_types import NO_HASH, dds_name, ros_name, type_hash

Flavor = Literal["rmw_zenoh", "ros2dds"]
Kind = Literal["NN", "MP", "MS"]  # node, publisher, subscription
TOPIC_NAME = r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
DEFAULT_DEPTH = 42  # rmw_zenoh's default history depth (qos.cpp)
# Tokens of every flavour and domain, to explain which nodes exist if no messages arrive: first those of
# zenoh-bridge-ros2dds, then those of rmw_zenoh and of zenoh-bridge-ros2dds before 1.0.
TOKEN_KEYS = ("@/*/@ros2_lv/**", "@ros2_lv/**")
ATTACHMENT = struct.Struct("<qqB16s")  # sequence number, wall time in ns, length of the gid, gid
# The attachment of the first versions for Jazzy, with named fields.
LEGACY_ATTACHMENT = re.compile(
    rb"\x0fsequence_number(.{8})\x10source_timestamp(.{8})\x0asource_gid\x10(.{16})", re.DOTALL
)


@dataclass(frozen=True)
class Qos:
    """Quality of service: the policies that the bridge uses."""

    reliable: bool = True
    transient_local: bool = False  # late subscribers get the last ``depth`` messages
    depth: int = 10

    def text(self) -> str:
        """Encodes the policies as in tokens: numbers of rmw/types.h, or nothing for rmw_zenoh's defaults."""
        reliability, durability = "" if self.reliable else "2", "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{'' if self.depth == DEFAULT_DEPTH else self.depth}:,:,:,,"


SENSOR_QOS = Qos(reliable=False, depth=5)
LATEST_QOS = Qos(depth=1)
TF_QOS = Qos(depth=100)
TF_STATIC_QOS = Qos(transient_local=True, depth=100)
LATCHED_QOS = Qos(transient_local=True, depth=1)


def full_name(topic: str, namespace: str) -> str:
    """A topic's absolute name. A relative name is resolved in the namespace."""
    return topic if topic.startswith("/") else f"{clean_namespace(namespace).rstrip('/')}/{topic}"


def clean_namespace(namespace: str) -> str:
    """The namespace with one leading slash and no trailing one. The empty namespace is ``/``."""
    return "/" + namespace.strip("/")


@dataclass(frozen=True)
class RosKeys:
    """Zenoh keys of one flavour and ROS domain."""

    flavor: Flavor = "rmw_zenoh"
    domain: int = 0
    hashes: bool = True  # types have hashes; False for Humble

    def hash_of(self, kind: str) -> str:
        """The type's hash, or Humble's placeholder for it."""
        return type_hash(kind) if self.hashes else NO_HASH

    def publish(self, topic: str, kind: str) -> str:
        """Key on which messages of type ``kind`` are published."""
        stem = topic.strip("/")
        if self.flavor == "ros2dds":
            return stem
        return f"{self.domain}/{stem}/{dds_name(kind)}/{self.hash_of(kind)}"

    def subscribe(self, topic: str, kind: str) -> str:
        """Key expression to subscribe to. It matches any hash, so that another definition of the type is noticed."""
        stem = topic.strip("/")
        return stem if self.flavor == "ros2dds" else f"{self.domain}/{stem}/{dds_name(kind)}/*"

    def check_type_hash(self, key: str, kind: str) -> None:
        """Raises ValueError if the type hash in a received ``key`` belongs to another definition of the type."""
        received = key.rsplit("/", 1)[-1]
        if self.flavor == "rmw_zenoh" and received not in (type_hash(kind), NO_HASH):
            raise ValueError(f"its {kind} has the type hash {received}, not {type_hash(kind)}: another definition")

    def matches(self, endpoint: RosEndpoint) -> bool:
        """Whether an endpoint has this flavour and domain, so that it can exchange messages with the bridge."""
        return endpoint.flavor == self.flavor and endpoint.domain in (None, self.domain)

    def caches(self, topic: str) -> tuple[str, ...]:
        """Keys on which zenoh-bridge-ros2dds answers queries for the latched messages of a topic."""
        stem = topic.strip("/")
        return f"@/*/@ros2_pub_cache/{stem}", f"@ros2_pub_cache/*/{stem}"


def mangle(name: str) -> str:
    """Encodes a name as one chunk of a key."""
    return name.replace("/", "%")


@dataclass(frozen=True)
class BridgeNode:
    """The bridge as a node of rmw_zenoh."""

    keys: RosKeys
    zid: str  # the zenoh session's id
    namespace: str
    name: str

    def token(self) -> str:
        """The node's liveliness token."""
        return self._token("NN", 0)

    def endpoint_token(self, kind: Kind, number: int, topic: str, message: str, qos: Qos) -> str:
        """Token of a publisher or subscription. ``number`` must be unique in the node."""
        rest = (mangle(topic), dds_name(message), self.keys.hash_of(message), qos.text())
        return "/".join([self._token(kind, number), *rest])

    def _token(self, kind: Kind, number: int) -> str:
        enclave, namespace = "%", mangle(clean_namespace(self.namespace))
        return f"@ros2_lv/{self.keys.domain}/{self.zid}/0/{number}/{kind}/{enclave}/{namespace}/{self.name}"


def publisher_gid(token: str) -> bytes:
    """The 16-byte gid of the publisher with this token: its 128-bit XXH3 hash, the lower half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """The attachment that rmw_zenoh needs with each message.

    rmw_zenoh drops a message without it, and crashes on an attachment that it cannot read.
    """
    return ATTACHMENT.pack(sequence, stamp_ns, len(gid), gid)


def read_attachment(data: bytes) -> tuple[int, int, bytes] | None:
    """Sequence number, wall time in ns and gid of an attachment. Returns None if it is invalid.

    Also reads the format of the first versions for Jazzy, with named fields.
    """
    if match := LEGACY_ATTACHMENT.fullmatch(data):
        return (*struct.unpack("<qq", match[1] + match[2]), match[3])
    if len(data) != ATTACHMENT.size or data[16] != 16:
        return None
    sequence, stamp_ns, _, gid = ATTACHMENT.unpack(data)
    return sequence, stamp_ns, gid


@dataclass(frozen=True)
class RosEndpoint:
    """A publisher or subscription of another node."""

    publishes: bool
    topic: str  # absolute
    kind: str  # message type, as package/msg/Name
    hash: str = ""
    node: str = ""  # absolute name; unknown for zenoh-bridge-ros2dds
    flavor: Flavor = "rmw_zenoh"
    domain: int | None = None  # unknown for zenoh-bridge-ros2dds


def read_token(key: str) -> RosEndpoint | None:
    """Parses the token of a publisher or subscription, of either flavour. Returns None for any other key."""
    parts = key.split("/")
    if parts[0] == "@ros2_lv" and len(parts) >= 13 and parts[5] in ("MP", "MS"):
        namespace, name, topic, kind, digest = (part.replace("%", "/") for part in parts[7:12])
        domain = int(parts[1]) if re.fullmatch(r"[0-9]{1,3}", parts[1]) else None
        node = f"{namespace.rstrip('/')}/{name}"
        return RosEndpoint(parts[5] == "MP", topic, ros_name(kind), digest, node, domain=domain)
    where = parts.index("@ros2_lv") if "@ros2_lv" in parts else -1
    rest = parts[where + (1 if where == 2 else 2) :] if where in (0, 2) else []
    if len(rest) >= 3 and rest[0] in ("MP", "MS"):
        topic, kind = (part.replace("§", "/") for part in rest[1:3])
        return RosEndpoint(rest[0] == "MP", "/" + topic.strip("/"), kind, flavor="ros2dds")
    return None
