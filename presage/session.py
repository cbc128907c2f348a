"""The numbers of a recorded session."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.messages import Belief, CmdVel, Goal, Health, Prediction, Scan, Stamped, Status, Truth
from common.se2 import Array
from common.world import World
from services.recorder.reader import read_recording


@dataclass
class Session:
    """A recording's messages by kind, in order."""

    world: World | None
    robot: str
    complete: bool
    duration_s: float  # by reception
    counts: dict[str, int]
    undecodable: int
    scans: list[Scan]
    truths: list[Truth]
    beliefs: list[Belief]
    predictions: list[Prediction]
    goals: list[Goal]
    statuses: list[Status]
    healths: dict[str, Health]  # the last of each service

    def true_path(self) -> Array:
        """(N, 3) true poses."""
        return np.array([t.pose.array() for t in self.truths]).reshape(-1, 3)

    def believed_path(self) -> Array:
        """(N, 3) believed poses."""
        return np.array([b.pose.array() for b in self.beliefs]).reshape(-1, 3)

    def errors(self) -> Array:
        """(N,) m, distance of each belief from the truth of the same stamp; NaN where there is none."""
        truths = {t.stamp_ns: t.pose.array() for t in self.truths}
        nowhere = np.full(3, np.nan)
        found = [np.hypot(*(b.pose.array() - truths.get(b.stamp_ns, nowhere))[:2]) for b in self.beliefs]
        return np.array(found, float)

    def goal(self) -> Goal | None:
        """The last goal, unless it was cancelled."""
        return self.goals[-1] if self.goals and not self.goals[-1].cancel else None


def load_session(path: Path) -> Session:
    """Read a recording; raises UserError where that is impossible."""
    recording = read_recording(path)
    by_kind: dict[type[Stamped], list[Any]] = {
        kind: [] for kind in (Scan, Truth, Belief, Prediction, Goal, Status, Health, CmdVel)
    }
    for _, message in recording.messages():
        by_kind.setdefault(type(message), []).append(message)
    times = [raw.logged_ns for raw in recording.raw]
    return Session(
        world=recording.world(),
        robot=recording.metadata.get("presage", {}).get("robot", "unknown"),
        complete=recording.complete,
        duration_s=(max(times) - min(times)) * 1e-9 if times else 0.0,
        counts=dict(recording.counts()),
        undecodable=sum(recording.undecodable.values()),
        scans=by_kind[Scan],
        truths=by_kind[Truth],
        beliefs=by_kind[Belief],
        predictions=by_kind[Prediction],
        goals=by_kind[Goal],
        statuses=by_kind[Status],
        healths={health.service: health for health in by_kind[Health]},
    )


@dataclass(frozen=True)
class SessionSummary:
    """What a session came to; None where the recording does not tell."""

    world: str | None
    scans: int
    messages: int
    dropped: int | None  # received and not used, by the services' own last counts
    undecodable: int
    duration_s: float
    localised_after_scans: int | None
    localised_error_m: float | None  # at that scan
    goal_reached: bool | None
    goal_distance_m: float | None  # by the truth, at the end
    goal_distance_believed_m: float | None
    position_error_m: float | None  # at the end
    position_error_median_m: float | None  # once localised
    position_error_max_m: float | None  # once localised
    path_m: float | None  # driven, by the truth
    straight_line_m: float | None  # from the true start to the goal
    contacts: int | None  # scans at which the body touched something

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def lines(self) -> list[tuple[str, str]]:
        """For a terminal, one quantity a line."""

        def metres(value: float | None) -> str:
            return "unknown" if value is None else f"{value:.3f} m"

        localised = "never"
        if self.localised_after_scans is not None:
            localised = f"after {self.localised_after_scans} scans, then {metres(self.localised_error_m)} off"
        rows = [
            ("world", self.world or "unknown"),
            ("localised", localised),
            ("localisation error", f"{metres(self.position_error_m)} at the end"),
            (
                "  once localised",
                f"{metres(self.position_error_median_m)} median, {metres(self.position_error_max_m)} at most",
            ),
        ]
        if self.goal_reached is not None:
            rows += [
                ("goal", "reached" if self.goal_reached else "not reached"),
                ("distance to goal", f"{metres(self.goal_distance_m)}, believed {metres(self.goal_distance_believed_m)}"),
                ("path", f"{metres(self.path_m)} for {metres(self.straight_line_m)} in a straight line"),
            ]
        rows += [
            ("contacts", "unknown" if self.contacts is None else str(self.contacts)),
            ("scans", f"{self.scans}, of {self.messages} messages in {self.duration_s:.1f} s"),
            ("dropped", f"{'unknown' if self.dropped is None else self.dropped}; undecodable {self.undecodable}"),
        ]
        return rows


def summarise(path: Path) -> SessionSummary:
    """Numbers of the recording at ``path``."""
    return summary_of(load_session(path))


def summary_of(session: Session) -> SessionSummary:
    """Numbers of a session."""
    errors, truths, goal = session.errors(), session.true_path(), session.goal()
    first = next((i for i, b in enumerate(session.beliefs) if b.state == "tracking"), None)
    after = errors[first:] if first is not None else np.zeros(0)
    after = after[np.isfinite(after)]

    def away(poses: Array) -> float | None:
        return float(np.hypot(*(poses[-1] - goal.pose.array())[:2])) if goal is not None and len(poses) else None

    def finite(values: Array) -> float | None:
        return float(values[-1]) if len(values) and np.isfinite(values[-1]) else None

    healths = session.healths.values()
    return SessionSummary(
        world=session.world.name if session.world else None,
        scans=len(session.scans),
        messages=sum(session.counts.values()),
        dropped=sum(row.dropped for health in healths for row in health.topics) if session.healths else None,
        undecodable=session.undecodable,
        duration_s=session.duration_s,
        localised_after_scans=None if first is None else first + 1,
        localised_error_m=None if first is None else finite(errors[: first + 1]),
        goal_reached=None if goal is None else any(s.state == "reached" and s.goal == goal.pose for s in session.statuses),
        goal_distance_m=away(truths),
        goal_distance_believed_m=away(session.believed_path()),
        position_error_m=finite(errors),
        position_error_median_m=float(np.median(after)) if len(after) else None,
        position_error_max_m=float(np.max(after)) if len(after) else None,
        path_m=float(np.hypot(*np.diff(truths[:, :2], axis=0).T).sum()) if len(truths) else None,
        straight_line_m=float(np.hypot(*(truths[0] - goal.pose.array())[:2])) if goal is not None and len(truths) else None,
        contacts=sum(t.contact for t in session.truths) if session.truths else None,
    )
