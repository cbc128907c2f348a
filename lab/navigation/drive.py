"""The numbers of one drive.

Definitions. A scan with a contact counts as moving where the true speed is above `MOVES` before or after it. The path's
ratio is (driven + straight on to the goal from where it ended) over the shortest way with clearance (`shortest`), so
that stopping short of the goal saves nothing. The time's ratio is that until the controller says `reached`, from the
first scan on, over `shortest.least_trip`; its bound's is that of a base which need not turn, and which none can beat.
"""

from __future__ import annotations

import re
from collections import defaultdict
from itertools import pairwise
from typing import Any

import numpy as np
import shapely

from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Goal, Pose, Truth
from common.robot.base import Robot
from lab.experiments.lockstep import Track
from lab.navigation.shortest_path import Trip, least_trip, length
from services.simulator.people import RADIUS as PERSON

MOVES = 0.01  # m/s
TOLERANCE = float(Goal(stamp_ns=0, pose=Pose(x=0, y=0)).tolerance)  # m
TRULY = TOLERANCE + 0.1  # m, a goal that is said to be reached is no farther away than this
EVENTS = 200  # kept of a trial


def measure(track: Track, trip: Trip, world: World, robot: Robot) -> dict[str, Any]:
    """Plain values; s, m, scans. What is not known is None."""
    path, seconds = track.path(), _seconds(track)
    left = float(np.hypot(*(path[-1, :2] - np.array(trip.goal))))
    shortest, driven = length(np.array(trip.shortest)), length(path)
    nimble = robot.model_copy(update={"drive": "holonomic"})
    least, bound = (least_trip(trip.shortest, trip.start[2], each, TOLERANCE) for each in (robot, nimble))
    outcome = _outcome(track, left)
    return {
        "outcome": outcome,
        "reached": outcome == "reached",
        "why": _why(track, outcome, left),
        "seconds": seconds,
        "left_m": left,
        "shortest_m": shortest,
        "driven_m": driven,
        "path_over_shortest": (driven + left) / shortest,
        "least_s": least,
        "time_over_least": seconds / least,
        "time_over_bound": seconds / bound,
        **_touching(track),
        "held_back": sum(truth.stopped for truth in track.truths),  # scans, by the obstacle stop
        "clearance_m": float(_clearance(world, path).min()) - robot.radius,
        "clearance_to_people_m": _apart_from_people(track, robot),
        **_localised(track),
        "replans": max(0, len(set(track.plans)) - 1),
        **_times(track),
        **_steps(track),
        "events": _events(track),
        "x_m": np.round(path[:, 0], 3).tolist(),
        "y_m": np.round(path[:, 1], 3).tolist(),
    }


def _seconds(track: Track) -> float:
    return track.truths[-1].stamp_ns * 1e-9


def _outcome(track: Track, left: float) -> str:
    last = track.statuses[max(track.statuses)] if track.statuses else None
    if track.failure:
        return "failed"
    if last is not None and last.state == "reached":
        return "reached" if left <= TRULY else "claimed elsewhere"
    return "refused" if last is not None and last.refused else "too late"


def _why(track: Track, outcome: str, left: float) -> str:
    """In a line, for what was not reached."""
    if outcome == "reached":
        return ""
    last = track.statuses[max(track.statuses)] if track.statuses else None
    said = f"; at last {last.state}: {last.reason}" if last is not None else ""
    return track.failure or f"{left:.2f} m from the goal after {_seconds(track):.1f} s{said}"


def _touching(track: Track) -> dict[str, Any]:
    """Scans with a contact, by whether the robot moved; and where the first were."""
    speed = np.array([np.hypot(truth.twist.vx, truth.twist.vy) for truth in track.truths])
    moves = np.maximum(speed, np.concatenate([speed[:1], speed[:-1]])) > MOVES
    touches = np.array([truth.contact for truth in track.truths], bool)
    return {
        "contacts_moving": int((touches & moves).sum()),
        "contacts_standing": int((touches & ~moves).sum()),
        "contact_at": [_contact(track.truths[k], float(speed[k])) for k in np.flatnonzero(touches)[:10]],
    }


def _contact(truth: Truth, speed: float) -> dict[str, Any]:
    """When and where, how fast, and where the nearest person stood."""
    x, y, yaw = (round(float(value), 3) for value in truth.pose.array())
    person = None
    if len(truth.people):
        nearest = int(np.argmin(np.hypot(*(truth.people - (x, y)).T)))
        person = [round(float(value), 3) for value in truth.people[nearest]]
    now = round(truth.stamp_ns * 1e-9, 2)
    return {"s": now, "x": x, "y": y, "yaw": yaw, "speed": round(speed, 3), "person": person}


def _clearance(world: World, path: Array) -> Array:
    """(N,) m from the way between each two places (N, 3) to the nearest wall."""
    ends = np.stack([np.concatenate([path[:1], path[:-1]])[:, :2], path[:, :2]], axis=1)
    edges = shapely.boundary(world.free_space)
    return np.asarray(shapely.distance(shapely.linestrings(ends), edges))


def _apart_from_people(track: Track, robot: Robot) -> float | None:
    apart = [np.hypot(*(truth.people - truth.pose.array()[:2]).T).min() for truth in track.truths if len(truth.people)]
    return float(min(apart)) - robot.radius - PERSON if apart else None


def _localised(track: Track) -> dict[str, Any]:
    """Error since it first claims to know, and when that was; of the claims alone; for how long it claims nothing."""
    count = min(len(track.truths), len(track.beliefs))  # one less where it was cut short
    tracking = np.array([belief.state == "tracking" for belief in track.beliefs[:count]], bool)
    if not tracking.any():
        return dict.fromkeys(("tracking_s", "untracked_s", "error_median_m", "error_max_m", "claimed_error_max_m"))
    first = int(np.argmax(tracking))
    error = np.hypot(*(track.believed()[first:count] - track.path()[first:count])[:, :2].T)
    return {
        "tracking_s": track.truths[first].stamp_ns * 1e-9,
        "untracked_s": float(np.mean(~tracking[first:])) * (_seconds(track) - track.truths[first].stamp_ns * 1e-9),
        "error_median_m": float(np.median(error)),
        "error_max_m": float(error.max()),
        "claimed_error_max_m": float(error[tracking[first:]].max()),
    }


def _times(track: Track) -> dict[str, Any]:
    """Seconds in each state, and of those for each reason, its numbers left out."""
    stamps = sorted(track.statuses)
    states: dict[str, float] = defaultdict(float)
    reasons: dict[str, float] = defaultdict(float)
    for stamp, until in pairwise(stamps):
        status, seconds = track.statuses[stamp], (until - stamp) * 1e-9
        states[status.state] += seconds
        if status.reason:
            reasons[f"{status.state}: {plain(status.reason)}"] += seconds
    return {
        name: {what: round(seconds, 3) for what, seconds in table.items()}
        for name, table in (("state_s", states), ("reason_s", reasons))
    }


def plain(reason: str) -> str:
    """A reason without where and how far: "waiting: something that may move, 0.8 m away at (1, 3)" up to the comma."""
    return re.sub(r"(,? \d[\d.]* m away)?( at| to)? \(-?[\d.]+, -?[\d.]+\)", "", reason)


def _steps(track: Track) -> dict[str, Any]:
    """CPU time of the controller's steps, by its own counters."""
    counters = track.health.counters if track.health is not None else {}
    steps, us, most = (counters.get(name) for name in ("steps", "step_us", "step_us_max"))
    return {
        "step_mean_ms": us / steps * 1e-3 if steps and us is not None else None,
        "step_max_ms": most * 1e-3 if most is not None else None,
    }


def _events(track: Track) -> list[list[Any]]:
    """[s, state, reason] wherever one of the two changes, numbers aside."""
    events: list[list[Any]] = []
    before = ("", "")
    for stamp in sorted(track.statuses):
        status = track.statuses[stamp]
        now = (status.state, plain(status.reason))
        if now != before and len(events) < EVENTS:
            events.append([round(stamp * 1e-9, 3), status.state, status.reason])
        before = now
    return events
