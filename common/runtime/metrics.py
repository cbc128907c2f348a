"""A service's Prometheus metrics.

`python -m common.runtime.metrics` prints the table of all metrics.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

from prometheus_client import CollectorRegistry, Gauge, Histogram, Info, ProcessCollector, disable_created_metrics
from prometheus_client.core import CounterMetricFamily, Metric
from prometheus_client.registry import Collector

from common.bus.inbox import is_message_counter
from common.messages.definitions import Belief, Health, Stamped, Status
from common.messages.topics import ROOT
from common.versions import PROTOCOL, versions

if TYPE_CHECKING:
    from common.bus.inbox import Inbox, Sample

# Upper bounds of the histograms' buckets; 0.066 s is the period of a 15 Hz scanner.
BUCKETS_S = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.066, 0.125, 0.25, 0.5, 1.0, 2.5)
TOPIC_LABELS, SERVICE_LABELS = ("robot", "service", "topic"), ("robot", "service")
STATES: dict[type[Stamped], tuple[str, ...]] = {
    kind: get_args(kind.model_fields["state"].annotation) for kind in (Belief, Status)
}


@dataclass(frozen=True)
class MetricDefinition:
    """One row of the table of metrics."""

    name: str  # without the suffixes that Prometheus's text format adds
    kind: str  # counter, gauge, histogram, info
    labels: tuple[str, ...]
    about: str
    exported_by: str = "every service"

    @property
    def sample(self) -> str:
        """Name to use in Prometheus queries."""
        return self.name + {"counter": "_total", "info": "_info"}.get(self.kind, "")


RECORDER = "the recorder"
METRICS: tuple[MetricDefinition, ...] = (
    MetricDefinition("presage_messages_received", "counter", TOPIC_LABELS, "Messages received from the bus"),
    MetricDefinition("presage_messages_published", "counter", TOPIC_LABELS, "Messages published on the bus"),
    MetricDefinition(
        "presage_messages_dropped",
        "counter",
        TOPIC_LABELS,
        "Messages replaced by newer ones, or refused by a full queue",
    ),
    MetricDefinition(
        "presage_messages_undecodable", "counter", TOPIC_LABELS, "Payloads that are not a valid message of their topic"
    ),
    MetricDefinition(
        "presage_message_rate_hertz", "gauge", TOPIC_LABELS, "Messages per second, in the second before the last health"
    ),
    MetricDefinition(
        "presage_message_latency_seconds",
        "histogram",
        TOPIC_LABELS,
        "From a message's publication to its handling, by both hosts' clocks",
    ),
    MetricDefinition(
        "presage_step_duration_seconds",
        "histogram",
        TOPIC_LABELS,
        "Time to handle one message, including the messages published in response",
    ),
    MetricDefinition("presage_requests_received", "counter", (*SERVICE_LABELS, "query"), "Requests received"),
    MetricDefinition(
        "presage_requests_dropped", "counter", (*SERVICE_LABELS, "query"), "Requests refused because the queue was full"
    ),
    MetricDefinition(
        "presage_requests_undecodable", "counter", (*SERVICE_LABELS, "query"), "Requests that could not be decoded"
    ),
    MetricDefinition("presage_steps_failed", "counter", SERVICE_LABELS, "Steps that raised an exception (see the log)"),
    MetricDefinition(
        "presage_events", "counter", (*SERVICE_LABELS, "event"), "The service's own counters, by name, as in its health"
    ),
    MetricDefinition("presage_uptime_seconds", "gauge", SERVICE_LABELS, "Time since the service's loop was created"),
    MetricDefinition(
        "presage_health_age_seconds",
        "gauge",
        SERVICE_LABELS,
        "Time since the last health message, which a running service sends each second",
    ),
    MetricDefinition(
        "presage_free_energy_nats", "gauge", SERVICE_LABELS, "Free energy of the last belief", "the estimator"
    ),
    MetricDefinition(
        "presage_pose_probability",
        "gauge",
        SERVICE_LABELS,
        "Probability that the pose of the last belief is within 0.2 m and 5 degrees of the truth",
        "the estimator",
    ),
    MetricDefinition(
        "presage_estimator_state",
        "gauge",
        (*SERVICE_LABELS, "state"),
        "1 for the state of the last belief, else 0",
        "the estimator",
    ),
    MetricDefinition(
        "presage_controller_state",
        "gauge",
        (*SERVICE_LABELS, "state"),
        "1 for the state of the last status, else 0",
        "the controller",
    ),
    MetricDefinition(
        "presage_recorder_messages_written", "counter", TOPIC_LABELS, "Messages written to recordings", RECORDER
    ),
    MetricDefinition(
        "presage_recorder_messages_missing",
        "counter",
        TOPIC_LABELS,
        "Messages published and never received, by their sequence numbers",
        RECORDER,
    ),
    MetricDefinition(
        "presage_recorder_written_bytes",
        "counter",
        SERVICE_LABELS,
        "Payload bytes written, before compression",
        RECORDER,
    ),
    MetricDefinition(
        "presage_build",
        "info",
        (*SERVICE_LABELS, "version", "protocol", "zenoh", "python", "commit"),
        "Always 1; its labels are the versions of the running program",
        "every service, the router",
    ),
    MetricDefinition("presage_router_uptime_seconds", "gauge", (), "Time since the router started", "the router"),
    MetricDefinition("presage_router_sessions", "gauge", (), "Sessions connected to the router", "the router"),
)
BY_NAME = {metric.name: metric for metric in METRICS}
Values = Iterable[tuple[tuple[str, ...], float]]  # label values and value of each sample


def new_registry() -> CollectorRegistry:
    """Creates a registry with the CPU, memory and open files of the process."""
    disable_created_metrics()  # type: ignore[no-untyped-call]
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    return registry


def gauge(registry: CollectorRegistry, name: str) -> Gauge:
    """Registers a gauge of the table."""
    definition = BY_NAME[name]
    return Gauge(name, definition.about, definition.labels, registry=registry)


def add_build_info(registry: CollectorRegistry, robot: str, service: str) -> None:
    """Registers the metric whose labels are the versions of the running program."""
    known, definition = versions(), BY_NAME["presage_build"]
    packages = {"version": "presage", "zenoh": "eclipse-zenoh", "python": "python", "commit": "commit"}
    values = {label: known.get(name, "unknown") for label, name in packages.items()}
    info = Info(definition.name, definition.about, SERVICE_LABELS, registry=registry)
    info.labels(robot, service).info({"protocol": str(PROTOCOL), **values})


def topic_labels(key: str) -> tuple[str, str]:
    """Robot and topic of a key; for a name that is not a key of presage, an empty robot and the name itself."""
    parts = key.split("/", 2)
    return (parts[1], parts[2]) if len(parts) == 3 and parts[0] == ROOT else ("", key)


@dataclass(frozen=True)
class LoopCounts:
    """Totals of a service's loop since it began."""

    published: Mapping[str, int]  # messages by key
    undecodable: Mapping[str, int]  # messages by key
    failed: int  # steps that raised an error
    events: Mapping[str, int]  # by name
    began: float  # s, monotonic clock


class ServiceMetrics(Collector):
    """Metrics of one service. The service's loop updates them; scrapes read them from another thread.

    The counters are collected at each scrape: the loop already has their totals, and a Counter can only be incremented.
    """

    def __init__(self, robot: str, service: str, inbox: Inbox, counts: Callable[[], LoopCounts]) -> None:
        """Collects from ``inbox`` and from ``counts``, which is called at each scrape."""
        self.service, self._labels, self._inbox, self._counts = service, (robot, service), inbox, counts
        self._health: Health | None = None
        self._last_health_time = time.monotonic()
        registry = self.registry = new_registry()
        registry.register(self)
        add_build_info(registry, *self._labels)
        uptime, health_age = gauge(registry, "presage_uptime_seconds"), gauge(registry, "presage_health_age_seconds")
        uptime.labels(*self._labels).set_function(lambda: time.monotonic() - counts().began)
        health_age.labels(*self._labels).set_function(lambda: time.monotonic() - self._last_health_time)
        self._rate = gauge(registry, "presage_message_rate_hertz")
        self._free_energy = gauge(registry, "presage_free_energy_nats")
        self._probability = gauge(registry, "presage_pose_probability")
        states = {Belief: "presage_estimator_state", Status: "presage_controller_state"}
        self._states = {kind: gauge(registry, name) for kind, name in states.items()}
        self._latency, self._duration = (
            Histogram(name, BY_NAME[name].about, TOPIC_LABELS, buckets=BUCKETS_S, registry=registry)
            for name in ("presage_message_latency_seconds", "presage_step_duration_seconds")
        )
        # By key: finding a histogram by its labels costs as much as an observation.
        self._children: dict[str, tuple[Histogram, Histogram]] = {}

    @contextmanager
    def step(self, sample: Sample) -> Iterator[None]:
        """Measures latency and duration while the block handles ``sample``."""
        key = self._inbox.counter_name(sample.key)
        if key not in self._children:
            robot, topic = topic_labels(key)
            labels = (robot, self.service, topic)
            self._children[key] = (self._latency.labels(*labels), self._duration.labels(*labels))
        latency, duration = self._children[key]
        if sample.published_ns:
            latency.observe(max(0.0, (time.time_ns() - sample.published_ns) * 1e-9))
        with duration.time():
            yield

    def published(self, key: str, message: Stamped) -> None:
        """Updates the gauges with a message that was just published."""
        robot, _ = topic_labels(key)
        if isinstance(message, Health):
            self._health, self._last_health_time = message, time.monotonic()
            for labels, rate in self._by_topic({row.key: row.rate for row in message.topics}):
                self._rate.labels(*labels).set(rate)
        elif isinstance(message, Belief | Status):
            for state in STATES[type(message)]:
                self._states[type(message)].labels(robot, self.service, state).set(state == message.state)
            if isinstance(message, Belief) and message.free_energy is not None:
                self._free_energy.labels(robot, self.service).set(message.free_energy)
            if isinstance(message, Belief) and message.probability is not None:
                self._probability.labels(robot, self.service).set(message.probability)

    def collect(self) -> Iterator[Metric]:
        """Yields the counters."""
        counts = self._counts()
        received, dropped, oversized = self._inbox.received_counts()
        undecodable = counts.undecodable
        counters = {
            "received": received,
            # All received keys, also with 0: Prometheus needs a first value to compute a rate.
            "dropped": {key: dropped[key] for key in received},
            "undecodable": {key: undecodable.get(key, 0) + oversized[key] for key in received},
        }
        for name, by_key in counters.items():
            requests = [((*self._labels, key), number) for key, number in by_key.items() if not is_message_counter(key)]
            yield _counter(f"presage_messages_{name}", self._by_topic(by_key))
            yield _counter(f"presage_requests_{name}", requests)
        yield _counter("presage_messages_published", self._by_topic(counts.published))
        yield _counter("presage_steps_failed", [(self._labels, counts.failed)])
        events = dict(counts.events)
        if (written := events.pop("written_bytes", None)) is not None:
            yield _counter("presage_recorder_written_bytes", [(self._labels, written)])
        yield _counter("presage_events", [((*self._labels, name), number) for name, number in events.items()])
        if self.service == "recorder" and (health := self._health) is not None:
            for name in ("written", "missing"):
                values = self._by_topic({row.key: getattr(row, name) for row in health.topics})
                yield _counter(f"presage_recorder_messages_{name}", values)

    def _by_topic(self, by_key: Mapping[str, float]) -> Values:
        for key, number in by_key.items():
            if is_message_counter(key):
                robot, topic = topic_labels(key)
                yield (robot, self.service, topic), number


def _counter(name: str, values: Values) -> CounterMetricFamily:
    definition = BY_NAME[name]
    metric = CounterMetricFamily(name, definition.about, labels=definition.labels)
    for labels, value in values:
        metric.add_metric(labels, value)
    return metric


def table() -> str:
    """The table of all metrics, as Markdown."""
    head = ["| metric | kind | labels | of | what |", "|---|---|---|---|---|"]
    rows = [
        f"| `{m.sample}` | {m.kind} | {', '.join(m.labels) or '-'} | {m.exported_by} | {m.about} |" for m in METRICS
    ]
    return "\n".join([*head, *rows])


if __name__ == "__main__":
    print(table())
