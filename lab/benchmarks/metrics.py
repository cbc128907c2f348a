"""`presage bench metrics`."""

from __future__ import annotations

import time
import urllib.request
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.bus.bus import open_bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.topics import SCAN
from common.runtime.metrics import LoopCounts, ServiceMetrics
from lab.benchmarks.cpu import cpu_seconds
from presage.session.ports import free_port
from presage.session.stack import Stack
from presage.terminal.output import check_file, machine, provenance, write_json

SERVICES = ("simulator", "estimator", "controller")
WARM_UP_S = 3.0  # before the first round
MESSAGES = 20_000  # for the cost of one message's histograms


@dataclass
class ScrapeCost:
    """Totals over all rounds with, or all rounds without, scrapes."""

    seconds: float = 0.0
    cpu_s: Counter[str] = field(default_factory=Counter)  # by service
    scrape_ms: list[float] = field(default_factory=list)
    scrape_bytes: int = 0

    def share(self, service: str) -> float:
        """Share of one core that the service used."""
        return self.cpu_s[service] / self.seconds


def measure(seconds: float, rounds: int, console: Console) -> tuple[ScrapeCost, ScrapeCost]:
    """Costs unscraped, and with one scrape per second of each service; rounds alternate between the two."""
    unscraped, scraped = ScrapeCost(), ScrapeCost()
    ports = {name: free_port() for name in SERVICES}
    with Stack("bench", quiet=True) as stack:
        stack.start_router()
        for name in reversed(SERVICES):
            stack.start(name, "--metrics", str(ports[name]))
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            time.sleep(WARM_UP_S)
            for number in track(range(2 * rounds), "without, with", console=console, transient=True):
                cost = scraped if number % 2 else unscraped
                _round(stack, seconds, cost, ports if number % 2 else {})
    return unscraped, scraped


def _round(stack: Stack, seconds: float, cost: ScrapeCost, ports: dict[str, int]) -> None:
    before, began = cpu_seconds(stack, SERVICES), time.monotonic()
    for second in range(int(seconds)):
        for port in ports.values():
            requested = time.perf_counter()
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
                    cost.scrape_bytes = max(cost.scrape_bytes, len(answer.read()))
            except OSError as error:
                raise UserError(f"port {port} did not answer a request for metrics: {error}") from None
            cost.scrape_ms.append((time.perf_counter() - requested) * 1e3)
        stack.check()
        time.sleep(max(0.0, began + second + 1 - time.monotonic()))
    cost.seconds += time.monotonic() - began
    cost.cpu_s.update({name: used - before[name] for name, used in cpu_seconds(stack, SERVICES).items()})


def observation_us() -> float:
    """Processor time in µs to record one message in the histograms."""
    metrics = ServiceMetrics("bench", "bench", Inbox(), lambda: LoopCounts({}, {}, 0, {}, 0.0))
    sample = Sample(SCAN, SCAN.key("bench"), b"", time.time_ns(), time.monotonic_ns())
    began = time.process_time()
    for _ in range(MESSAGES):
        with metrics.step(sample):
            pass
    return (time.process_time() - began) / MESSAGES * 1e6


def bench_metrics(seconds: float, rounds: int, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    unscraped, scraped = measure(seconds, rounds, console)
    table = Table(title=f"{rounds} x {seconds:g} s each, one scrape a second", title_justify="left")
    for column in ("share of one core", "not scraped", "scraped"):
        table.add_column(column, justify="left" if column == "share of one core" else "right")
    for name in SERVICES:
        table.add_row(name, *(f"{100 * cost.share(name):.1f} %" for cost in (unscraped, scraped)))
    console.print(table)
    result: dict[str, Any] = {
        **{f"{name}_cpu_share_without": unscraped.share(name) for name in SERVICES},
        **{f"{name}_cpu_share_with": scraped.share(name) for name in SERVICES},
        "scrape_median_ms": float(np.median(scraped.scrape_ms)),
        "scrape_p99_ms": float(np.percentile(scraped.scrape_ms, 99)),
        "scrape_bytes": scraped.scrape_bytes,
        "observation_us": observation_us(),
        "seconds": seconds,
        "rounds": rounds,
        "machine": machine(),
        **provenance(),
    }
    console.print(
        f"a scrape: {result['scrape_median_ms']:.1f} ms median, {result['scrape_p99_ms']:.1f} ms p99, "
        f"{result['scrape_bytes'] / 1e3:.1f} kB; a message's two histograms: {result['observation_us']:.1f} µs",
        highlight=False,
    )
    write_json(json_file, result)
