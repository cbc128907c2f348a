"""Exits with status 0 if a service is healthy: `python -m common.containers.healthcheck NAME`.

A service is healthy if its heartbeat is recent, it is connected to another session, and it publishes its results while
its inputs arrive. An open port or a running loop alone would not show that it works.

Examples:
  python -m common.containers.healthcheck estimator    reads PRESAGE_HEARTBEAT, for the robots of PRESAGE_FLEET
  python -m common.containers.healthcheck router       opens a session through PRESAGE_CONNECT, or loopback

"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Collection
from pathlib import Path

from common.containers.run_per_robot import robot_names
from common.runtime.heartbeat import read_beats
from common.runtime.service_monitor import Report, find_problem

CONNECT_TIMEOUT_S = 4.0  # for the router or the live page
PAGE = ("127.0.0.1", 8080)
SINGLE_PROCESS = {"viewer"}  # one process for all robots, whose heartbeat has the first robot's name


def main(service: str) -> None:
    """Checks a service; raises ValueError, OSError or UserError, with the reason, if it is not healthy."""
    if service == "router":
        _reach_router()
        return
    folder = Path(os.environ.get("PRESAGE_HEARTBEAT") or "/tmp")  # noqa: S108 - the folder used in the images
    robots = robot_names(os.environ)
    if fault := find_fault(service, read_beats(folder, service), robots, time.monotonic()):
        raise ValueError(fault)
    if service == "viewer":
        _check_page()


def find_fault(service: str, beats: dict[str, Report], robots: Collection[str], now: float) -> str:
    """The problem of a service at ``now`` s (monotonic clock), by its heartbeats; empty if it is healthy.

    ``beats`` has the heartbeat of each process, by the name of its robot.
    """
    for robot in robots:
        beat = beats.get(next(iter(robots)) if service in SINGLE_PROCESS else robot)
        if beat is None:
            return f"{robot}: no heartbeat"
        if problem := find_problem(service, robot, beat, now):
            return f"{robot}: {problem}" + (f" ({beat.note})" if beat.note else "")
    return ""


def _check_page() -> None:
    """Checks that the web server responds; status 401, which asks for a token, is fine."""
    with socket.create_connection(PAGE, CONNECT_TIMEOUT_S) as page:
        page.sendall(f"GET / HTTP/1.0\r\nHost: {PAGE[0]}\r\n\r\n".encode())
        line = page.recv(100).split(b"\r\n")[0].decode("latin-1")
    if not line.startswith("HTTP/1.") or line.split()[1:2] not in (["200"], ["401"]):
        raise ValueError(f"the page answers {line!r}")


def _reach_router() -> None:
    """Opens a session like a service's, but without listening on a port."""
    # Imported here because these imports take as long as all others together.
    from dataclasses import replace

    from common.bus.bus import open_bus, wait_until
    from common.runtime.config import ServiceSettings, load_settings

    link = replace(load_settings(ServiceSettings, ["--role", "router"]).link(), listen=())
    with open_bus(link, connect_timeout=CONNECT_TIMEOUT_S) as bus:
        if not wait_until(bus.linked, CONNECT_TIMEOUT_S):
            raise ValueError(f"no session through {', '.join(link.connect)} within {CONNECT_TIMEOUT_S:g} s")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Exception as error:  # noqa: BLE001 - any error means unhealthy
        print(f"unhealthy: {error}", file=sys.stderr)
        sys.exit(1)
