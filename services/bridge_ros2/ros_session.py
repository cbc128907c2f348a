"""The session on the ROS side.

Uses zenoh directly, because keys and access rules differ from those of the bus.
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
from common.names import split_names
from services.bridge_ros2.keys import TOKEN_KEYS, BridgeNode, Qos, RosKeys, attachment, publisher_gid, read_attachment
from services.bridge_ros2.ros_types import encode

if TYPE_CHECKING:
    from services.bridge_ros2.graph import RosGraph

HEARTBEAT_PERIOD_S = 0.5  # of latched topics, as in rmw_zenoh
LEASE_MS = 3000  # a silent peer counts as gone after this


def open_ros_session(endpoint: str, config: Path | None = None) -> zenoh.Session | None:
    """Opens a zenoh session on the ROS side. Returns None if no router answers.

    Raises UserError if the endpoint or the configuration file is invalid. The session is a client, because nodes of
    rmw_zenoh only listen on their own host, and a router does not forward between peers.
    """
    try:
        zenoh_config = zenoh.Config.from_file(str(config)) if config else zenoh.Config()
        for key, value in ({} if config else _settings(endpoint)).items():
            zenoh_config.insert_json5(key, json.dumps(value))
        return zenoh.open(zenoh_config)
    except zenoh.ZError as error:
        text = str(error)
        if "Unable to connect" in text:
            return None
        # zenoh appends its own source line, and wraps some messages in the name of a Rust enum.
        reason = " ".join(text.split(" at /", maxsplit=1)[0].split()).removeprefix('Json5Err(Message { msg: "')
        advice = "--ros-config needs a zenoh configuration" if config else "write --ros-connect like tcp/ROBOT:7447"
        raise UserError(f"no session with {config or endpoint}: {reason}; {advice}") from None


def _settings(endpoint: str) -> dict[str, Any]:
    return {
        "mode": "client",
        "connect/endpoints": split_names(endpoint),
        "connect/timeout_ms": 500,  # short, because it blocks the service loop, which tries again later
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
    }


@dataclass
class RosPublisher:
    """A publisher on the ROS side."""

    kind: str  # message type, such as sensor_msgs/msg/LaserScan
    publisher: Any
    gid: bytes  # for the attachment; empty if the flavour has none
    sequence: itertools.count[int]

    def put(self, message: Any, kind: str | None = None) -> None:
        """Sends a message. ``kind`` defaults to the publisher's type."""
        payload = encode(kind or self.kind, message)
        if not self.gid:
            self.publisher.put(payload)
            return
        self.publisher.put(payload, attachment=attachment(next(self.sequence), time.time_ns(), self.gid))


class RosSession:
    """The bridge's node in the ROS graph. zenoh's threads fill the graph and the inbox."""

    def __init__(self, session: zenoh.Session, keys: RosKeys, namespace: str, name: str, graph: RosGraph) -> None:
        """Declares the node, and subscribes to the tokens of other nodes."""
        self._session, self._keys, self._graph = session, keys, graph
        self._declared: list[Any] = []
        self._numbers = itertools.count(1)
        self._node: BridgeNode | None = None
        if keys.flavor == "rmw_zenoh":
            self._node = BridgeNode(keys, str(session.zid()), namespace, name)
            self._declare_token(self._node.token())
        for key in TOKEN_KEYS:
            self._declared.append(session.liveliness().declare_subscriber(key, self._on_token, history=True))

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if self._node is None or f"/{self._node.zid}/" not in key:  # not the bridge's own
            self._graph.change(key, alive=sample.kind == zenoh.SampleKind.PUT)

    def _declare_token(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def subscribe(self, inbox_topic: Topic, topic: str, kind: str, qos: Qos, inbox: Inbox) -> None:
        """Subscribes to a ROS topic.

        Its messages, also latched ones, are put into ``inbox`` as samples of ``inbox_topic``.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            received_ns, data = time.monotonic_ns(), sample.attachment
            fields = read_attachment(data.to_bytes()) if data is not None else None
            published_ns = fields[1] if fields is not None else 0
            entry = Sample(inbox_topic, str(sample.key_expr), sample.payload.to_bytes(), published_ns, received_ns)
            inbox.put(entry, newest_only=inbox_topic.queue == "newest")

        key = self._keys.subscribe(topic, kind)
        options: dict[str, Any] = {}
        if qos.transient_local:
            options = {
                "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
                "recovery": zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                "subscriber_detection": True,
            }
        self._declared.append(zenoh.ext.declare_advanced_subscriber(self._session, key, on_sample, **options))
        if self._node is not None:
            self._declare_token(self._node.endpoint_token("MS", next(self._numbers), topic, kind, qos))

    def fetch(self, inbox_topic: Topic, topic: str, inbox: Inbox) -> None:
        """Queries zenoh-bridge-ros2dds for the messages of a latched topic, without waiting for the reply.

        Does nothing with rmw_zenoh, where `subscribe` receives them.
        """
        if self._node is not None:
            return

        def on_reply(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                inbox.put(Sample(inbox_topic, topic.strip("/"), sample.payload.to_bytes(), 0, time.monotonic_ns()))

        for key in self._keys.caches(topic):
            self._session.get(
                key,
                zenoh.handlers.Callback(on_reply),
                target=zenoh.QueryTarget.ALL,
                timeout=1.0,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
            )

    def publisher(self, topic: str, kind: str, qos: Qos) -> RosPublisher:
        """Declares a publisher, with its token in the ROS graph."""
        options: dict[str, Any] = {}
        if qos.transient_local:
            options = {
                "cache": zenoh.ext.CacheConfig(qos.depth),
                "publisher_detection": True,
                "sample_miss_detection": zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=HEARTBEAT_PERIOD_S
                ),
            }
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session, self._keys.publish(topic, kind), congestion_control=zenoh.CongestionControl.DROP, **options
        )
        self._declared.append(publisher)
        gid = b""
        if self._node is not None:
            token = self._node.endpoint_token("MP", next(self._numbers), topic, kind, qos)
            self._declare_token(token)
            gid = publisher_gid(token)
        return RosPublisher(kind, publisher, gid, itertools.count(1))

    def linked(self) -> bool:
        """Whether the session is connected to a router or peer."""
        info = self._session.info
        return bool(list(info.routers_zid()) or list(info.peers_zid()))

    def close(self) -> None:
        """Closes the session and all its declarations."""
        self._session.close()  # type: ignore[no-untyped-call]
