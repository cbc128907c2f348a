"""Summarises a recorded session."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from common.geometry.se2 import Array
from common.messages.definitions import Goal
from presage.recordings.recorded_session import RecordedSession, load_session


@dataclass(frozen=True)
class SessionSummary:
    """Results of a session; None for what the recording does not contain."""

    world: str | None
    robot: str
    complete: bool  # whether the recording is complete
    scans: int
    messages: int
    dropped: int | None  # messages dropped by services during the recording
    dropped_by_key: dict[str, int]  # only keys with dropped messages
    undecodable: int
    duration_s: float  # from the first to the last reception
    duration_stamped_s: float | None  # from the first to the last stamp of a scan
    localised_before_recording: bool  # the state was tracking when the recording began, after the scanner
    localised_after_scans: int | None  # None also if it was localised before the recording
    localised_after_s: float | None  # from the first scan
    localised_error_m: float | None  # at that scan
    goal_reached: bool | None  # according to the controller
    goal_refusal: str | None  # why the controller refused the goal
    goal_tolerance_m: float | None
    goal_distance_reached_m: float | None  # from the true pose, when the controller reported it as reached
    goal_distance_m: float | None  # from the true pose, at the end
    goal_distance_believed_m: float | None
    position_error_m: float | None  # at the end
    position_error_median_m: float | None  # since localised
    position_error_max_m: float | None  # since localised
    position_error_navigating_median_m: float | None  # from the goal until it was reached, or the end
    position_error_navigating_max_m: float | None
    path_m: float | None  # length of the true path
    straight_line_m: float | None  # from the true position when the goal came to the goal
    contacts: int | None  # number of truth messages in which the robot touches something

    def as_dict(self) -> dict[str, Any]:
        """The results as values that JSON can hold."""
        return asdict(self)

    def lines(self) -> list[tuple[str, str]]:
        """Rows of (name, value) for the terminal."""
        localised = "before the recording began" if self.localised_before_recording else "never"
        if (count := self.localised_after_scans) is not None:
            scans = "1 scan" if count == 1 else f"{count} scans"
            localised = f"after {scans}, with an error of {_metres(self.localised_error_m)}"
        median, maximum = _metres(self.position_error_median_m), _metres(self.position_error_max_m)
        rows = [
            ("world", self.world or "unknown"),
            ("localised", localised),
            ("localisation error", f"{_metres(self.position_error_m)} at the end"),
            ("  since localised", f"{median} median, {maximum} maximum"),
        ]
        if self.goal_reached is not None:
            true, believed = _metres(self.goal_distance_m), _metres(self.goal_distance_believed_m)
            rows += [
                ("goal", self.goal_result()),
                ("distance to goal", f"{true}, believed {believed}"),
                ("path", f"{_metres(self.path_m)} for {_metres(self.straight_line_m)} in a straight line"),
            ]
        rows += [
            ("contacts", "unknown" if self.contacts is None else str(self.contacts)),
            ("scans", f"{self.scans}, of {self.messages} messages in {self.duration_s:.1f} s"),
            ("skipped by services", f"{self._skipped()}; undecodable {self.undecodable}"),
        ]
        return rows if self.complete else [*rows, ("incomplete", "the recording's end is missing or damaged")]

    def goal_result(self) -> str:
        """What became of the last goal."""
        if self.goal_refusal is not None:
            return self.goal_refusal.removeprefix("goal ")
        if not self.goal_reached:
            return "not reached"
        distance, tolerance = self.goal_distance_reached_m, self.goal_tolerance_m
        return "believed reached" if distance and tolerance and distance > tolerance else "reached"

    def _skipped(self) -> str:
        """How many messages services did not use because newer ones had come, by topic."""
        if not self.dropped:
            return "unknown" if self.dropped is None else "none"
        topics = ", ".join(f"{count} {key.rpartition('/')[2]}" for key, count in self.dropped_by_key.items())
        return f"{topics}, for newer ones"


def print_summary(summary: SessionSummary, recording: Path, figure: Path, console: Console) -> None:
    """Prints the summary and the names of the files."""
    table = Table(show_header=False, box=None, padding=(0, 2))
    for name, value in summary.lines():
        table.add_row(name, value)
    table.add_row("recording", str(recording))
    table.add_row("figure", str(figure))
    console.print(table)


def summarise(path: Path) -> SessionSummary:
    """Summarises the recording at ``path``."""
    return summary_of(load_session(path))


def summary_of(session: RecordedSession) -> SessionSummary:
    """Summarises a session."""
    errors, path, goal = session.errors(), session.truth.poses, session.goal()
    stamps, scans = session.belief.stamps_ns, session.scans.stamps_ns
    first, reached = session.localised(), session.reached_ns()
    localised = errors[first:] if first is not None else errors[:0]
    goal_ns = session.goal_times_ns[-1] if goal is not None else 0
    until = reached if reached is not None else np.iinfo(np.int64).max
    navigating = errors[(stamps >= goal_ns) & (stamps <= until)] if goal is not None else errors[:0]
    from_goal_on = np.concatenate([path[session.truth.stamps_ns >= goal_ns], path[-1:]])
    dropped = _dropped_by_key(session)
    before = first == 0 and session.first_scan_seq > 0
    after = None if before else first
    return SessionSummary(
        world=session.world.name if session.world else None,
        robot=session.robot,
        complete=not session.warning,
        scans=len(scans),
        messages=sum(session.counts.values()),
        dropped=sum(dropped.values()) if session.drops.last else None,
        dropped_by_key=dropped,
        undecodable=session.undecodable,
        duration_s=session.duration_s,
        duration_stamped_s=float(scans.max() - scans.min()) * 1e-9 if len(scans) else None,
        localised_before_recording=before,
        localised_after_scans=None if after is None else after + 1,
        localised_after_s=None if after is None or not len(scans) else float(stamps[after] - scans[0]) * 1e-9,
        localised_error_m=None if first is None else _last(errors[: first + 1]),
        goal_reached=None if goal is None else reached is not None,
        goal_refusal=session.refusal(),
        goal_tolerance_m=None if goal is None else goal.tolerance,
        goal_distance_reached_m=_distance(path[session.truth.stamps_ns == reached][-1:], goal),
        goal_distance_m=_distance(path[-1:], goal),
        goal_distance_believed_m=_distance(session.belief.poses[-1:], goal),
        position_error_m=_last(errors),
        position_error_median_m=statistic_of_finite(np.median, localised),
        position_error_max_m=statistic_of_finite(np.max, localised),
        position_error_navigating_median_m=statistic_of_finite(np.median, navigating),
        position_error_navigating_max_m=statistic_of_finite(np.max, navigating),
        path_m=float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum()) if len(path) else None,
        straight_line_m=_distance(from_goal_on[:1], goal),
        contacts=session.contacts if len(session.truth) else None,
    )


def _dropped_by_key(session: RecordedSession) -> dict[str, int]:
    """Number of messages that services dropped, without those of the viewer, which may skip messages without harm."""
    dropped = Counter[str]()
    for (service, key), count in session.drops.counts().items():
        if service != "viewer":
            dropped[key] += count
    return dict(dropped)


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _distance(poses: Array, goal: Goal | None) -> float | None:
    """Distance from the pose in ``poses``, (1, 3) or (0, 3), to the goal, m; None if either is missing."""
    return float(np.hypot(*(poses[0] - goal.pose.array())[:2])) if goal is not None and len(poses) else None


def _last(errors: Array) -> float | None:
    return float(errors[-1]) if len(errors) and np.isfinite(errors[-1]) else None


def statistic_of_finite(statistic: Any, values: Array) -> float | None:
    """The statistic of all finite values; None if there are none."""
    known = values[np.isfinite(values)]
    return float(statistic(known)) if len(known) else None
