"""Reads a recording's messages by kind, with bounded memory."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Goal, Health, Prediction, Scan, Stamped, Status, Truth
from common.robot.base import Robot
from presage.recordings.selection import entries, robot_of
from services.recorder.reader import Recording, read_recording

Stamps = npt.NDArray[np.int64]
LATE = 256  # scans; a prediction comes sooner


class Track:
    """Poses with their stamps, as plain numbers; one sent again with the stamp of the last stands once."""

    def __init__(self, width: int = 3) -> None:
        """``width`` numbers a row, the pose first."""
        self.width = width
        self._stamps, self._logged, self._rows = array("q"), array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, logged_ns: int, *row: float) -> bool:
        """A row; False where it was there already."""
        if self._stamps and self._stamps[-1] == stamp_ns:
            return False
        self._stamps.append(stamp_ns)
        self._logged.append(logged_ns)
        self._rows.extend(row)
        return True

    @property
    def stamps_ns(self) -> Stamps:
        """(N,) ns."""
        return np.array(self._stamps, np.int64)

    @property
    def logged_ns(self) -> Stamps:
        """(N,) ns, wall clock."""
        return np.array(self._logged, np.int64)

    @property
    def rows(self) -> Array:
        """(N, width)."""
        return np.array(self._rows, float).reshape(-1, self.width)

    @property
    def poses(self) -> Array:
        """(N, 3)."""
        return self.rows[:, :3]


@dataclass
class Session:
    """A recording's messages by kind, in the order received, of one robot."""

    world: World | None = None
    robot: str = "unknown"
    base: Robot = field(default_factory=Robot)
    warning: str = ""  # empty: the recording is complete
    duration_s: float = 0.0  # by reception
    counts: dict[str, int] = field(default_factory=dict)  # by key
    undecodable: int = 0
    scans: Track = field(default_factory=lambda: Track(0))
    last_scan: Scan | None = None
    predicted: tuple[Scan, Prediction] | None = None  # the last scan that was predicted
    truth: Track = field(default_factory=Track)
    contacts: int = 0  # truths that touch something
    belief: Track = field(default_factory=lambda: Track(6))  # pose, free energy, accuracy, complexity
    states: list[str] = field(default_factory=list)  # beside belief
    estimator: str = ""  # the last belief's
    true_poses: Array = field(default_factory=lambda: np.zeros((0, 3)))  # beside belief, of the same stamp; NaN: none
    goals: list[Goal] = field(default_factory=list)
    goal_times_ns: list[int] = field(default_factory=list)  # beside goals: the session's own time when each came
    reached: list[Status] = field(default_factory=list)  # statuses in state reached
    healths: dict[str, Health] = field(default_factory=dict)  # the last of each service

    def energies(self) -> Array:
        """(N, 3) nats: free energy, accuracy, complexity of each belief."""
        return self.belief.rows[:, 3:]

    def errors(self) -> Array:
        """(N,) m, distance of each belief from the truth of the same stamp; NaN where there is none."""
        return np.asarray(np.hypot(*(self.belief.poses - self.true_poses)[:, :2].T), float)

    def goal(self) -> Goal | None:
        """The last goal, unless it was cancelled."""
        return self.goals[-1] if self.goals and not self.goals[-1].cancel else None

    def localised(self) -> int | None:
        """Index of the first belief that claims to know the place."""
        return self.states.index("tracking") if "tracking" in self.states else None

    def reached_ns(self) -> int | None:
        """Stamp at which the controller said that the last goal was reached."""
        goal = self.goal()
        if goal is None:
            return None
        after = self.goal_times_ns[-1]
        return next((s.stamp_ns for s in self.reached if s.goal == goal.pose and s.stamp_ns >= after), None)


def load_session(path: Path) -> Session:
    """Read a recording; raises UserError where that is impossible."""
    return session_of(read_recording(path))


def session_of(recording: Recording) -> Session:
    """The recording's messages by kind."""
    robot = robot_of(recording, "")
    session = Session(
        world=recording.world(),
        robot=robot or recording.metadata.get("presage", {}).get("robot", "unknown"),
        base=recording.robot(),
        counts=dict(recording.counts()),
        duration_s=(recording.end_ns - recording.start_ns) * 1e-9,
    )
    gather = _Gathering(session)
    for _, message, raw in entries(recording, robot):
        gather.take(message, raw.logged_ns)
    session.true_poses = _of_the_same_stamp(session.belief, session.truth)
    session.warning = recording.warning  # damage is found on the way
    session.undecodable = sum(recording.undecodable.values())
    return session


class _Gathering:
    """Sorts messages into a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._now = 0  # ns, the session's own time
        self._waiting: dict[int, Scan] = {}  # for their prediction
        self._takers: dict[type[Stamped], Callable[[Any, int], None]] = {
            Goal: self._goal, Status: self._status, Health: self._health, Scan: self._scan,
            Prediction: self._prediction, Truth: self._truth, Belief: self._belief,
        }  # fmt: skip

    def take(self, message: Stamped, logged: int) -> None:
        """One message, with its reception in ns of the wall clock."""
        if (taker := self._takers.get(type(message))) is not None:
            taker(message, logged)

    def _goal(self, goal: Goal, _: int) -> None:
        self.session.goals.append(goal)
        self.session.goal_times_ns.append(self._now)  # its own stamp may be of another clock

    def _status(self, status: Status, _: int) -> None:
        if status.state == "reached":
            self.session.reached.append(status)

    def _health(self, health: Health, _: int) -> None:
        self.session.healths[health.service] = health

    def _prediction(self, prediction: Prediction, _: int) -> None:
        if (scan := self._waiting.get(prediction.stamp_ns)) is not None:
            self.session.predicted = (scan, prediction)

    def _truth(self, truth: Truth, logged: int) -> None:
        if self.session.truth.add(truth.stamp_ns, logged, *truth.pose.array()):
            self.session.contacts += truth.contact
            self._now = truth.stamp_ns

    def _belief(self, belief: Belief, logged: int) -> None:
        energies = (belief.free_energy, belief.accuracy, belief.complexity)
        if self.session.belief.add(belief.stamp_ns, logged, *belief.pose.array(), *energies):
            self.session.states.append(belief.state)
            self.session.estimator = belief.estimator

    def _scan(self, scan: Scan, logged: int) -> None:
        if self.session.scans.add(scan.stamp_ns, logged):
            self._now = scan.stamp_ns
            self.session.last_scan = self._waiting[scan.stamp_ns] = scan
            if len(self._waiting) > LATE:
                del self._waiting[next(iter(self._waiting))]


def _of_the_same_stamp(belief: Track, truth: Track) -> Array:
    """(N, 3) true pose beside each belief; NaN where there is none.

    Of several with one stamp the one received at nearly the same time: a simulation begun anew uses stamps again.
    """
    found = np.full((len(belief), 3), np.nan)
    order = np.lexsort((truth.logged_ns, truth.stamps_ns))
    stamps, logged, poses = truth.stamps_ns[order], truth.logged_ns[order], truth.poses[order]
    first = np.searchsorted(stamps, belief.stamps_ns, "left")
    behind = np.searchsorted(stamps, belief.stamps_ns, "right")
    for row, (a, b, at) in enumerate(zip(first, behind, belief.logged_ns, strict=True)):
        if b > a:
            found[row] = poses[a if b == a + 1 else a + np.argmin(np.abs(logged[a:b] - at))]
    return found
