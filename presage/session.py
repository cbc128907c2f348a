"""What a recording holds, by kind, and the numbers it comes to."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from common.messages import Belief, Goal, Health, Prediction, Scan, Stamped, Status, Truth
from common.robot import Robot
from common.se2 import Array
from common.world import World
from services.recorder.reader import Raw, Recording, read_recording


@dataclass
class Session:
    """A recording's messages by kind, in the order received; one sent again with the same stamp stands once."""

    world: World | None = None
    robot: str = "unknown"
    base: Robot = field(default_factory=Robot)
    warning: str = ""  # empty: the recording is complete
    duration_s: float = 0.0  # by reception
    counts: dict[str, int] = field(default_factory=dict)  # by key
    undecodable: int = 0
    scans: list[Scan] = field(default_factory=list)
    truths: list[Truth] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)
    true_of: list[Truth | None] = field(default_factory=list)  # beside beliefs: the truth of the same stamp
    predictions: list[Prediction] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    goal_times_ns: list[int] = field(default_factory=list)  # beside goals: the session's own time when each came
    statuses: list[Status] = field(default_factory=list)
    healths: dict[str, Health] = field(default_factory=dict)  # the last of each service

    def true_path(self) -> Array:
        """(N, 3) true poses."""
        return np.array([t.pose.array() for t in self.truths]).reshape(-1, 3)

    def believed_path(self) -> Array:
        """(N, 3) believed poses."""
        return np.array([b.pose.array() for b in self.beliefs]).reshape(-1, 3)

    def errors(self) -> Array:
        """(N,) m, distance of each belief from the truth of the same stamp; NaN where there is none."""
        nowhere = np.full(3, np.nan)
        true = np.array([nowhere if t is None else t.pose.array() for t in self.true_of]).reshape(-1, 3)
        return np.asarray(np.hypot(*(self.believed_path() - true)[:, :2].T), float)

    def goal(self) -> Goal | None:
        """The last goal, unless it was cancelled."""
        return self.goals[-1] if self.goals and not self.goals[-1].cancel else None

    def localised(self) -> int | None:
        """Index of the first belief that claims to know the place."""
        return next((i for i, b in enumerate(self.beliefs) if b.state == "tracking"), None)

    def reached_ns(self) -> int | None:
        """Stamp at which the controller said that the last goal was reached."""
        goal = self.goal()
        if goal is None:
            return None
        after = self.goal_times_ns[-1]
        said = (
            s.stamp_ns for s in self.statuses if s.state == "reached" and s.goal == goal.pose and s.stamp_ns >= after
        )
        return next(said, None)


def load_session(path: Path) -> Session:
    """Read a recording; raises UserError where that is impossible."""
    return session_of(read_recording(path))


def session_of(recording: Recording) -> Session:
    """The recording's messages by kind."""
    session = Session(
        world=recording.world(),
        robot=recording.metadata.get("presage", {}).get("robot", "unknown"),
        base=recording.robot(),
        counts=dict(recording.counts()),
        duration_s=(recording.end_ns - recording.start_ns) * 1e-9,
    )
    kept: dict[type[Stamped], list[Any]] = {
        Scan: session.scans, Truth: session.truths, Belief: session.beliefs, Prediction: session.predictions,
    }  # fmt: skip
    now, belief_raws, truths = 0, list[Raw](), defaultdict[int, list[tuple[int, Truth]]](list)
    for _, message, raw in recording.messages():
        if isinstance(message, Goal):
            session.goals.append(message)
            session.goal_times_ns.append(now)  # its own stamp may be of another clock
        elif isinstance(message, Status):
            session.statuses.append(message)
        elif isinstance(message, Health):
            session.healths[message.service] = message
        elif (sort := kept.get(type(message))) is not None and not (sort and sort[-1].stamp_ns == message.stamp_ns):
            sort.append(message)
            now = message.stamp_ns if isinstance(message, Scan | Truth) else now
            if isinstance(message, Truth):
                truths[message.stamp_ns].append((raw.logged_ns, message))
            elif isinstance(message, Belief):
                belief_raws.append(raw)
    session.true_of = [
        _nearest(truths.get(b.stamp_ns, []), raw) for b, raw in zip(session.beliefs, belief_raws, strict=True)
    ]
    session.warning = recording.warning  # damage is found on the way
    session.undecodable = sum(recording.undecodable.values())
    return session


@dataclass(frozen=True)
class SessionSummary:
    """What a session came to; None where the recording does not tell."""

    world: str | None
    robot: str
    complete: bool  # the recording's end is there
    scans: int
    messages: int
    dropped: int | None  # received and not used, by the services' own last counts
    dropped_by_key: dict[str, int]  # those that are not 0
    undecodable: int
    duration_s: float  # by reception
    duration_stamped_s: float | None  # by the scans' own stamps
    localised_after_scans: int | None
    localised_after_s: float | None  # from the first scan
    localised_error_m: float | None  # at that scan
    goal_reached: bool | None  # as the controller says
    goal_distance_m: float | None  # by the truth, at the end
    goal_distance_believed_m: float | None
    position_error_m: float | None  # at the end
    position_error_median_m: float | None  # once localised
    position_error_max_m: float | None  # once localised
    position_error_navigating_median_m: float | None  # from the goal's coming until it was reached, or the end
    position_error_navigating_max_m: float | None
    path_m: float | None  # driven, by the truth
    straight_line_m: float | None  # from the true place at the goal's coming to the goal
    contacts: int | None  # scans at which the body touched something

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def lines(self) -> list[tuple[str, str]]:
        """For a terminal, one quantity a line."""
        localised = "never"
        if self.localised_after_scans is not None:
            localised = f"after {self.localised_after_scans} scans, then {_metres(self.localised_error_m)} off"
        median, most = _metres(self.position_error_median_m), _metres(self.position_error_max_m)
        rows = [
            ("world", self.world or "unknown"),
            ("localised", localised),
            ("localisation error", f"{_metres(self.position_error_m)} at the end"),
            ("  once localised", f"{median} median, {most} at most"),
        ]
        if self.goal_reached is not None:
            away, believed = _metres(self.goal_distance_m), _metres(self.goal_distance_believed_m)
            rows += [
                ("goal", "reached" if self.goal_reached else "not reached"),
                ("distance to goal", f"{away}, believed {believed}"),
                ("path", f"{_metres(self.path_m)} for {_metres(self.straight_line_m)} in a straight line"),
            ]
        rows += [
            ("contacts", "unknown" if self.contacts is None else str(self.contacts)),
            ("scans", f"{self.scans}, of {self.messages} messages in {self.duration_s:.1f} s"),
            ("dropped", f"{'unknown' if self.dropped is None else self.dropped}; undecodable {self.undecodable}"),
        ]
        return rows if self.complete else [*rows, ("incomplete", "the recording's end is missing or damaged")]


def _nearest(truths: list[tuple[int, Truth]], raw: Raw) -> Truth | None:
    """Of those with one stamp the one received at nearly the same time: a simulation begun anew uses stamps again."""
    return min(truths, key=lambda truth: abs(truth[0] - raw.logged_ns))[1] if truths else None


def summarise(path: Path) -> SessionSummary:
    """Numbers of the recording at ``path``."""
    return summary_of(load_session(path))


def summary_of(session: Session) -> SessionSummary:
    """Numbers of a session."""
    errors, path, goal = session.errors(), session.true_path(), session.goal()
    stamps = np.array([b.stamp_ns for b in session.beliefs], np.int64)
    scans = [s.stamp_ns for s in session.scans]
    first, reached = session.localised(), session.reached_ns()
    once = errors[first:] if first is not None else errors[:0]
    asked = session.goal_times_ns[-1] if goal is not None else 0
    until = reached if reached is not None else np.iinfo(np.int64).max
    navigating = errors[(stamps >= asked) & (stamps <= until)] if goal is not None else errors[:0]
    dropped = Counter[str]()
    for health in session.healths.values():
        dropped.update({row.key: row.dropped for row in health.topics if row.dropped})
    start = path[min(bisect_left([t.stamp_ns for t in session.truths], asked), len(path) - 1)] if len(path) else None
    return SessionSummary(
        world=session.world.name if session.world else None,
        robot=session.robot,
        complete=not session.warning,
        scans=len(scans),
        messages=sum(session.counts.values()),
        dropped=dropped.total() if session.healths else None,
        dropped_by_key=dict(dropped),
        undecodable=session.undecodable,
        duration_s=session.duration_s,
        duration_stamped_s=(max(scans) - min(scans)) * 1e-9 if scans else None,
        localised_after_scans=None if first is None else first + 1,
        localised_after_s=None if first is None or not scans else (int(stamps[first]) - scans[0]) * 1e-9,
        localised_error_m=None if first is None else _last(errors[: first + 1]),
        goal_reached=None if goal is None else reached is not None,
        goal_distance_m=_distance(path[-1:], goal),
        goal_distance_believed_m=_distance(session.believed_path()[-1:], goal),
        position_error_m=_last(errors),
        position_error_median_m=_of(np.median, once),
        position_error_max_m=_of(np.max, once),
        position_error_navigating_median_m=_of(np.median, navigating),
        position_error_navigating_max_m=_of(np.max, navigating),
        path_m=float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum()) if len(path) else None,
        straight_line_m=None if start is None else _distance(start[None], goal),
        contacts=sum(t.contact for t in session.truths) if session.truths else None,
    )


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _distance(poses: Array, goal: Goal | None) -> float | None:
    """From the only one of ``poses`` (1, 3), if there is one, to the goal, m."""
    return float(np.hypot(*(poses[0] - goal.pose.array())[:2])) if goal is not None and len(poses) else None


def _last(errors: Array) -> float | None:
    return float(errors[-1]) if len(errors) and np.isfinite(errors[-1]) else None


def _of(statistic: Any, errors: Array) -> float | None:
    """The statistic of the errors that are known."""
    known = errors[np.isfinite(errors)]
    return float(statistic(known)) if len(known) else None
