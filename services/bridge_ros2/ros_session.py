"""The session on the ROS side.

It imports zenoh itself: neither keys nor rules are the bus's there.
"""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh
import zenoh.ext

from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.topics import Topic
from services.bridge_ros2.keys import TOKENS, Names, Node, Qos, attachment, publisher_gid, read_attachment
from services.bridge_ros2.ros_types import encode

if TYPE_CHECKING:
    from services.bridge_ros2.graph import Graph

HEARTBEAT_PERIOD_S = 0.5  # s, of kept topics; rmw_zenoh's
LEASE_MS = 3000  # ms until one who is silent counts as gone


def open_ros_session(endpoint: str, config: Path | None = None) -> zenoh.Session | None:
    """None where nobody answers; raises UserError where the endpoint or the file is none.

    A client: rmw_zenoh's nodes listen on their own host alone, and a router does not pass on between peers.
    """
    try:
        chosen = zenoh.Config.from_file(str(config)) if config else zenoh.Config()
        for key, value in ({} if config else _settings(endpoint)).items():
            chosen.insert_json5(key, json.dumps(value))
        return zenoh.open(chosen)
    except zenoh.ZError as error:
        text = str(error)
        if "Unable to connect" in text:
            return None
        # Zenoh appends its own source line, and wraps some messages in the name of a Rust enum.
        why = " ".join(text.split(" at /", maxsplit=1)[0].split()).removeprefix('Json5Err(Message { msg: "')
        advice = "--ros-config: a zenoh configuration" if config else "--ros-connect is written like tcp/ROBOT:7447"
        raise UserError(f"no session with {config or endpoint}: {why}; {advice}") from None


def _settings(endpoint: str) -> dict[str, Any]:
    return {
        "mode": "client",
        "connect/endpoints": [each.strip() for each in endpoint.split(",") if each.strip()],
        "connect/timeout_ms": 500,  # it is tried again; the loop goes on between
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
    }


@dataclass
class RosPublisher:
    """One of our publishers."""

    kind: str
    publisher: Any
    gid: bytes  # empty: no attachment
    sequence: itertools.count[int]

    def put(self, message: Any, kind: str | None = None) -> None:
        """Send a message."""
        payload = encode(kind or self.kind, message)
        if not self.gid:
            self.publisher.put(payload)
            return
        self.publisher.put(payload, attachment=attachment(next(self.sequence), time.time_ns(), self.gid))


class RosSession:
    """What was declared on it; the graph and the inbox are filled by zenoh's threads."""

    def __init__(self, session: zenoh.Session, names: Names, namespace: str, name: str, graph: Graph) -> None:
        """Say that the node is there, and hear who else is."""
        self._session, self._names, self._graph = session, names, graph
        self._declared: list[Any] = []
        self._numbers = itertools.count(1)
        self._node: Node | None = None
        if names.flavor == "rmw_zenoh":
            self._node = Node(names, str(session.zid()), namespace, name)
            self._token(self._node.token())
        for key in TOKENS:
            self._declared.append(session.liveliness().declare_subscriber(key, self._seen, history=True))

    def _seen(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if self._node is None or f"/{self._node.zid}/" not in key:  # not ourselves
            self._graph.change(key, there=sample.kind == zenoh.SampleKind.PUT)

    def _token(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def subscribe(self, row: Topic, topic: str, kind: str, qos: Qos, inbox: Inbox) -> None:
        """Move what comes on a ROS topic to ``inbox`` under ``row``, with what was kept for latecomers."""

        def move(sample: zenoh.Sample) -> None:
            attached = sample.attachment
            read = read_attachment(attached.to_bytes()) if attached is not None else None
            published = read[1] if read is not None else 0
            entry = Sample(row, str(sample.key_expr), sample.payload.to_bytes(), published, time.time_ns())
            inbox.put(entry, newest_only=row.queue == "newest")

        key = self._names.subscribe(topic, kind)
        more: dict[str, Any] = {}
        if qos.transient_local:
            more = {
                "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
                "recovery": zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                "subscriber_detection": True,
            }
        self._declared.append(zenoh.ext.declare_advanced_subscriber(self._session, key, move, **more))
        if self._node is not None:
            self._token(self._node.endpoint_token("MS", next(self._numbers), topic, kind, qos))

    def fetch(self, row: Topic, topic: str, inbox: Inbox) -> None:
        """Ask zenoh-bridge-ros2dds, which keeps them otherwise, for messages of a kept topic; does not wait."""
        if self._node is not None:
            return

        def move(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                inbox.put(Sample(row, topic.strip("/"), sample.payload.to_bytes(), 0, time.time_ns()))

        for key in self._names.caches(topic):
            self._session.get(
                key, zenoh.handlers.Callback(move), target=zenoh.QueryTarget.ALL, timeout=1.0,
                consolidation=zenoh.ConsolidationMode.NONE, accept_replies=zenoh.ReplyKeyExpr.ANY,
            )  # fmt: skip

    def publisher(self, topic: str, kind: str, qos: Qos) -> RosPublisher:
        """A publisher, known to the graph."""
        more: dict[str, Any] = {}
        if qos.transient_local:
            more = {
                "cache": zenoh.ext.CacheConfig(qos.depth),
                "publisher_detection": True,
                "sample_miss_detection": zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=HEARTBEAT_PERIOD_S
                ),
            }
        made = zenoh.ext.declare_advanced_publisher(
            self._session, self._names.publish(topic, kind), congestion_control=zenoh.CongestionControl.DROP, **more
        )
        self._declared.append(made)
        gid = b""
        if self._node is not None:
            token = self._node.endpoint_token("MP", next(self._numbers), topic, kind, qos)
            self._token(token)
            gid = publisher_gid(token)
        return RosPublisher(kind, made, gid, itertools.count(1))

    def linked(self) -> bool:
        """Whether the router is reached."""
        info = self._session.info
        return bool(list(info.routers_zid()) or list(info.peers_zid()))

    def close(self) -> None:
        """Take everything back."""
        self._session.close()  # type: ignore[no-untyped-call]
