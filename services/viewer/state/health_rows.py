"""Health of the services as rows."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from common.messages.definitions import Health, TopicHealth

EXPECTED = ("simulator", "estimator", "controller")  # what a robot needs to move by itself
FORGET_AFTER_S = 30.0  # s after its last pulse, a service that is not alive is no longer listed
MAX_SERVICES = 50  # services; somebody may invent names

Row = dict[str, Any]


@dataclass(frozen=True)
class HealthPair:
    """The last two of a service, and when the last came."""

    now: Health
    before: Health | None
    at: float  # s, a clock that only goes forward


class HealthHistory:
    """Health messages of one robot."""

    def __init__(self) -> None:
        """None heard."""
        self._by_service: dict[str, HealthPair] = {}

    def add(self, health: Health, at: float) -> None:
        """Take one."""
        before = self._by_service.get(health.service)
        if before is None and len(self._by_service) >= MAX_SERVICES:
            return
        # A service that was started anew counts from 0 again; two recorders may run, each with counts of its own.
        same = before is not None and before.now.instance == health.instance and before.now.uptime < health.uptime
        self._by_service[health.service] = HealthPair(health, before.now if before is not None and same else None, at)

    def rows(self, alive: Collection[str], at: float) -> list[Row]:
        """One a service, alive or heard of lately, in order of their names."""
        for name in [n for n, p in self._by_service.items() if n not in alive and at - p.at > FORGET_AFTER_S]:
            del self._by_service[name]
        names = sorted({*sorted(alive)[:MAX_SERVICES], *self._by_service})
        return [self._row(name, name in alive, at) for name in names]

    def _row(self, name: str, alive: bool, at: float) -> Row:  # noqa: FBT001
        pulse = self._by_service.get(name)
        if pulse is None:
            return {"name": name, "alive": alive, "age_s": None, "note": "", "rates": [], "uptime_s": None}
        health, before = pulse.now, pulse.before
        earlier = {row.key: row for row in before.topics} if before is not None else {}
        seconds = health.uptime - before.uptime if before is not None else 0.0
        return {
            "name": name,
            "alive": alive,
            "age_s": round(at - pulse.at, 1),
            "note": health.note[:500],
            "rates": [rates(row, earlier.get(row.key), seconds) for row in health.topics],
            "uptime_s": round(health.uptime, 1),
        }


def rates(row: TopicHealth, before: TopicHealth | None, seconds: float) -> Row:
    """Of one key in one service; Hz between two messages ``seconds`` apart, or as the service says."""
    topic = "/".join(row.key.split("/")[2:]) or row.key
    if before is not None and seconds > 0:
        published, received = (
            max(0, now - then) / seconds
            for now, then in ((row.published, before.published), (row.received, before.received))
        )
    else:
        published, received = (row.rate, 0.0) if row.published else (0.0, row.rate)
    return {
        "topic": topic,
        "published_hz": round(published, 2),
        "received_hz": round(received, 2),
        "dropped": row.dropped,
        "undecodable": row.undecodable,
    }


def how_to_start(service: str, robot: str, connect: str = "") -> str:
    """The command; ``connect`` where it is not the default."""
    words = ["python -m", "common.router" if service == "router" else f"services.{service}"]
    if service != "router":
        words += [f"--robot {robot}"] * (robot != "robot") + [f"--connect {connect}"] * bool(connect)
    return " ".join(words)


def missing(alive: Collection[str], *, linked: bool, scans: bool) -> list[str]:
    """Services a robot lacks to go by itself. A replay lacks none; scans may come from a real robot as well."""
    if "replay" in alive:
        return []
    there = {*alive, *(["simulator"] if scans else [])}
    return [*([] if linked else ["router"]), *(name for name in EXPECTED if name not in there)]
