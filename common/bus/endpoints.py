"""Checks network endpoints, and explains connections that fail."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

from common.errors import UserError

NETWORK_PROTOCOLS = frozenset({"tcp", "udp", "tls", "quic", "ws", "vsock"})  # zenoh refuses unknown protocols


def with_tls(endpoint: str) -> str:
    """Replaces tcp by tls in an endpoint, because sessions with credentials send nothing unencrypted."""
    return endpoint.replace("tcp/", "tls/", 1) if endpoint.startswith("tcp/") else endpoint


def refuse_exposure(listen: Sequence[str]) -> None:
    """Raises UserError if a session without credentials would listen on addresses that other machines reach."""
    if exposed := [endpoint for endpoint in listen if not on_loopback(endpoint)]:
        raise UserError(
            f"listen {', '.join(exposed)}: any machine that reaches this address could drive the robot. Either give "
            "credentials with --security DIR (`presage secure init` creates them), or declare the network private with "
            "--insecure (PRESAGE_INSECURE=1)"
        )


def on_loopback(endpoint: str) -> bool:
    """Whether only this machine can reach the endpoint; False for host names other than localhost."""
    protocol, _, rest = endpoint.partition("/")
    host = rest.rsplit(":", 1)[0].strip("[]")
    if protocol not in NETWORK_PROTOCOLS:
        return True
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def explain_rejection(name: str, connect: Sequence[str]) -> str:
    """Error message for when no router accepts the credentials ``name``."""
    return (
        f"no router at {', '.join(map(with_tls, connect)) or 'no endpoint'} accepts {name!r}: "
        "is a router running there, with --security and credentials of the same authority? "
        "Its log lists the connections it refuses"
    )
