"""Watches which services of a robot are alive, since when, and what is wrong with them.

`presage top`, `presage doctor`, the live page and the health checks of containers all use it and only show its
results. It imports only the standard library, so that a health check starts in 20 ms. Times are s of a monotonic clock.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from common.messages.definitions import Health

REQUIRED_SERVICES = ("simulator", "estimator", "controller")  # a robot needs all of them to navigate
OPTIONAL_SERVICES = ("recorder", "viewer")
REPLAY = "replay"  # publishes the messages of all other services, and no health messages
SUBSTITUTES = {"simulator": "bridge_ros2", "estimator": "mapper"}  # services that take the place of another

REPORT_TIMEOUT_S = 2.5  # a service is silent if its last report (health message or heartbeat, one a second) is older
INPUT_TIMEOUT_S = 2.0  # inputs newer than this count as arriving
RESULT_TIMEOUT_S = 5.0  # without a result while inputs arrive, a service is faulty
FORGET_AFTER_S = 30.0  # a service that ended longer ago is no longer listed
MAX_SERVICES = 50  # limits the memory if a program publishes health messages with made-up names

# For each service: its input, or None, and the result that must follow while this input arrives. Without an input, the
# result must always come. Input and result are a topic (* for any) and the kind of its count. `remote` watches a robot
# outside its own containers.
EXPECTED_RESULTS = {
    "simulator": (None, ("scan", "published")),
    "bridge_ros2": (None, ("scan", "published")),
    "replay": (None, ("scan", "published")),
    "remote": (None, ("scan", "received")),
    "estimator": (("scan", "received"), ("belief", "published")),
    "mapper": (("scan", "received"), ("belief", "published")),
    "controller": (("belief", "received"), ("status", "published")),
    "recorder": (("*", "received"), ("*", "written")),
}
COUNT_KINDS = ("received", "published", "written")

LivenessState = Literal["alive", "silent", "absent"]


@dataclass(frozen=True)
class Report:
    """The last report of a service about itself, from a health message or a heartbeat file."""

    time: float  # of the report
    linked: bool = True  # connected to at least one other session
    note: str = ""
    idle: bool = False  # publishes no results on purpose
    # by key and kind: when the count last increased
    increased_at: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ServiceStatus:
    """The state of one service. A silent service is connected but has stopped reporting."""

    name: str
    state: LivenessState
    problem: str = ""  # empty if the service needs no attention
    since: float | None = None  # time at which the state began; None if the service was not seen
    health: Health | None = None  # its last health message
    age: float | None = None  # s since its last health message

    @property
    def has_started(self) -> bool:
        """Whether its first health message has come; always true for a replay, which sends none."""
        return self.health is not None or self.name == REPLAY

    @property
    def text(self) -> str:
        """The problem and the service's own note, in one line."""
        note = self.health.note if self.health is not None else ""
        return f"{self.problem} ({note})" if self.problem and note else self.problem or note


def find_problem(service: str, robot: str, report: Report, now: float, default_time: float = -math.inf) -> str:
    """The problem of a connected service by its last report; empty if it is healthy.

    ``default_time`` stands in for the time of the last result while there is none.
    """
    if (age := now - report.time) > REPORT_TIMEOUT_S:
        return f"no report for {age:.0f} s: it is stopped, hangs, or gets no processor time"
    if not report.linked:
        return "not connected to any session; is the router running?"
    if service not in EXPECTED_RESULTS or report.idle:
        return ""
    needed, (topic, kind) = EXPECTED_RESULTS[service]
    if needed is not None and now - _last_time(report, robot, *needed) > INPUT_TIMEOUT_S:
        return ""
    age = now - max(default_time, _last_time(report, robot, topic, kind))
    if age <= RESULT_TIMEOUT_S:
        return ""
    how_long = f"for {age:.0f} s" if math.isfinite(age) else "so far"
    return f"no {'message' if topic == '*' else topic} was {kind} {how_long}"


def _last_time(report: Report, robot: str, topic: str, kind: str) -> float:
    """Time at which the count of a topic last increased."""
    stem = f"presage/{robot}/"
    times = report.increased_at.items()
    rows = [row for key, row in times if key.startswith(stem) and topic in ("*", key.removeprefix(stem))]
    return max((row[kind] for row in rows if kind in row), default=-math.inf)


class CountTimes:
    """Remembers when each count of a service last increased."""

    def __init__(self) -> None:
        self.increased_at: dict[str, dict[str, float]] = {}  # by key and kind
        self._counts: dict[tuple[str, str], int] = {}

    def update(self, counts: Mapping[str, Mapping[str, int]], now: float) -> None:
        """Stores the totals so far, by key and kind."""
        for key, row in counts.items():
            for kind in COUNT_KINDS:
                count = row.get(kind, 0)
                if count > self._counts.get((key, kind), 0):
                    self.increased_at.setdefault(key, {})[kind] = now
                self._counts[key, kind] = count


def counts_of(health: Health) -> dict[str, dict[str, int]]:
    """The totals of a health message, by key and kind."""
    return {row.key: {kind: getattr(row, kind) for kind in COUNT_KINDS} for row in health.topics}


@dataclass
class _Service:
    """Observations of one run of a service."""

    began: float  # first sign of life
    report: Report  # empty until the first health message
    token_at: float = -math.inf  # when its liveliness token was last seen
    has_token: bool = False
    health: Health | None = None
    times: CountTimes = field(default_factory=CountTimes)

    def present(self, now: float) -> bool:
        """Whether it is connected. A recent report is enough: tokens disappear while a link is re-established."""
        return self.has_token or now - self.report.time <= REPORT_TIMEOUT_S


class ServiceMonitor:
    """The services of one robot, from their liveliness tokens and health messages."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self._services: dict[str, _Service] = {}
        self._scan_at = -math.inf

    def set_alive(self, names: Collection[str], now: float) -> None:
        """Stores the names of all services that have a liveliness token. Call it about once a second."""
        for name in names:
            if (service := self._find_or_add(name, now)) is not None:
                service.has_token, service.token_at = True, now
        for name, service in list(self._services.items()):
            service.has_token = name in names
            if not service.has_token and now - max(service.token_at, service.report.time) > FORGET_AFTER_S:
                del self._services[name]

    def add_health(self, health: Health, now: float) -> None:
        """Stores a health message.

        Ignores those of an idle instance while another one works: the recorder that `presage up` keeps ready is idle
        while `presage record` records.
        """
        last = self._services.get(health.service)
        if last is not None and last.health is not None and health.idle and not last.health.idle:
            other = health.instance != last.health.instance
            if other and now - last.report.time <= REPORT_TIMEOUT_S:
                return
        service = self._find_or_add(health.service, now)
        if service is not None and service.health is not None and health.uptime < service.health.uptime:
            self._services.pop(health.service)  # the service was restarted
            service = self._find_or_add(health.service, now)
        if service is None:
            return
        service.times.update(counts_of(health), now)
        service.health = health
        service.report = Report(now, note=health.note, idle=health.idle, increased_at=service.times.increased_at)

    def add_scan(self, now: float) -> None:
        """Stores the arrival of a scan. While scans arrive, as from a robot's own driver, no simulator is needed."""
        self._scan_at = now

    def services(self, now: float) -> list[ServiceStatus]:
        """First the services that a session usually has, present or not, then the others by name."""
        usual = [*REQUIRED_SERVICES, *OPTIONAL_SERVICES]
        return [self._state(name, now) for name in (*usual, *sorted(self._services.keys() - set(usual)))]

    def missing(self, now: float) -> list[str]:
        """Absent services that the robot needs to navigate."""
        return [name for name in REQUIRED_SERVICES if not self.present(name, now) and self._is_needed(name, now)]

    def present(self, name: str, now: float) -> bool:
        """Whether a service is alive or silent."""
        return name in self._services and self._services[name].present(now)

    def _find_or_add(self, name: str, now: float) -> _Service | None:
        """The record of a service that has just shown a sign of life; a new one if it was absent.

        None if there are `MAX_SERVICES`.
        """
        usual = name in REQUIRED_SERVICES or name in OPTIONAL_SERVICES
        if name not in self._services and len(self._services) >= MAX_SERVICES and not usual:
            return None
        if not self.present(name, now):
            self._services[name] = _Service(now, Report(now))
        return self._services[name]

    def _is_needed(self, name: str, now: float) -> bool:
        """Whether the robot needs the service and nothing takes its place."""
        replaced = self.present(REPLAY, now) or (name in SUBSTITUTES and self.present(SUBSTITUTES[name], now))
        has_scans = name == "simulator" and now - self._scan_at <= INPUT_TIMEOUT_S
        return name in REQUIRED_SERVICES and not replaced and not has_scans

    def _state(self, name: str, now: float) -> ServiceStatus:
        service = self._services.get(name)
        if service is None:
            return ServiceStatus(name, "absent", "not running" if self._is_needed(name, now) else "")
        # A replay publishes no health messages: while it is connected, it counts as reporting.
        report = Report(now, idle=True) if name == REPLAY else service.report
        health = service.health
        age = now - report.time if health is not None else None
        if not service.present(now):
            since = max(service.token_at, service.report.time)
            return ServiceStatus(name, "absent", f"gone for {now - since:.0f} s", since, health, age)
        problem = find_problem(name, self.robot, report, now, default_time=service.began)
        if now - report.time > REPORT_TIMEOUT_S:
            return ServiceStatus(name, "silent", problem, report.time + REPORT_TIMEOUT_S, health, age)
        return ServiceStatus(name, "alive", problem, service.began, health, age)
