"""The messages of a recorded session by type, with bounded memory."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Goal, Health, Prediction, Scan, Stamped, Status, Truth
from common.robot.robot import Robot
from presage.recordings.selection import entries, robot_of
from presage.recordings.service_drops import ServiceDrops
from services.recorder.reader import Recording, read_recording

Stamps = npt.NDArray[np.int64]
MAX_WAITING_SCANS = 256  # the prediction of a scan comes before this number of further scans


class StampedRows:
    """Rows of numbers with their stamps, stored compactly; a repeated message with the same stamp is ignored."""

    def __init__(self, width: int = 3) -> None:
        """``width`` is the number of values in a row, of which the first three are the pose."""
        self.width = width
        self._stamps, self._logged, self._rows = array("q"), array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, logged_ns: int, *row: float) -> bool:
        """Adds a row; returns False if it repeats the stamp of the last one."""
        if self._stamps and self._stamps[-1] == stamp_ns:
            return False
        self._stamps.append(stamp_ns)
        self._logged.append(logged_ns)
        self._rows.extend(row)
        return True

    def in_frame(self, old_in_new: Array) -> StampedRows:
        """The same poses in another frame, in which the present frame has the pose ``old_in_new`` (3,)."""
        result = StampedRows(self.width)
        result._stamps, result._logged = self._stamps, self._logged
        rows = self.rows
        rows[:, :3] = se2.compose(old_in_new, rows[:, :3])
        result._rows = array("d", rows.ravel())
        return result

    @property
    def stamps_ns(self) -> Stamps:
        """Stamps (N,) ns."""
        return np.array(self._stamps, np.int64)

    @property
    def logged_ns(self) -> Stamps:
        """Times of reception (N,) ns, wall clock."""
        return np.array(self._logged, np.int64)

    @property
    def rows(self) -> Array:
        """All rows (N, width)."""
        return np.array(self._rows, float).reshape(-1, self.width)

    @property
    def poses(self) -> Array:
        """Poses (N, 3)."""
        return self.rows[:, :3]

    def poses_at(self, stamps_ns: Stamps, logged_ns: Stamps) -> Array:
        """The poses (N, 3) at the stamps (N,) of messages that were received at ``logged_ns`` (N,); NaN if unknown.

        A restarted simulation uses stamps again: among several poses with the same stamp, takes the one received
        closest in time to the message.
        """
        result = np.full((len(stamps_ns), 3), np.nan)
        order = np.lexsort((self.logged_ns, self.stamps_ns))
        stamps, logged, poses = self.stamps_ns[order], self.logged_ns[order], self.poses[order]
        first = np.searchsorted(stamps, stamps_ns, "left")
        end = np.searchsorted(stamps, stamps_ns, "right")
        for row, (a, b, received) in enumerate(zip(first, end, logged_ns, strict=True)):
            if b > a:
                result[row] = poses[a if b == a + 1 else a + np.argmin(np.abs(logged[a:b] - received))]
        return result


@dataclass
class RecordedSession:
    """The messages of one robot in a recording, by type and in the order of reception."""

    world: World | None = None
    robot: str = "unknown"
    base: Robot = field(default_factory=Robot)
    warning: str = ""  # empty if the recording is complete
    duration_s: float = 0.0  # from the first to the last reception
    counts: dict[str, int] = field(default_factory=dict)  # by key
    undecodable: int = 0
    scans: StampedRows = field(default_factory=lambda: StampedRows(0))
    first_scan_seq: int = 0  # above 0 if the recording began after the scanner
    last_scan: Scan | None = None
    predicted: tuple[Scan, Prediction] | None = None  # the last scan with a prediction
    truth: StampedRows = field(default_factory=StampedRows)
    contacts: int = 0  # number of truth messages in which the robot touches something
    # Pose, free energy, accuracy, complexity; NaN where the estimator does not compute them.
    belief: StampedRows = field(default_factory=lambda: StampedRows(6))
    states: list[str] = field(default_factory=list)  # of each belief
    estimator: str = ""  # of the last belief
    true_poses: Array = field(default_factory=lambda: np.zeros((0, 3)))  # at the stamp of each belief; NaN if unknown
    goals: list[Goal] = field(default_factory=list)
    goal_times_ns: list[int] = field(default_factory=list)  # of each goal: stamp of the last scan or truth before it
    reached: list[Status] = field(default_factory=list)  # statuses in state reached
    refused: list[Status] = field(default_factory=list)  # statuses that refuse a goal
    drops: ServiceDrops = field(default_factory=ServiceDrops)

    def energies(self) -> Array:
        """Free energy, accuracy and complexity of each belief (N, 3), nats; NaN where unknown."""
        return self.belief.rows[:, 3:]

    def errors(self) -> Array:
        """Position error of each belief against the truth of the same stamp (N,), m; NaN if there is none."""
        return np.asarray(np.hypot(*(self.belief.poses - self.true_poses)[:, :2].T), float)

    def goal(self) -> Goal | None:
        """The last goal, unless it was cancelled."""
        last = self.goals[-1] if self.goals else None
        return None if last is None or last.cancel or last.explore else last

    def localised(self) -> int | None:
        """Index of the first belief in state tracking, or None."""
        return self.states.index("tracking") if "tracking" in self.states else None

    def reached_ns(self) -> int | None:
        """Stamp of the status that reports the last goal as reached, or None."""
        status = self._first_of_goal(self.reached)
        return None if status is None else status.stamp_ns

    def refusal(self) -> str | None:
        """Why the last goal was refused; None if it was not."""
        status = self._first_of_goal(self.refused)
        return None if status is None else status.reason

    def _first_of_goal(self, statuses: list[Status]) -> Status | None:
        """The first of the ``statuses`` that is about the last goal."""
        goal = self.goal()
        if goal is None:
            return None
        after = self.goal_times_ns[-1]
        return next((s for s in statuses if s.goal == goal.pose and s.stamp_ns >= after), None)


def load_session(path: Path) -> RecordedSession:
    """Reads a recording; raises UserError if that fails."""
    return gather_session(read_recording(path))


def gather_session(recording: Recording) -> RecordedSession:
    """Gathers the messages of the recording's robot."""
    robot = robot_of(recording)
    session = RecordedSession(
        world=recording.world(),
        robot=robot or recording.metadata.get("presage", {}).get("robot", "unknown"),
        base=recording.robot(),
        counts=dict(recording.counts),
        duration_s=(recording.end_ns - recording.start_ns) * 1e-9,
    )
    gatherer = _Gatherer(session)
    for _, message, raw in entries(recording, robot):
        gatherer.add(message, raw.logged_ns)
    session.true_poses = session.truth.poses_at(session.belief.stamps_ns, session.belief.logged_ns)
    known = np.flatnonzero(np.isfinite(session.true_poses[:, 0]))
    if session.estimator == "mapper" and len(known):
        # The mapper's map has a frame of its own. In it, the first belief is true by definition.
        first = known[0]
        frame = se2.compose(session.true_poses[first], se2.inverse(session.belief.poses[first]))
        session.truth = session.truth.in_frame(se2.inverse(frame))
        session.true_poses = np.asarray(se2.between(frame, session.true_poses))
    session.warning = recording.warning  # damage is only found while reading
    session.undecodable = sum(recording.undecodable.values())
    return session


class _Gatherer:
    """Sorts messages by type into a session."""

    def __init__(self, session: RecordedSession) -> None:
        self.session = session
        self._last_stamp_ns = 0  # of scan or truth
        self._waiting: dict[int, Scan] = {}  # scans whose prediction may still come, by stamp
        self._handlers: dict[type[Stamped], Callable[[Any, int], None]] = {
            Goal: self._goal,
            Status: self._status,
            Health: self._health,
            Scan: self._scan,
            Prediction: self._prediction,
            Truth: self._truth,
            Belief: self._belief,
        }

    def add(self, message: Stamped, logged: int) -> None:
        """Adds a message with the time of its reception, ns of wall time."""
        if (handler := self._handlers.get(type(message))) is not None:
            handler(message, logged)

    def _goal(self, goal: Goal, _: int) -> None:
        with suppress(UserError):  # the controller refused it
            goal = goal.in_map(self.session.world)
        self.session.goals.append(goal)
        self.session.goal_times_ns.append(self._last_stamp_ns)  # the goal's own stamp may be of another clock

    def _status(self, status: Status, _: int) -> None:
        if status.state == "reached":
            self.session.reached.append(status)
        if status.refused:
            self.session.refused.append(status)

    def _health(self, health: Health, _: int) -> None:
        self.session.drops.add(health)

    def _prediction(self, prediction: Prediction, _: int) -> None:
        if (scan := self._waiting.get(prediction.stamp_ns)) is not None:
            self.session.predicted = (scan, prediction)

    def _truth(self, truth: Truth, logged: int) -> None:
        if self.session.truth.add(truth.stamp_ns, logged, *truth.pose.array()):
            self.session.contacts += truth.contact
            self._last_stamp_ns = truth.stamp_ns

    def _belief(self, belief: Belief, logged: int) -> None:
        known = (belief.free_energy, belief.accuracy, belief.complexity)
        energies = [np.nan if value is None else value for value in known]
        if self.session.belief.add(belief.stamp_ns, logged, *belief.pose.array(), *energies):
            self.session.states.append(belief.state)
            self.session.estimator = belief.estimator

    def _scan(self, scan: Scan, logged: int) -> None:
        if not len(self.session.scans):
            self.session.first_scan_seq = scan.seq
        if self.session.scans.add(scan.stamp_ns, logged):
            self._last_stamp_ns = scan.stamp_ns
            self.session.last_scan = self._waiting[scan.stamp_ns] = scan
            if len(self._waiting) > MAX_WAITING_SCANS:
                del self._waiting[next(iter(self._waiting))]
