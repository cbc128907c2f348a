"""Injects one fault and measures detection, stop and recovery."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

from common.errors import UserError
from lab.fault_injection.faults import Fault
from lab.fault_injection.system import System
from lab.fault_injection.timeline import Row, Timeline, back, gone, moving, standing, truth, worried

STOP_WITHIN = 0.5  # s, standing after losing any part of the loop
AGAIN_WITHIN = 3.0  # s, at work after the part's return
GOES_ON = 0.2  # m/s: it slows for corners, too (row `nothing`)
BRAKES = 0.97  # of the speed it had
PATIENCE = 40.0  # s
AFTERWARDS = 1.0  # s that are still looked at


@dataclass
class Outcome:
    """One row of the table. Times in s; None: does not apply, or never."""

    fault: str
    about: str
    expect: str
    detected_s: float | None = None  # from the fault: a token gone, the controller says so, or the robot brakes
    stopped_s: float | None = None  # from the fault until the robot stands
    start_s: float | None = None  # of a killed part: its new process, until it says that it is there
    again_s: float | None = None  # from the part's return until the robot is under way again, or the part works
    least_speed: float | None = None  # m/s meanwhile, where the robot is to go on
    contact: bool = False
    why: str = ""  # what is not as it should be; empty: as expected

    def row(self) -> dict[str, Any]:
        """Plain."""
        return asdict(self)


def measure(system: System, fault: Fault) -> Outcome:
    """Raises UserError where the system cannot be brought to work before, or after."""
    outcome, timeline = Outcome(fault.name, fault.about, fault.expect), system.timeline
    before = system.drive()
    timeline.forget(time.monotonic() - 30)
    began = time.monotonic()
    fault.begin(system)
    try:
        if fault.expect == "stops" and not fault.base:
            stand = _seen(timeline, began, standing, PATIENCE)
            outcome.stopped_s = None if stand is None else stand["t"] - began
        time.sleep(max(0.0, began + fault.lasts - time.monotonic()))
    finally:
        ending = time.monotonic()
        fault.end(system)
    returned = time.monotonic()
    if fault.again:
        outcome.start_s = returned - ending
    _look_again(system, fault, returned, outcome)
    time.sleep(AFTERWARDS)
    _look_back(timeline, began, before["speed"], fault, outcome)
    outcome.why = judge(outcome, fault)
    return outcome


def _look_again(system: System, fault: Fault, returned: float, outcome: Outcome) -> None:
    """When the robot goes on, or the part does."""
    timeline = system.timeline
    if fault.expect == "goes on":
        works = [_seen(timeline, returned, _pulse(name), PATIENCE) for name in fault.services if name != "router"]
        if works and None not in works:
            outcome.again_s = max(row["t"] for row in works if row is not None) - returned
        return
    if fault.expect == "survives":
        system.aim()  # it may have come to its goal meanwhile
    row = _seen(timeline, returned, moving, PATIENCE)
    outcome.again_s = None if row is None else row["t"] - returned


def _pulse(service: str) -> Any:
    return lambda row: (row["what"] == "health" and row["service"] == service) or back(service)(row)


def _seen(timeline: Timeline, since: float, wanted: Any, timeout: float) -> Row | None:
    try:
        return timeline.wait(since, wanted, timeout, "")
    except UserError:
        return None


def _look_back(timeline: Timeline, began: float, speed: float, fault: Fault, outcome: Outcome) -> None:
    """What is read from the rows once all is over."""

    def sign(row: Row) -> bool:
        if any(gone(name)(row) for name in fault.services) or worried(row):
            return True
        if row["what"] == "line" and any(word in row["line"] for word in ("standing by", "No space left", "full")):
            return True
        return fault.expect == "stops" and truth(row) and row["speed"] < BRAKES * speed

    first = timeline.first(began, sign)
    outcome.detected_s = None if first is None else first["t"] - began
    outcome.contact = timeline.first(began, lambda r: truth(r) and r["contact"]) is not None
    if fault.expect == "goes on":
        reached = timeline.first(began, lambda r: r["what"] == "status" and (r["distance"] or 9.0) < 1.5)
        until = float("inf") if reached is None else reached["t"]
        speeds = [row["speed"] for row in timeline.rows if truth(row) and began <= row["t"] < until]
        outcome.least_speed = min(speeds) if speeds else None


def judge(outcome: Outcome, fault: Fault) -> str:
    """What is not as the fault's row expects; empty: nothing."""
    wrong = []
    if outcome.contact:
        wrong.append("contact")
    if fault.expect == "stops" and not fault.base:
        if outcome.stopped_s is None:
            wrong.append("never stood")
        elif outcome.stopped_s > STOP_WITHIN:
            wrong.append(f"stood after more than {STOP_WITHIN:g} s")
    if fault.expect == "goes on" and (outcome.least_speed is None or outcome.least_speed < GOES_ON):
        wrong.append("the robot did not go on")
    if fault.expect != "goes on" or outcome.again_s is not None:
        if outcome.again_s is None:
            wrong.append("never at work again")
        elif outcome.again_s > AGAIN_WITHIN:
            wrong.append(f"at work only after more than {AGAIN_WITHIN:g} s")
    return "; ".join(wrong)
