"""The HTTP endpoint that serves metrics."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, start_http_server

from common.errors import UserError
from common.runtime.metrics import LoopCounts, ServiceMetrics

if TYPE_CHECKING:
    from common.runtime.service_loop import ServiceLoop

LOOPBACK = "127.0.0.1"


def split_address(setting: str) -> tuple[str, int]:
    """Host and port of the setting ``--metrics``; the host defaults to loopback. Raises UserError if it is invalid."""
    found = re.fullmatch(r"(?:(.+):)?(\d+)", setting)
    if found is None or int(found[2]) > 65535:
        raise UserError(f"--metrics {setting}: give PORT or HOST:PORT, with a port up to 65535")
    return (found[1] or LOOPBACK).strip("[]"), int(found[2])


@contextmanager
def serve_registry(registry: CollectorRegistry, setting: str) -> Iterator[str]:
    """Serves the registry over HTTP, with a thread for each request; yields the URL.

    Raises UserError if the address cannot be listened on.
    """
    host, port = split_address(setting)
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise UserError(
            f"--metrics {setting}: cannot listen on {host} port {port} ({error.strerror or error}); "
            "choose another port, or 0 for any free one"
        ) from None
    try:
        yield f"http://{f'[{host}]' if ':' in host else host}:{server.server_port}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def serve_loop_metrics(loop: ServiceLoop, setting: str) -> Iterator[ServiceMetrics]:
    """Serves the metrics of a service loop at the address ``setting`` until the block ends; yields the metrics."""
    service = loop.service

    def counts() -> LoopCounts:
        # Copies, because a scrape reads them from another thread.
        return LoopCounts(
            published=loop.published.copy(),
            undecodable=loop.undecodable.copy(),
            failed=loop.failed,
            events=dict(service.counters),
            began=loop.began,
        )

    metrics = ServiceMetrics(loop.bus.robot, service.name, loop.inbox, counts)
    with serve_registry(metrics.registry, setting) as address:
        service.log.info("metrics", address=address)
        yield metrics
