"""Injects one fault and measures detection, stop and recovery."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from common.errors import UserError
from lab.fault_injection.faults import Fault
from lab.fault_injection.system import System
from lab.fault_injection.timeline import Row, Timeline, is_back, is_gone, is_lost, is_moving, is_standing, is_truth

MAX_STOP_TIME_S = 0.5  # from the fault until the robot stands
MAX_RECOVERY_TIME_S = 3.0  # from a service's return until the robot drives again
MIN_SPEED = 0.2  # m/s, of a robot that keeps driving; it slows down for corners even without a fault
BRAKING_RATIO = 0.97  # of the speed before the fault; below it the robot counts as braking
EVENT_TIMEOUT_S = 40.0
OBSERVATION_TIME_S = 1.0  # after recovery


@dataclass
class FaultOutcome:
    """Result of one fault. Times are in s, and None if they do not apply or the event never happened."""

    fault: str
    about: str
    expect: str
    detected_s: float | None = None  # from the fault until the system reacts, see `_evaluate`
    stopped_s: float | None = None  # from the fault until the robot stands
    start_s: float | None = None  # from the restart of a killed service until its liveliness token appears
    again_s: float | None = None  # from a service's return until the robot drives, or the service works, again
    # During a fault in which the robot should keep driving.
    least_speed: float | None = None  # m/s
    driving_share: float | None = None  # share of the measured speeds that are at least `MIN_SPEED`
    contact: bool = False
    deviations: str = ""  # deviations from the expectation; empty if there are none

    def row(self) -> dict[str, Any]:
        """The result as a row of the JSON file."""
        row = asdict(self)
        row["why"] = row.pop("deviations")
        return row


def measure(system: System, fault: Fault) -> FaultOutcome:
    """Injects a fault while the robot drives at full speed. Returns the result.

    Raises UserError if the system does not work before the fault, or a service does not return after it.
    """
    outcome, timeline = FaultOutcome(fault.name, fault.about, fault.expect), system.timeline
    before = system.drive_fast()
    timeline.forget(time.monotonic() - 30)
    injected = time.monotonic()
    fault.begin(system)
    try:
        if fault.expect == "stops" and not fault.stops_simulator:
            stand = _wait_for(timeline, injected, is_standing, EVENT_TIMEOUT_S)
            outcome.stopped_s = None if stand is None else stand["t"] - injected
        time.sleep(max(0.0, injected + fault.duration - time.monotonic()))
    finally:
        ending = time.monotonic()
        fault.end(system)
    returned = time.monotonic()
    if fault.restarts_process:
        outcome.start_s = returned - ending
    _measure_recovery(system, fault, returned, outcome)
    time.sleep(OBSERVATION_TIME_S)
    _evaluate(timeline, injected, before["speed"], fault, outcome)
    outcome.deviations = judge(outcome, fault)
    return outcome


def _measure_recovery(system: System, fault: Fault, returned: float, outcome: FaultOutcome) -> None:
    """Measures when the robot drives again, or when the affected services work again."""
    timeline = system.timeline
    if fault.expect == "goes on":
        works = [
            _wait_for(timeline, returned, _is_working(name), EVENT_TIMEOUT_S)
            for name in fault.services
            if name != "router"
        ]
        if works and None not in works:
            outcome.again_s = max(row["t"] for row in works if row is not None) - returned
        return
    if fault.expect == "survives":
        system.set_far_goal()  # it may have reached its goal during the fault
    row = _wait_for(timeline, returned, is_moving, EVENT_TIMEOUT_S)
    outcome.again_s = None if row is None else row["t"] - returned


def _is_working(service: str) -> Callable[[Row], bool]:
    """Returns a predicate: whether an event is a health message of the service, or shows that it returned."""
    return lambda row: (row["what"] == "health" and row["service"] == service) or is_back(service)(row)


def _wait_for(timeline: Timeline, since: float, wanted: Callable[[Row], bool], timeout: float) -> Row | None:
    try:
        return timeline.wait(since, wanted, timeout, "")
    except UserError:
        return None


def _evaluate(timeline: Timeline, injected: float, speed: float, fault: Fault, outcome: FaultOutcome) -> None:
    """Derives detection, contact and lowest speed from the recorded events."""

    def is_detection(row: Row) -> bool:
        if any(is_gone(name)(row) for name in fault.services) or is_lost(row) or fault.is_detection(row):
            return True
        return fault.expect == "stops" and is_truth(row) and row["speed"] < BRAKING_RATIO * speed

    first = timeline.first(injected, is_detection)
    outcome.detected_s = None if first is None else first["t"] - injected
    outcome.contact = timeline.first(injected, lambda r: is_truth(r) and r["contact"]) is not None
    if fault.expect == "goes on":
        reached = timeline.first(injected, lambda r: r["what"] == "status" and (r["distance"] or 9.0) < 1.5)
        until = float("inf") if reached is None else reached["t"]
        speeds = [row["speed"] for row in timeline.rows if is_truth(row) and injected <= row["t"] < until]
        if speeds:
            outcome.least_speed = min(speeds)
            outcome.driving_share = sum(speed >= MIN_SPEED for speed in speeds) / len(speeds)


def judge(outcome: FaultOutcome, fault: Fault) -> str:
    """Deviations from what the fault expects, separated by semicolons; empty if there are none."""
    wrong = []
    if outcome.contact:
        wrong.append("contact")
    if fault.expect == "stops" and not fault.stops_simulator:
        if outcome.stopped_s is None:
            wrong.append("never stood")
        elif outcome.stopped_s > MAX_STOP_TIME_S:
            wrong.append(f"stood after more than {MAX_STOP_TIME_S:g} s")
    if fault.expect == "goes on" and (outcome.least_speed is None or outcome.least_speed < MIN_SPEED):
        wrong.append("the robot did not go on")
    if fault.expect != "goes on" or outcome.again_s is not None:
        if outcome.again_s is None:
            wrong.append("did not recover")
        elif outcome.again_s > MAX_RECOVERY_TIME_S:
            wrong.append(f"at work only after more than {MAX_RECOVERY_TIME_S:g} s")
    return "; ".join(wrong)
