"""Exit status 0 where a service is healthy: `python -m common.containers.healthcheck NAME`.

A listening port proves nothing, and a running loop little: a service is healthy when its heartbeat is fresh, it has a
link to other sessions, and it publishes what it should while its inputs arrive.

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
from common.runtime.heartbeat import Beat, read_beats

STALE = 4.0  # s without a heartbeat, one comes each second
FRESH = 2.0  # s; what came within, comes
SILENT = 5.0  # s without a result, though what makes it comes
PATIENCE = 4.0  # s until a router has answered
PAGE = ("127.0.0.1", 8080)
# What comes in, and what comes out then; of each key's last chunks and kinds.
DUTIES = {
    "simulator": (None, ("scan", "published")),
    "bridge_ros2": (None, ("scan", "published")),
    "replay": (None, ("scan", "published")),
    "remote": (None, ("scan", "received")),
    "estimator": (("scan", "received"), ("belief", "published")),
    "controller": (("belief", "received"), ("status", "published")),
    "recorder": (("*", "received"), ("*", "written")),
}
TOGETHER = {"viewer"}  # one process for all robots: its heartbeat bears the first one's name
EXCUSED = (
    "paused",
    "waits for",
    "records nothing",
    "standing by",
)  # how the notes begin of those who rightly do nothing


def main(service: str) -> None:
    """Raises ValueError, OSError or UserError with what is wrong."""
    if service == "router":
        _reach_router()
        return
    folder, robots = Path(os.environ.get("PRESAGE_HEARTBEAT") or "/tmp"), robot_names(os.environ)  # noqa: S108 - the images'
    if fault := fault_of(service, read_beats(folder, service), robots, time.monotonic()):
        raise ValueError(fault)
    if service == "viewer":
        _ask_for_page()


def fault_of(service: str, beats: dict[str, Beat], robots: Collection[str], now: float) -> str:
    """What is wrong with a service by its heartbeats at ``now`` s; empty where nothing is.

    A process for each robot has a heartbeat for each; one for all of them has one, under the first robot's name.
    """
    for robot in robots:
        beat = beats.get(next(iter(robots)) if service in TOGETHER else robot)
        if beat is None:
            return f"{robot}: no heartbeat"
        if (age := now - beat.at) > STALE:
            return f"{robot}: its loop has not turned for {age:.0f} s"
        if not beat.linked:
            return f"{robot}: it reaches nobody; is the router there?"
        if fault := _idle(service, beat, robot, now):
            return f"{robot}: {fault}" + (f" ({beat.note})" if beat.note else "")
    return ""


def _idle(service: str, beat: Beat, robot: str, now: float) -> str:
    """What does not come out though it should."""
    if service not in DUTIES or beat.note.startswith(EXCUSED):
        return ""
    needed, result = DUTIES[service]
    came = now if needed is None else _last(beat, robot, *needed)
    if now - came > FRESH or (age := now - _last(beat, robot, *result)) <= SILENT:
        return ""
    return f"{result[0]} was not {result[1]} for {age:.0f} s" if age < now else f"no {result[0]} was {result[1]} so far"


def _last(beat: Beat, robot: str, topic: str, kind: str) -> float:
    """When it last came, s; 0: never."""
    stem = f"presage/{robot}/"
    rows = [row for key, row in beat.last.items() if key.startswith(stem) and topic in ("*", key.removeprefix(stem))]
    return max((row.get(kind, 0.0) for row in rows), default=0.0)


def _ask_for_page() -> None:
    """Whoever answers in HTTP is a web server at work, though he asks for a token."""
    with socket.create_connection(PAGE, PATIENCE) as page:
        page.sendall(f"GET / HTTP/1.0\r\nHost: {PAGE[0]}\r\n\r\n".encode())
        line = page.recv(100).split(b"\r\n")[0].decode("latin-1")
    if not line.startswith("HTTP/1.") or line.split()[1:2] not in (["200"], ["401"]):
        raise ValueError(f"the page answers {line!r}")


def _reach_router() -> None:
    """A session as a service opens one, but without a port of its own."""
    from dataclasses import replace  # noqa: PLC0415 - these take as long to load as all else together

    from common.bus.bus import open_bus, wait_until  # noqa: PLC0415
    from common.runtime.config import ServiceSettings, load_settings  # noqa: PLC0415

    link = replace(load_settings(ServiceSettings, ["--role", "router"]).link(), listen=())
    with open_bus(link, patience=PATIENCE) as bus:
        if not wait_until(bus.linked, PATIENCE):
            raise ValueError(f"no session through {', '.join(link.connect)} within {PATIENCE:g} s")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Exception as error:  # noqa: BLE001 - whatever it is, it is not healthy
        print(f"unhealthy: {error}", file=sys.stderr)
        sys.exit(1)
