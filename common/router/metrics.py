"""The router's Prometheus metrics."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry

from common.runtime.metrics import add_build_info, gauge, new_registry

if TYPE_CHECKING:
    from common.bus.bus import Bus


def router_metrics(bus: Bus) -> CollectorRegistry:
    """Uptime of the router, and number of sessions connected to it; ``bus`` is the router's own session."""
    registry, began = new_registry(), time.monotonic()
    add_build_info(registry, "", "router")
    gauge(registry, "presage_router_uptime_seconds").set_function(lambda: time.monotonic() - began)
    gauge(registry, "presage_router_sessions").set_function(bus.count_links)
    return registry
