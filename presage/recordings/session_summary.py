"""Numbers of a recorded session."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry.se2 import Array
from common.messages.definitions import Goal
from presage.recordings.gathering import Session, load_session


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


def summarise(path: Path) -> SessionSummary:
    """Numbers of the recording at ``path``."""
    return summary_of(load_session(path))


def summary_of(session: Session) -> SessionSummary:
    """Numbers of a session."""
    errors, path, goal = session.errors(), session.truth.poses, session.goal()
    stamps, scans = session.belief.stamps_ns, session.scans.stamps_ns
    first, reached = session.localised(), session.reached_ns()
    once = errors[first:] if first is not None else errors[:0]
    asked = session.goal_times_ns[-1] if goal is not None else 0
    until = reached if reached is not None else np.iinfo(np.int64).max
    navigating = errors[(stamps >= asked) & (stamps <= until)] if goal is not None else errors[:0]
    dropped = Counter[str]()
    for service, health in session.healths.items():
        if service == "viewer":  # it looks on: a frame that it skips is lost to nobody
            continue
        dropped.update({row.key: row.dropped for row in health.topics if row.dropped})
    at_goal = min(int(np.argmax(np.append(session.truth.stamps_ns >= asked, True))), len(path) - 1)
    start = path[at_goal] if len(path) else None
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
        duration_stamped_s=float(scans.max() - scans.min()) * 1e-9 if len(scans) else None,
        localised_after_scans=None if first is None else first + 1,
        localised_after_s=None if first is None or not len(scans) else float(stamps[first] - scans[0]) * 1e-9,
        localised_error_m=None if first is None else _last(errors[: first + 1]),
        goal_reached=None if goal is None else reached is not None,
        goal_distance_m=_distance(path[-1:], goal),
        goal_distance_believed_m=_distance(session.belief.poses[-1:], goal),
        position_error_m=_last(errors),
        position_error_median_m=_of(np.median, once),
        position_error_max_m=_of(np.max, once),
        position_error_navigating_median_m=_of(np.median, navigating),
        position_error_navigating_max_m=_of(np.max, navigating),
        path_m=float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum()) if len(path) else None,
        straight_line_m=None if start is None else _distance(start[None], goal),
        contacts=session.contacts if len(session.truth) else None,
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
