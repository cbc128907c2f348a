"""Opens zenoh sessions with explicit endpoints and credentials."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from common.bus.endpoints import on_loopback, with_tls
from common.bus.security import Credentials
from common.errors import UserError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
# A router in secure mode handles at most ten failed handshakes per second, and a new connection waits in a queue behind
# them: about 6 s if 32 clients keep failing. An attempt that ends earlier starts again at the end of the queue.
# Zenoh cannot be interrupted while it connects, so a service may take this long to end.
JOIN_TIMEOUT_S = 8.0
# The first two modules log an error for every message that arrives while a session opens or closes. The third one logs
# an error for every message from a host whose clock is ahead, which `presage doctor` reports once.
LOG_FILTER = (
    "error,zenoh::api::session=off,zenoh::net::protocol::gossip=off,zenoh::net::routing::dispatcher::pubsub=off"
)


@dataclass(frozen=True)
class Link:
    """Parameters of a session. Endpoints are in zenoh's notation, such as tcp/127.0.0.1:7447."""

    robot: str = "robot"
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    router: bool = False
    multicast: bool = False
    lossless: bool = True  # publishers wait for slow subscribers instead of dropping messages
    security: Credentials | None = None  # with credentials, only a router listens
    insecure: bool = False  # allows listening on other addresses than loopback without credentials

    @property
    def connect_option(self) -> str:
        """Value of ``--connect`` for other programs of the session; empty if they do not need it."""
        return "" if self.connect == (DEFAULT_ENDPOINT,) else ",".join(self.connect)


def _config(link: Link, join_timeout: float = JOIN_TIMEOUT_S) -> zenoh.Config:
    config: zenoh.Config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "router" if link.router else "peer",
        "connect/endpoints": link.connect,
        "connect/timeout_ms": -1,  # keep trying in the background until the router is running
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "listen/endpoints": link.listen,
        "scouting/multicast/enabled": link.multicast,
        "transport/shared_memory/enabled": False,  # drops silently when a receiver stalls (zenoh issue 2628)
        "timestamping/enabled": True,
        # Time in ms after which a silent session (frozen, disconnected) counts as gone; zenoh's default is 10 s.
        "transport/link/tx/lease": 3000,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 5000,  # microseconds
    }
    if not all(map(on_loopback, link.listen)):
        # Only one of two peers that discover each other may connect: if both try, both may be refused, and neither
        # tries again. A peer that listens only on loopback cannot be reached by other hosts and always connects.
        settings["scouting/gossip/autoconnect_strategy"] = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
    if link.security is not None:
        settings |= {**link.security.zenoh(), "mode": "router" if link.router else "client"}
        settings["connect/endpoints"] = [with_tls(each) for each in link.connect]
        settings["listen/endpoints"] = [with_tls(each) for each in link.listen] if link.router else []
        if not link.router:  # a single attempt; the caller repeats it, so that it can stop trying
            settings |= {
                "connect/timeout_ms": 0,
                "connect/exit_on_failure": True,
                "transport/unicast/open_timeout": int(join_timeout * 1000),
            }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(link: Link, join_timeout: float = JOIN_TIMEOUT_S) -> zenoh.Session | None:
    """Opens a session; raises UserError if the endpoints cannot be used.

    In secure mode, returns None if no router accepts the credentials within ``join_timeout`` s for each endpoint.
    """
    try:
        return zenoh.open(_config(link, join_timeout))
    except zenoh.ZError as error:
        text = str(error)
        if link.security is not None and "Unable to connect" in text:
            return None
        if "in use" in text:
            raise UserError(f"port in use: {' '.join(link.listen)}; choose another with --listen") from None
        # Zenoh appends its source line, and wraps some messages in the name of a Rust enum.
        reason = " ".join(text.split(" at /", maxsplit=1)[0].split()).removeprefix('Json5Err(Message { msg: "')
        endpoints = f"connect {', '.join(link.connect) or 'none'}, listen {', '.join(link.listen) or 'none'}"
        raise UserError(f"no session with {endpoints}: {reason}; an endpoint looks like {DEFAULT_ENDPOINT}") from None


def wait_until(condition: Callable[[], bool], timeout: float, period: float = 0.02) -> bool:
    """Waits until ``condition()`` is true; returns False if it is still false after ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(period)
    return True
