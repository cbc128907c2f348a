"""One robot's latest state.

A frame shows scan, truth, belief, prediction and command of the same stamp. The answers to a scan arrive some
milliseconds after it, so the frame waits for them briefly, but only for topics that had messages lately. Frames of a
replay are chosen by `ReplayMoments`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

from common.messages.definitions import (
    MAX_LATE_NS,
    Belief,
    CmdVel,
    Goal,
    Map,
    Odom,
    Plan,
    Prediction,
    Preference,
    Scan,
    Stamped,
    Status,
    Truth,
)
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    GOAL,
    HEALTH,
    MAP,
    ODOM,
    PLAN,
    PREDICTION,
    PREFERENCE,
    SCAN,
    STATUS,
    TRUTH,
    Topic,
)
from services.viewer.state import frames
from services.viewer.state.goal_field import GoalFields
from services.viewer.state.history import ChartSample, History
from services.viewer.state.journal import Journal
from services.viewer.state.replay_moments import ReplayMoments

ANSWER_TIMEOUT_S = 0.05  # wall time for which a frame waits for the answers to its scan
SILENCE_TIMEOUT_S = 2.0  # behind the scan, by stamps and by wall time; older messages are not waited for and not shown
ALWAYS_READ_TOPICS = (BELIEF, TRUTH, STATUS, GOAL, HEALTH)  # decoded even if no visitor watches the robot
SHOWN_TOPICS = (*ALWAYS_READ_TOPICS, SCAN, ODOM, PREDICTION, MAP, CMD_VEL, PLAN, PREFERENCE)
SENSOR_TOPICS = (ODOM, TRUTH, SCAN)  # the first messages of a new stamp
ANSWER_TOPICS = (ODOM, TRUTH, BELIEF, PREDICTION, CMD_VEL, PLAN)
MAX_TRUTHS = 256  # kept, because a belief arrives later than the truth of its stamp
MAX_GOALS = 8  # kept, the last ones received

M = TypeVar("M", bound=Stamped)


@dataclass(frozen=True)
class ReceivedMessage:
    """A message and its times."""

    message: Stamped
    received_at: float  # monotonic time, s
    published_ns: int  # wall time at the publisher, 0 if unknown


class RobotView:
    """Latest messages of one robot."""

    def __init__(self, robot: str, *, live: bool = True) -> None:
        """``live``: the robot is not a replay."""
        self.robot, self.live = robot, live
        self.history, self.journal, self.fields = History(), Journal(), GoalFields()
        self.time_restarted = False  # stamps went back; reset by the caller once visitors have the new history
        self.journal_changed = False  # the journal has new rows; reset by the caller once visitors have them
        self.map_changed = False  # there is another map, or none any more; reset by the caller once visitors know
        self.frame: bytes | None = None  # the last frame
        self.map: str | None = None  # the last map of the mapper, as a message for the page
        self._received: dict[str, ReceivedMessage] = {}  # the last message by topic name
        self._truths: OrderedDict[int, Truth] = OrderedDict()  # by stamp
        self._goals: OrderedDict[int, Goal] = OrderedDict()  # by sequence number
        self._moments = ReplayMoments()  # used if not live
        self._waiting: tuple[int, float] | None = None  # stamp of the scan that waits for answers, and since when
        self._latency_ms: float | None = None

    def add(self, topic: Topic, message: Stamped, now: float, published_ns: int = 0) -> bytes | None:
        """Stores a message received at monotonic time ``now`` in s.

        Returns a frame if this message completes one, or if it begins a new stamp while a frame is still incomplete.
        """
        if isinstance(message, Preference | Goal):
            self._store_goal(message)
            return None
        if isinstance(message, Map):
            self._store_map(message)
            return None
        if isinstance(message, Truth) and self.map is not None:
            return None  # it is in the frame of the simulator's world, not of the map
        last, frame = self._received.get(topic.name), None
        late_ns = 0 if last is None else last.message.stamp_ns - message.stamp_ns
        if topic in SENSOR_TOPICS and late_ns > 0:
            if self.live and late_ns < MAX_LATE_NS:  # a replay may go back by less
                return None
            self._restart()
        elif topic in SENSOR_TOPICS and self._waiting is not None and message.stamp_ns != self._waiting[0]:
            frame = self._frame(now)
        if isinstance(message, Truth) and last is not None and isinstance(last.message, Truth):
            self.journal_changed |= self.journal.add_displacement(last.message, message)
        self._received[topic.name] = ReceivedMessage(message, now, published_ns)
        self._update(message)
        if not self.live:
            self._moments.add(topic, message, now)
            return None
        if isinstance(message, Scan):
            self._waiting = (message.stamp_ns, now)
        return self._frame(now) if self._is_complete(now) else frame

    def due(self, now: float) -> float | None:
        """Seconds until the waiting frame is sent, even if incomplete. Returns None if no frame is waiting."""
        if not self.live:
            return self._moments.due(now)
        return self._waiting[1] + ANSWER_TIMEOUT_S - now if self._waiting is not None else None

    def overdue(self, now: float) -> bytes | None:
        """The waiting frame, if its wait is over, with the messages received so far."""
        due = self.due(now)
        if due is None or due > 0:
            return None
        if self.live:
            return self._frame(now)
        moment = self._moments.choose()
        if moment is None:
            return None
        self._received.update({name: ReceivedMessage(message, now, 0) for name, message in moment.items()})
        return self._frame(now)

    def fresh(self, topic: Topic, kind: type[M], now: float) -> M | None:
        """The last message of a topic. Returns None if it is too old, by its stamp and by wall time.

        While a simulation is paused, stamps do not advance and messages do not become too old.
        """
        last = self._received.get(topic.name)
        if last is None or not isinstance(last.message, kind):
            return None
        behind = (self.stamp_ns - last.message.stamp_ns) * 1e-9
        too_old = self.live and behind > SILENCE_TIMEOUT_S and now - last.received_at > SILENCE_TIMEOUT_S
        return None if too_old else last.message

    @property
    def status(self) -> Status | None:
        """The controller's last status, however old."""
        last = self._received.get(STATUS.name)
        return last.message if last is not None and isinstance(last.message, Status) else None

    @property
    def stamp_ns(self) -> int:
        """Stamp of the newest sensor message; 0 before the first."""
        return max((last.message.stamp_ns for t in SENSOR_TOPICS if (last := self._received.get(t.name))), default=0)

    def _restart(self) -> None:
        """Discards all messages, after a reset or a replay's jump back."""
        self._received.clear()
        self._moments.clear()
        self._truths.clear()
        self.history.clear()
        self.journal.clear()
        self._waiting, self._latency_ms, self.time_restarted, self.journal_changed = None, None, True, True

    def end_mapping(self) -> None:
        """Forgets the map, because its mapper has ended. From now on the truth is shown again."""
        if self.map is not None:
            self.map, self.map_changed = None, True
            self._forget_truth()

    def _store_map(self, message: Map) -> None:
        if self.map is None:
            self._forget_truth()
        self.map, self.map_changed = frames.map_as_json(message, self.robot), True

    def _forget_truth(self) -> None:
        """Forgets what was measured with the truth: with a map, all that is shown is in another frame than without."""
        self._received.pop(TRUTH.name, None)
        self._truths.clear()
        self.history.clear()
        self.time_restarted = True

    def _store_goal(self, message: Preference | Goal) -> None:
        """Stores a message that does not belong to a scan."""
        if isinstance(message, Preference):
            self.fields.add(message, self.robot, live=self.live)
            return
        self._goals[message.seq] = message
        if len(self._goals) > MAX_GOALS:
            self._goals.popitem(last=False)

    def _update(self, message: Stamped) -> None:
        """Updates history, journal and latency with a message."""
        if isinstance(message, Truth):
            self._truths[message.stamp_ns] = message
            if len(self._truths) > MAX_TRUTHS:
                self._truths.popitem(last=False)
            belief = self._received.get(BELIEF.name)
            if belief is not None and belief.message.stamp_ns == message.stamp_ns:  # it arrived before its truth
                self._update(belief.message)
        elif isinstance(message, Belief):
            t, error, speed = message.stamp_ns * 1e-9, self._error(message), self._speed()
            self.history.add(ChartSample(t, message.free_energy, message.accuracy, message.complexity, error, speed))
        elif isinstance(message, CmdVel):
            self._latency_ms = self._latency(message)
        elif isinstance(message, Status):
            self.journal_changed |= self.journal.add(message)

    def _error(self, belief: Belief) -> float | None:
        """Distance in m between the belief and the true position at its stamp."""
        truth = self._truths.get(belief.stamp_ns)
        if truth is None:
            return None
        return _length(belief.pose.x - truth.pose.x, belief.pose.y - truth.pose.y)

    def _speed(self) -> float | None:
        """Speed in m/s: the true one, or else that of the odometry."""
        for topic in (TRUTH, ODOM):
            last = self._received.get(topic.name)
            if last is not None and isinstance(last.message, Truth | Odom):
                return _length(last.message.twist.vx, last.message.twist.vy)
        return None

    def _latency(self, command: CmdVel) -> float | None:
        """Time in ms from the publication of a scan to that of its command. Returns None if the stamps differ."""
        scan, published_ns = self._received.get(SCAN.name), self._received[CMD_VEL.name].published_ns
        if not self.live or scan is None or scan.message.stamp_ns != command.stamp_ns:
            return None
        if scan.published_ns == 0 or published_ns < scan.published_ns:
            return None
        return (published_ns - scan.published_ns) * 1e-6

    def _is_complete(self, now: float) -> bool:
        """Whether every answer topic with recent messages has one for the waiting scan."""
        if self._waiting is None:
            return False
        last = (self.fresh(topic, Stamped, now) for topic in ANSWER_TOPICS)
        known = [message for message in last if message is not None and not _is_empty_plan(message)]
        # Before the first answer it is not known which topics to wait for, so the frame waits for the timeout.
        return bool(known) and all(message.stamp_ns >= self._waiting[0] for message in known)

    def _frame(self, now: float) -> bytes | None:
        self._waiting = None
        scan = self._received[SCAN.name].message
        if not isinstance(scan, Scan):
            return None
        belief = self.fresh(BELIEF, Belief, now)
        header = {
            "type": "frame",
            "t": scan.stamp_ns * 1e-9,
            "stamp_ns": scan.stamp_ns,
            "robot": self.robot,
            "truth": frames.truth_as_json(self.fresh(TRUTH, Truth, now)),
            "belief": frames.belief_as_json(belief),
            "odom": frames.odom_as_json(self.fresh(ODOM, Odom, now)),
            "status": frames.status_as_json(self.status, self._goals),
            "cmd": frames.cmd_as_json(self.fresh(CMD_VEL, CmdVel, now)),
            "error": self._error(belief) if belief is not None else None,
            "speed": self._speed(),
            "latency_ms": self._latency_ms,
            "scan": frames.scan_as_json(scan),
        }
        prediction, plan = self.fresh(PREDICTION, Prediction, now), self.fresh(PLAN, Plan, now)
        self.frame = frames.encode_frame(
            header, frames.arrays_of(scan, prediction, plan, self.fresh(TRUTH, Truth, now))
        )
        return self.frame


def _length(x: float, y: float) -> float | None:
    """Length of a vector. Returns None if it is not finite."""
    length = math.hypot(x, y)
    return length if math.isfinite(length) else None


def _is_empty_plan(message: Stamped) -> bool:
    """Whether the message is an empty plan, after which no plan is expected."""
    return isinstance(message, Plan) and not len(message.path) and not len(message.obstacles)
