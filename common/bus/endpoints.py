"""Checks endpoints, and explains the ones that do not answer."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

from common.errors import UserError

NETWORKS = frozenset({"tcp", "udp", "tls", "quic", "ws", "vsock"})  # zenoh itself refuses what it does not know


def over_tls(endpoint: str) -> str:
    """With credentials nothing goes over the wire in the clear, however the endpoint is written."""
    return endpoint.replace("tcp/", "tls/", 1) if endpoint.startswith("tcp/") else endpoint


def refuse_exposure(listen: Sequence[str]) -> None:
    """Raises UserError where anybody on the network could join: for sessions without credentials."""
    if exposed := [endpoint for endpoint in listen if not on_loopback(endpoint)]:
        raise UserError(
            f"listen {', '.join(exposed)}: whoever reaches that could drive the robot. --security DIR lets in "
            "whom you name (`presage secure init`), --insecure (PRESAGE_INSECURE=1) says that the network is private"
        )


def on_loopback(endpoint: str) -> bool:
    """Whether only this machine reaches it; a name other than localhost may be anything."""
    protocol, _, rest = endpoint.partition("/")
    host = rest.rsplit(":", 1)[0].strip("[]")
    if protocol not in NETWORKS:
        return True
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def not_let_in(name: str, connect: Sequence[str]) -> str:
    """What may be wrong where no router accepts ``name``."""
    return (
        f"no router at {', '.join(map(over_tls, connect)) or 'no endpoint'} lets {name!r} in: "
        "does it run, with --security, of the same authority? its log says whom it refuses"
    )
