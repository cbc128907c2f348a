"""`python -m common.healthy SERVICE`: status 0 where the service's loop turns. For health checks of containers.

A listening port proves little: a service counts as healthy when its pulse arrives over the bus.
"""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

from common.bus import DEFAULT_ENDPOINT, Link, open_bus
from common.config import split_endpoints
from common.errors import UserError
from common.inbox import Inbox, Sample
from common.security import credentials
from common.topics import HEALTH

PATIENCE = 4.0  # s; a pulse comes each second


def healthy(service: str) -> bool:
    """Whether a pulse of the service, or for the router a connection, comes in time."""
    if service == "router":
        with socket.create_connection(("127.0.0.1", 7447), PATIENCE):
            return True
    connect = split_endpoints(os.environ.get("PRESAGE_CONNECT") or DEFAULT_ENDPOINT)
    inbox = Inbox()
    robot, folder = os.environ.get("PRESAGE_ROBOT") or "robot", os.environ.get("PRESAGE_SECURITY")
    role = os.environ.get("PRESAGE_ROLE") or service
    security = credentials(Path(folder), (role,), robot) if folder else None
    with open_bus(Link(robot=robot, connect=connect, security=security), patience=PATIENCE) as bus:
        bus.subscribe(HEALTH, inbox)
        wanted = HEALTH.key(bus.robot, service)
        for _ in range(100):
            sample = inbox.get(PATIENCE)
            if sample is None:
                return False
            if isinstance(sample, Sample) and sample.key == wanted:
                return True
    return False


if __name__ == "__main__":
    try:
        sys.exit(0 if healthy(sys.argv[1]) else 1)
    except (UserError, OSError, IndexError) as error:
        print(f"unhealthy: {error}", file=sys.stderr)
        sys.exit(1)
