"""Converts the health of services to rows for the page."""

from __future__ import annotations

from typing import Any

from common.messages.definitions import TopicHealth
from common.runtime.service_monitor import ServiceMonitor, ServiceStatus

Row = dict[str, Any]


def rows_of(monitor: ServiceMonitor, now: float) -> list[Row]:
    """One row for each service that is connected, or was a short time ago."""
    return [_row(each) for each in monitor.services(now) if each.since is not None]


def _row(service: ServiceStatus) -> Row:
    health = service.health
    return {
        "name": service.name,
        "state": service.state,
        "alive": service.state != "absent",
        "age_s": None if service.age is None else round(service.age, 1),
        "note": service.text[:500],
        "idle": health is not None and health.idle,
        "rates": [] if health is None else [_rates(row) for row in health.topics],
        "uptime_s": None if health is None else round(health.uptime, 1),
    }


def _rates(row: TopicHealth) -> Row:
    """Rates of one key in Hz. A service either publishes or receives a key."""
    published, received = (row.rate, 0.0) if row.published else (0.0, row.rate)
    return {
        "topic": "/".join(row.key.split("/")[2:]) or row.key,
        "published_hz": round(published, 2),
        "received_hz": round(received, 2),
        "dropped": row.dropped,
        "undecodable": row.undecodable,
    }
