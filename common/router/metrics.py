"""The router's Prometheus metrics."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from common.runtime.metrics import build_info, family, new_registry

if TYPE_CHECKING:
    from common.bus.bus import Bus


class RouterMetrics(Collector):
    """Uptime of the router, and number of sessions connected to it."""

    def __init__(self, bus: Bus) -> None:
        """``bus`` is the router's own session."""
        self._bus, self._began = bus, time.monotonic()
        self.registry = new_registry(self)

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics for a scrape."""
        yield build_info("", "router")
        yield family("presage_router_uptime_seconds", [((), time.monotonic() - self._began)])
        yield family("presage_router_sessions", [((), self._bus.count_links())])
