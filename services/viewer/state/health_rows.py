"""Health of the services as rows."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from common.messages.definitions import Health, TopicHealth

EXPECTED = ("simulator", "estimator", "controller")  # services that a robot needs to navigate
FORGET_AFTER_S = 30.0  # after its last health message, a service that is not alive is no longer listed
MAX_SERVICES = 50  # so that invented names cannot fill the memory

Row = dict[str, Any]


@dataclass(frozen=True)
class HealthPair:
    """The last two health messages of a service."""

    now: Health
    before: Health | None
    at: float  # monotonic time at which the last one was received, s


class HealthHistory:
    """Health messages of one robot's services."""

    def __init__(self) -> None:
        self._by_service: dict[str, HealthPair] = {}

    def add(self, health: Health, at: float) -> None:
        """Stores a message received at monotonic time ``at`` in s."""
        before = self._by_service.get(health.service)
        if before is None and len(self._by_service) >= MAX_SERVICES:
            return
        # Counts can only be compared within one process: a restarted service, or a second recorder, has its own.
        same = before is not None and before.now.instance == health.instance and before.now.uptime < health.uptime
        self._by_service[health.service] = HealthPair(health, before.now if before is not None and same else None, at)

    def rows(self, alive: Collection[str], at: float) -> list[Row]:
        """One row for each service that is alive or sent health lately, in order of their names."""
        for name in [n for n, p in self._by_service.items() if n not in alive and at - p.at > FORGET_AFTER_S]:
            del self._by_service[name]
        names = sorted({*sorted(alive)[:MAX_SERVICES], *self._by_service})
        return [self._row(name, name in alive, at) for name in names]

    def _row(self, name: str, alive: bool, at: float) -> Row:  # noqa: FBT001
        pair = self._by_service.get(name)
        if pair is None:
            return {"name": name, "alive": alive, "age_s": None, "note": "", "rates": [], "uptime_s": None}
        health, before = pair.now, pair.before
        earlier = {row.key: row for row in before.topics} if before is not None else {}
        seconds = health.uptime - before.uptime if before is not None else 0.0
        return {
            "name": name,
            "alive": alive,
            "age_s": round(at - pair.at, 1),
            "note": health.note[:500],
            "rates": [rates(row, earlier.get(row.key), seconds) for row in health.topics],
            "uptime_s": round(health.uptime, 1),
        }


def rates(row: TopicHealth, before: TopicHealth | None, seconds: float) -> Row:
    """Rates of one key in one service, in Hz.

    Computed from the counts of two health messages ``seconds`` apart. With only one message, the rate it states.
    """
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
    """Command that starts a service. ``connect``: endpoints, or empty for the default."""
    words = ["python -m", "common.router" if service == "router" else f"services.{service}"]
    if service != "router":
        words += [f"--robot {robot}"] * (robot != "robot") + [f"--connect {connect}"] * bool(connect)
    return " ".join(words)


def missing(alive: Collection[str], *, linked: bool, scans: bool) -> list[str]:
    """Services that a robot still needs to navigate. A replay needs none.

    ``scans``: whether scans arrive. If so, no simulator is needed, because a real robot may send them.
    """
    if "replay" in alive:
        return []
    present = {*alive, *(["simulator"] if scans else [])}
    return [*([] if linked else ["router"]), *(name for name in EXPECTED if name not in present)]
