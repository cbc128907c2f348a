"""Keys of ROS 2 topics in rmw_zenoh and zenoh-bridge-ros2dds.

rmw_zenoh_cpp (github.com/ros2/rmw_zenoh: docs/design.md, liveliness_utils.cpp, attachment_helpers.cpp): data on
 ``<domain>/<topic>/<type>/<hash>``; for each node, publisher and subscription a liveliness token, from which every
other node knows the graph; with each message an attachment of 33 bytes (Jazzy's from 0.2.4 on, all others). Humble has
no hashes of types. zenoh-bridge-ros2dds: data on the topic's plain name, no attachment, tokens of its own.
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
NAME = r"(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
DEPTH = 42  # of a history, where none is said (qos.cpp)
# Everybody's tokens, whatever flavour and domain: where messages do not come, it is said who is there instead. Those of
# zenoh-bridge-ros2dds; those of rmw_zenoh, and of that bridge before 1.0.
TOKENS = ("@/*/@ros2_lv/**", "@ros2_lv/**")
ATTACHMENT = struct.Struct("<qqB16s")  # sequence number, ns of wall time, length, gid
LEGACY = re.compile(rb"\x0fsequence_number(.{8})\x10source_timestamp(.{8})\x0asource_gid\x10(.{16})", re.DOTALL)


@dataclass(frozen=True)
class Qos:
    """Quality of service, as far as it is more than a word here."""

    reliable: bool = True
    transient_local: bool = False  # the last ``depth`` messages are kept for those who come later
    depth: int = 10

    def text(self) -> str:
        """As tokens have it: numbers of rmw/types.h, nothing where it is what rmw_zenoh takes unless told."""
        reliability, durability = "" if self.reliable else "2", "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{'' if self.depth == DEPTH else self.depth}:,:,:,,"


SENSOR = Qos(reliable=False, depth=5)
LATEST = Qos(depth=1)
TF = Qos(depth=100)
TF_STATIC = Qos(transient_local=True, depth=100)
KEPT = Qos(transient_local=True, depth=1)


def full_name(topic: str, namespace: str) -> str:
    """A topic's absolute name: a relative one is put into the namespace."""
    return topic if topic.startswith("/") else f"{clean_namespace(namespace).rstrip('/')}/{topic}"


def clean_namespace(namespace: str) -> str:
    """With one slash before it and none after; the empty one is ``/``."""
    return "/" + namespace.strip("/")


@dataclass(frozen=True)
class Names:
    """Keys of one domain as one flavour has them."""

    flavor: Flavor = "rmw_zenoh"
    domain: int = 0
    hashes: bool = True  # False: Humble

    def hash_of(self, kind: str) -> str:
        """What stands in the place of a type's hash."""
        return type_hash(kind) if self.hashes else NO_HASH

    def publish(self, topic: str, kind: str) -> str:
        """Where messages of type ``kind`` are put."""
        stem = topic.strip("/")
        if self.flavor == "ros2dds":
            return stem
        return f"{self.domain}/{stem}/{dds_name(kind)}/{self.hash_of(kind)}"

    def subscribe(self, topic: str, kind: str) -> str:
        """Where they are heard: with any hash, so that one of another definition is noticed."""
        stem = topic.strip("/")
        return stem if self.flavor == "ros2dds" else f"{self.domain}/{stem}/{dds_name(kind)}/*"

    def check_type_hash(self, key: str, kind: str) -> None:
        """Raises ValueError where what came on ``key`` says that it is of another definition than known here."""
        told = key.rsplit("/", 1)[-1]
        if self.flavor == "rmw_zenoh" and told not in (type_hash(kind), NO_HASH):
            raise ValueError(f"its {kind} has the type hash {told}, not {type_hash(kind)}: another definition")

    def ours(self, endpoint: Endpoint) -> bool:
        """Whether somebody's endpoint is called as we call ours, so that messages can meet."""
        return endpoint.flavor == self.flavor and endpoint.domain in (None, self.domain)

    def caches(self, topic: str) -> tuple[str, ...]:
        """Where zenoh-bridge-ros2dds is asked for messages kept for those who come later."""
        stem = topic.strip("/")
        return f"@/*/@ros2_pub_cache/{stem}", f"@ros2_pub_cache/*/{stem}"


def mangle(name: str) -> str:
    """As one chunk of a key."""
    return name.replace("/", "%")


@dataclass(frozen=True)
class Node:
    """One of rmw_zenoh's nodes, which is us."""

    names: Names
    zid: str  # of the session
    namespace: str
    name: str

    def token(self) -> str:
        """Its liveliness token."""
        return self._token("NN", 0)

    def endpoint_token(self, kind: Kind, number: int, topic: str, message: str, qos: Qos) -> str:
        """The token of its publisher or subscription with that ``number``, unique among them."""
        rest = (mangle(topic), dds_name(message), self.names.hash_of(message), qos.text())
        return "/".join([self._token(kind, number), *rest])

    def _token(self, kind: Kind, number: int) -> str:
        enclave, namespace = "%", mangle(clean_namespace(self.namespace))
        return f"@ros2_lv/{self.names.domain}/{self.zid}/0/{number}/{kind}/{enclave}/{namespace}/{self.name}"


def publisher_gid(token: str) -> bytes:
    """16 bytes by which ROS knows the publisher with that token: its XXH3 of 128 bits, the lower half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh wants with a message; it drops one without, and one it cannot read ends its process."""
    return ATTACHMENT.pack(sequence, stamp_ns, len(gid), gid)


def read_attachment(data: bytes) -> tuple[int, int, bytes] | None:
    """Sequence number, ns of wall time, gid; also of Jazzy's first versions, which named them. None: it is none."""
    if match := LEGACY.fullmatch(data):
        return (*struct.unpack("<qq", match[1] + match[2]), match[3])
    if len(data) != ATTACHMENT.size or data[16] != 16:
        return None
    sequence, stamp_ns, _, gid = ATTACHMENT.unpack(data)
    return sequence, stamp_ns, gid


@dataclass(frozen=True)
class Endpoint:
    """Somebody's publisher or subscription."""

    publishes: bool
    topic: str  # absolute
    kind: str  # a/msg/B
    hash: str = ""
    node: str = ""  # absolute; zenoh-bridge-ros2dds does not say
    flavor: Flavor = "rmw_zenoh"
    domain: int | None = None  # zenoh-bridge-ros2dds does not say


def read_token(key: str) -> Endpoint | None:
    """What a token of either flavour says of a publisher or subscription; None of all else."""
    parts = key.split("/")
    if parts[0] == "@ros2_lv" and len(parts) >= 13 and parts[5] in ("MP", "MS"):
        namespace, name, topic, kind, digest = (part.replace("%", "/") for part in parts[7:12])
        domain = int(parts[1]) if re.fullmatch(r"[0-9]{1,3}", parts[1]) else None
        node = f"{namespace.rstrip('/')}/{name}"
        return Endpoint(parts[5] == "MP", topic, ros_name(kind), digest, node, domain=domain)
    where = parts.index("@ros2_lv") if "@ros2_lv" in parts else -1
    rest = parts[where + (1 if where == 2 else 2) :] if where in (0, 2) else []
    if len(rest) >= 3 and rest[0] in ("MP", "MS"):
        topic, kind = (part.replace("§", "/") for part in rest[1:3])
        return Endpoint(rest[0] == "MP", "/" + topic.strip("/"), kind, flavor="ros2dds")
    return None
