"""A service's Prometheus metrics.

`python -m common.runtime.metrics` prints the table of docs/operations.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, disable_created_metrics
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from common.messages.definitions import Belief, Health, Stamped, Status
from common.messages.topics import ROOT
from common.versions import PROTOCOL, versions

if TYPE_CHECKING:
    from common.bus.inbox import Inbox, Sample

SECONDS = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.066, 0.125, 0.25, 0.5, 1.0, 2.5)  # 0.066: a scan's time
TOPIC, PLAIN = ("robot", "service", "topic"), ("robot", "service")
STATES = {kind: get_args(kind.model_fields["state"].annotation) for kind in (Belief, Status)}


@dataclass(frozen=True)
class Row:
    """One metric: its name without the suffixes that Prometheus's text format adds."""

    name: str
    kind: str  # counter, gauge, histogram, info
    labels: tuple[str, ...]
    about: str
    of: str = "every service"

    @property
    def sample(self) -> str:
        """The name to query."""
        return self.name + {"counter": "_total", "info": "_info"}.get(self.kind, "")


RECORDER = "the recorder"
ROWS: tuple[Row, ...] = (
    Row("presage_messages_received", "counter", TOPIC, "Messages that came from the bus"),
    Row("presage_messages_published", "counter", TOPIC, "Messages put on the bus"),
    Row("presage_messages_dropped", "counter", TOPIC, "Messages not used: a newer one came, or the queue was full"),
    Row("presage_messages_undecodable", "counter", TOPIC, "Payloads that are not the message they should be"),
    Row("presage_message_rate_hertz", "gauge", TOPIC, "Messages a second, over the second before the last pulse"),
    Row(
        "presage_message_latency_seconds", "histogram", TOPIC,
        "From a message's publication to its handling, by both hosts' clocks",
    ),
    Row("presage_step_duration_seconds", "histogram", TOPIC, "Handling one message, answers published included"),
    Row("presage_requests_received", "counter", (*PLAIN, "query"), "Requests that came"),
    Row("presage_requests_dropped", "counter", (*PLAIN, "query"), "Requests refused because too many waited"),
    Row("presage_requests_undecodable", "counter", (*PLAIN, "query"), "Requests that made no sense"),
    Row("presage_steps_failed", "counter", PLAIN, "Steps that ended in an exception, which was logged"),
    Row("presage_events", "counter", (*PLAIN, "event"), "The service's own counters, by name, as in its health"),
    Row("presage_uptime_seconds", "gauge", PLAIN, "Since the service's loop was made"),
    Row("presage_pulse_age_seconds", "gauge", PLAIN, "Since the last pulse; each second while the loop turns"),
    Row("presage_free_energy_nats", "gauge", PLAIN, "Free energy of the last belief", "the estimator"),
    Row("presage_estimator_state", "gauge", (*PLAIN, "state"), "1 for the last belief's state", "the estimator"),
    Row("presage_controller_state", "gauge", (*PLAIN, "state"), "1 for the last status's state", "the controller"),
    Row("presage_recorder_messages_written", "counter", TOPIC, "Messages written into recordings", RECORDER),
    Row("presage_recorder_messages_missing", "counter", TOPIC, "Messages sent and never received, by number", RECORDER),
    Row("presage_recorder_written_bytes", "counter", PLAIN, "Payload bytes written, before compression", RECORDER),
    Row(
        "presage_build", "info", (*PLAIN, "version", "protocol", "zenoh", "python", "commit"),
        "Always 1; the labels say what runs", "every service, the router",
    ),
    Row("presage_router_uptime_seconds", "gauge", (), "Since the router listens", "the router"),
    Row("presage_router_sessions", "gauge", (), "Sessions linked with the router", "the router"),
)  # fmt: skip
BY_NAME = {row.name: row for row in ROWS}
Values = Iterable[tuple[tuple[str, ...], float]]


def family(name: str, values: Values) -> Metric:
    """A counter or gauge of the table with its values by label."""
    row = BY_NAME[name]
    made = (CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily)(name, row.about, labels=row.labels)
    for labels, value in values:
        made.add_metric(labels, value)
    return made


def build_info(robot: str, service: str) -> Metric:
    """What runs, as labels."""
    known, row = versions(), BY_NAME["presage_build"]
    said = {"version": "presage", "zenoh": "eclipse-zenoh", "python": "python", "commit": "commit"}
    values = {label: known.get(name, "unknown") for label, name in said.items()}
    labels = {"robot": robot, "service": service, "protocol": str(PROTOCOL), **values}
    made = InfoMetricFamily(row.name, row.about, labels=row.labels)
    made.add_metric([labels[name] for name in row.labels], {})
    return made


def new_registry(collector: Collector) -> CollectorRegistry:
    """With the process's own CPU, memory and files beside the collector."""
    disable_created_metrics()  # type: ignore[no-untyped-call]
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    registry.register(collector)
    return registry


def topic_labels(key: str) -> tuple[str, str]:
    """Robot and topic of a key; of a name that is no key of ours, nobody's."""
    parts = key.split("/", 2)
    return (parts[1], parts[2]) if len(parts) == 3 and parts[0] == ROOT else ("", key)


class ServiceMetrics(Collector):
    """Of one service. The loop tells what it does; a scrape, from another thread, reads."""

    def __init__(self, robot: str, service: str, inbox: Inbox, counts: Callable[[], Mapping[str, Any]]) -> None:
        """``counts()``: published and undecodable by key, failed, events by name, and began (s, monotonic)."""
        self.robot, self.service, self._inbox, self._counts = robot, service, inbox, counts
        self._last: dict[str, Belief | Status] = {}  # by robot
        self._health: Health | None = None
        self._pulse_at = time.monotonic()
        self.registry = new_registry(self)
        rows = [BY_NAME[name] for name in ("presage_message_latency_seconds", "presage_step_duration_seconds")]
        self._latency, self._duration = (
            Histogram(row.name, row.about, row.labels, buckets=SECONDS, registry=self.registry) for row in rows
        )
        self._children: dict[str, tuple[Histogram, Histogram]] = {}  # by key; a look-up is no cheaper than observing

    @contextmanager
    def step(self, sample: Sample) -> Iterator[None]:
        """While the sample is handled."""
        key = self._inbox.counted_as(sample.key)
        if key not in self._children:
            robot, topic = topic_labels(key)
            labels = (robot, self.service, topic)
            self._children[key] = (self._latency.labels(*labels), self._duration.labels(*labels))
        latency, duration = self._children[key]
        if sample.published_ns:
            latency.observe(max(0.0, (time.time_ns() - sample.published_ns) * 1e-9))
        began = time.perf_counter()
        try:
            yield
        finally:
            duration.observe(time.perf_counter() - began)

    def published(self, key: str, message: Stamped) -> None:
        """What was just sent."""
        if isinstance(message, Health):
            self._health, self._pulse_at = message, time.monotonic()
        elif isinstance(message, Belief | Status):
            self._last[topic_labels(key)[0]] = message

    def collect(self) -> Iterator[Metric]:
        """All but the histograms, which are collectors of their own."""
        whose, now, counts = (self.robot, self.service), time.monotonic(), self._counts()
        with_waiting, dropped, oversized = self._inbox.arrivals()
        bad = counts["undecodable"]
        faults = {
            "received": with_waiting,
            # A key that came has its faults counted from 0: a rate needs a beginning.
            "dropped": {key: dropped[key] for key in with_waiting},
            "undecodable": {key: bad.get(key, 0) + oversized[key] for key in with_waiting},
        }
        for what, by_key in faults.items():
            yield family(f"presage_messages_{what}", self._by_topic(by_key))
            yield family(f"presage_requests_{what}", [((*whose, k), n) for k, n in by_key.items() if not _is_key(k)])
        yield family("presage_messages_published", self._by_topic(counts["published"]))
        yield family("presage_steps_failed", [(whose, counts["failed"])])
        events = dict(counts["events"])
        if (written := events.pop("written_bytes", None)) is not None:
            yield family("presage_recorder_written_bytes", [(whose, written)])
        yield family("presage_events", [((*whose, name), number) for name, number in events.items()])
        yield family("presage_uptime_seconds", [(whose, now - counts["began"])])
        yield family("presage_pulse_age_seconds", [(whose, now - self._pulse_at)])
        yield build_info(*whose)
        yield from self._of_health()
        yield from self._of_states()

    def _by_topic(self, by_key: Mapping[str, float]) -> Values:
        for key, number in by_key.items():
            if _is_key(key):
                robot, topic = topic_labels(key)
                yield (robot, self.service, topic), number

    def _of_health(self) -> Iterator[Metric]:
        """What only the last pulse has."""
        rows = () if self._health is None else self._health.topics
        yield family("presage_message_rate_hertz", self._by_topic({row.key: row.rate for row in rows}))
        if self.service == "recorder":
            for what in ("written", "missing"):
                values = self._by_topic({row.key: getattr(row, what) for row in rows})
                yield family(f"presage_recorder_messages_{what}", values)

    def _of_states(self) -> Iterator[Metric]:
        last = dict(self._last)
        beliefs = {robot: message for robot, message in last.items() if isinstance(message, Belief)}
        if beliefs:
            values = [((robot, self.service), belief.free_energy) for robot, belief in beliefs.items()]
            yield family("presage_free_energy_nats", values)
        for name, kind in (("presage_estimator_state", Belief), ("presage_controller_state", Status)):
            states: list[tuple[tuple[str, ...], float]] = [
                ((robot, self.service, state), float(state == message.state))
                for robot, message in last.items() if isinstance(message, kind) for state in STATES[kind]
            ]  # fmt: skip
            if states:
                yield family(name, states)


def _is_key(name: str) -> bool:
    """Whether it counts messages; what was asked is counted by the query's name."""
    return "/" in name or name == "others"


def table() -> str:
    """Of docs/operations.md."""
    head = ["| metric | kind | labels | of | what |", "|---|---|---|---|---|"]
    return "\n".join(
        [*head, *(f"| `{r.sample}` | {r.kind} | {', '.join(r.labels) or '-'} | {r.of} | {r.about} |" for r in ROWS)]
    )


if __name__ == "__main__":
    print(table())
