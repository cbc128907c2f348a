"""Results of one drive.

Definitions:

- A scan with a contact counts as moving if the true speed is above `MIN_MOVING_SPEED` before or after it.
- The path ratio is the driven length, plus the straight distance left to the goal, divided by the length of the
  shortest path with clearance (`shortest_path`). Stopping short of the goal therefore gains nothing.
- The time ratio is the time from the first scan until the end of the drive, divided by a lower bound: at full speed
  around the corners of the shortest path, without a turn. `reached` means that the robot stands, so it must brake.
- The distance left to the goal is that of the last true pose.
"""

from __future__ import annotations

import re
from collections import defaultdict
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import GOAL_TOLERANCE_M, Truth
from common.robot.robot import Robot
from lab.experiments.lockstep import RunTrace
from lab.experiments.start_and_goal import least_time
from lab.navigation.shortest_path import NavigationTask, length
from services.simulator.people import PERSON_RADIUS_M

MIN_MOVING_SPEED = 0.01  # m/s
MAX_REACHED_DISTANCE = GOAL_TOLERANCE_M  # m; if the robot stands farther from the goal, a reported arrival is wrong
MAX_EVENTS = 200  # stored per trial
LOCALISATION = (
    "tracking_s",
    "untracked_s",
    "longest_untracked_s",
    "error_median_m",
    "error_max_m",
    "claimed_error_max_m",
)


def measure(trace: RunTrace, task: NavigationTask, world: World, robot: Robot) -> dict[str, Any]:
    """Statistics of a drive as a row of the results; None where a value is unknown."""
    path, seconds = trace.path(), trace.seconds
    distance_left = float(np.hypot(*(path[-1, :2] - np.array(task.goal))))
    shortest, driven = length(np.array(task.shortest)), length(path)
    least = least_time(shortest, robot, GOAL_TOLERANCE_M, stop=True)
    outcome = _outcome(trace, distance_left)
    return {
        "outcome": outcome,
        "reached": outcome == "reached",
        "why": _failure_reason(trace, outcome, distance_left),
        "seconds": seconds,
        "left_m": distance_left,
        "shortest_m": shortest,
        "driven_m": driven,
        "path_over_shortest": (driven + distance_left) / shortest,
        "least_s": least,
        "time_over_bound": seconds / least,
        **_contacts(trace),
        "held_back": sum(truth.stopped for truth in trace.truths),  # scans, by the obstacle stop
        "clearance_m": float(_clearance(world, path).min()) - robot.radius,
        "clearance_to_people_m": _clearance_to_people(trace, robot),
        **_localisation(trace),
        "replans": max(0, len(set(trace.plans)) - 1),
        **_times(trace),
        **_steps(trace),
        "events": _events(trace),
        "x_m": np.round(path[:, 0], 3).tolist(),
        "y_m": np.round(path[:, 1], 3).tolist(),
    }


def _outcome(trace: RunTrace, distance_left: float) -> str:
    last = trace.last_status
    if trace.failure:
        return "failed"
    if last is not None and last.state == "reached":
        return "reached" if distance_left <= MAX_REACHED_DISTANCE else "claimed elsewhere"
    return "refused" if last is not None and last.refused else "too late"


def _failure_reason(trace: RunTrace, outcome: str, distance_left: float) -> str:
    """Why the goal was not reached, in one line; empty if it was reached."""
    if outcome == "reached":
        return ""
    last = trace.last_status
    last_status = f"; at last {last.state}: {last.reason}" if last is not None else ""
    return trace.failure or f"{distance_left:.2f} m from the goal after {trace.seconds:.1f} s{last_status}"


def _contacts(trace: RunTrace) -> dict[str, Any]:
    """Numbers of scans with a contact, while moving and while standing, and the first ten contacts."""
    speed = np.array([np.hypot(truth.twist.vx, truth.twist.vy) for truth in trace.truths])
    moves = np.maximum(speed, np.concatenate([speed[:1], speed[:-1]])) > MIN_MOVING_SPEED
    touches = np.array([truth.contact for truth in trace.truths], bool)
    return {
        "contacts_moving": int((touches & moves).sum()),
        "contacts_standing": int((touches & ~moves).sum()),
        "contact_at": [_contact(trace.truths[k], float(speed[k])) for k in np.flatnonzero(touches)[:10]],
    }


def _contact(truth: Truth, speed: float) -> dict[str, Any]:
    """Time, pose and speed of a contact, and the nearest person's position."""
    x, y, yaw = (round(float(value), 3) for value in truth.pose.array())
    person = None
    if len(truth.people):
        nearest = int(np.argmin(np.hypot(*(truth.people - (x, y)).T)))
        person = [round(float(value), 3) for value in truth.people[nearest]]
    now = round(truth.stamp_ns * 1e-9, 2)
    return {"s": now, "x": x, "y": y, "yaw": yaw, "speed": round(speed, 3), "person": person}


def _clearance(world: World, path: Array) -> Array:
    """Distance (N,), m, from each segment of the path (N, 3) to the nearest wall."""
    ends = np.stack([np.concatenate([path[:1], path[:-1]])[:, :2], path[:, :2]], axis=1)
    edges = shapely.boundary(world.free_space)
    return np.asarray(shapely.distance(shapely.linestrings(ends), edges))


def _clearance_to_people(trace: RunTrace, robot: Robot) -> float | None:
    distances = [
        np.hypot(*(truth.people - truth.pose.array()[:2]).T).min() for truth in trace.truths if len(truth.people)
    ]
    return float(min(distances)) - robot.radius - PERSON_RADIUS_M if distances else None


def _localisation(trace: RunTrace) -> dict[str, Any]:
    """Localisation errors from the first belief in state `tracking` on, its time, and for how long tracking was lost.

    `claimed_error_max_m` covers only beliefs in state `tracking`. `longest_untracked_s` covers the whole drive; without
    a belief in this state, the other values are None.
    """
    count = min(len(trace.truths), len(trace.beliefs))  # an aborted run may lack the last belief
    tracking = np.array([belief.state == "tracking" for belief in trace.beliefs[:count]], bool)
    longest_untracked_s = _longest_untracked(trace, tracking)
    if not tracking.any():
        return dict.fromkeys(LOCALISATION) | {"longest_untracked_s": longest_untracked_s}
    first = int(np.argmax(tracking))
    error = np.hypot(*(trace.believed()[first:count] - trace.path()[first:count])[:, :2].T)
    return {
        "tracking_s": trace.truths[first].stamp_ns * 1e-9,
        "untracked_s": float(np.mean(~tracking[first:])) * (trace.seconds - trace.truths[first].stamp_ns * 1e-9),
        "longest_untracked_s": longest_untracked_s,
        "error_median_m": float(np.median(error)),
        "error_max_m": float(error.max()),
        "claimed_error_max_m": float(error[tracking[first:]].max()),
    }


def _longest_untracked(trace: RunTrace, tracking: npt.NDArray[np.bool_]) -> float:
    """Longest time in s without a belief in state `tracking`; 0 if all beliefs are in it."""
    stamps = np.array([truth.stamp_ns for truth in trace.truths[: len(tracking)]]) * 1e-9
    known = np.concatenate([stamps[:1], stamps[tracking], stamps[-1:]])
    gaps = np.diff(known)
    period = stamps[1] - stamps[0] if len(stamps) > 1 else 0.0
    return float(np.max(gaps[gaps > 1.5 * period], initial=0.0))


def _times(trace: RunTrace) -> dict[str, Any]:
    """Seconds spent in each state of the controller, and for each reason without its numbers."""
    stamps = sorted(trace.statuses)
    states: dict[str, float] = defaultdict(float)
    reasons: dict[str, float] = defaultdict(float)
    for stamp, until in pairwise(stamps):
        status, seconds = trace.statuses[stamp], (until - stamp) * 1e-9
        states[status.state] += seconds
        if status.reason:
            reasons[f"{status.state}: {strip_numbers(status.reason)}"] += seconds
    return {
        name: {what: round(seconds, 3) for what, seconds in table.items()}
        for name, table in (("state_s", states), ("reason_s", reasons))
    }


def strip_numbers(reason: str) -> str:
    """A status reason without distances and coordinates.

    "waiting: something that may move, 0.8 m away at (1, 3)" becomes "waiting: something that may move".
    """
    return re.sub(r"(,? \d[\d.]* m away)?( at| to)? \(-?[\d.]+, -?[\d.]+\)", "", reason)


def _steps(trace: RunTrace) -> dict[str, Any]:
    """Processor time of the controller's steps, from the counters in its health message."""
    counters = trace.health.counters if trace.health is not None else {}
    steps, us, us_max = (counters.get(name) for name in ("steps", "step_us", "step_us_max"))
    return {
        "step_mean_ms": us / steps * 1e-3 if steps and us is not None else None,
        "step_max_ms": us_max * 1e-3 if us_max is not None else None,
    }


def _events(trace: RunTrace) -> list[list[Any]]:
    """List of [time in s, state, reason] wherever the state or the reason without its numbers changes."""
    events: list[list[Any]] = []
    before = ("", "")
    for stamp in sorted(trace.statuses):
        status = trace.statuses[stamp]
        now = (status.state, strip_numbers(status.reason))
        if now != before and len(events) < MAX_EVENTS:
            events.append([round(stamp * 1e-9, 3), status.state, status.reason])
        before = now
    return events
