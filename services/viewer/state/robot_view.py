"""One robot's latest state.

A frame shows one moment: scan, truth, belief, prediction and command of the same stamp. What answers a scan comes some
milliseconds after it and is waited for, shortly, from those who have spoken lately. Of a replay see `ReplayMoments`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

from common.messages.definitions import (
    Belief,
    CmdVel,
    Goal,
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
from services.viewer.state.replay_moments import ReplayMoments
from services.viewer.state.status_log import StatusLog

ANSWER_TIMEOUT_S = 0.05  # s of the wall's clock after a scan in which its answers are waited for
SILENCE_TIMEOUT_S = 2.0  # s behind the scan, by stamps and by the wall: no longer waited for, no longer shown
ALWAYS_READ_TOPICS = (BELIEF, TRUTH, STATUS, GOAL, HEALTH)  # read though nobody watches
SHOWN_TOPICS = (*ALWAYS_READ_TOPICS, SCAN, ODOM, PREDICTION, CMD_VEL, PLAN, PREFERENCE)
SENSOR_TOPICS = (ODOM, TRUTH, SCAN)  # what a new stamp begins with
ANSWER_TOPICS = (ODOM, TRUTH, BELIEF, PREDICTION, CMD_VEL, PLAN)
MAX_TRUTHS = 256  # stamps; a belief may come that much later than its truth
MAX_GOALS = 8  # the last ones given

M = TypeVar("M", bound=Stamped)


@dataclass(frozen=True)
class ReceivedMessage:
    """A message and when it came."""

    message: Stamped
    at: float  # s, a clock that only goes forward
    published_ns: int  # wall time at its publisher, 0 if unknown


class RobotView:
    """Latest messages of one robot."""

    def __init__(self, robot: str, *, live: bool = True) -> None:
        """Nothing heard; ``live``: not a replay."""
        self.robot, self.live = robot, live
        self.history, self.journal, self.fields = History(), StatusLog(), GoalFields()
        self.time_restarted = self.log_changed = False  # stamps went back; the journal grew. For who tells visitors
        self.frame: bytes | None = None  # the last one
        self._heard: dict[str, ReceivedMessage] = {}
        self._truths: OrderedDict[int, Truth] = OrderedDict()  # by stamp
        self._goals: OrderedDict[int, Goal] = OrderedDict()  # by number
        self._moments = ReplayMoments()  # of a replay
        self._waiting: tuple[int, float] | None = None  # stamp of the scan that waits for its answers, and since when
        self._latency_ms: float | None = None

    def add(self, topic: Topic, message: Stamped, at: float, published_ns: int = 0) -> bytes | None:
        """Take a message; a frame, where one is complete with it or complete no more."""
        if isinstance(message, Preference | Goal):
            self._keep_aside(message)
            return None
        last, frame = self._heard.get(topic.name), None
        if topic in SENSOR_TOPICS and last is not None and message.stamp_ns < last.message.stamp_ns:
            self._begin_anew()
        elif topic in SENSOR_TOPICS and self._waiting is not None and message.stamp_ns != self._waiting[0]:
            frame = self._frame(at)
        if isinstance(message, Truth) and last is not None and isinstance(last.message, Truth):
            self.log_changed |= self.journal.add_carry(last.message, message)
        self._heard[topic.name] = ReceivedMessage(message, at, published_ns)
        self._keep(message)
        if not self.live:
            self._moments.take(topic, message, at)
            return None
        if isinstance(message, Scan):
            self._waiting = (message.stamp_ns, at)
        return self._frame(at) if self._answered(at) else frame

    def due(self, at: float) -> float | None:
        """Seconds until what came is to be shown, complete or not; None: nothing waits."""
        if not self.live:
            return self._moments.due(at)
        return self._waiting[1] + ANSWER_TIMEOUT_S - at if self._waiting is not None else None

    def overdue(self, at: float) -> bytes | None:
        """The frame of what has waited long enough, with what there is."""
        due = self.due(at)
        if due is None or due > 0:
            return None
        if self.live:
            return self._frame(at)
        moment = self._moments.choose()
        if moment is None:
            return None
        self._heard.update({name: ReceivedMessage(message, at, 0) for name, message in moment.items()})
        return self._frame(at)

    def fresh(self, topic: Topic, kind: type[M], at: float) -> M | None:
        """The last message of a topic, unless it fell silent. While time stands still nobody falls silent."""
        heard = self._heard.get(topic.name)
        if heard is None or not isinstance(heard.message, kind):
            return None
        behind = (self.stamp_ns - heard.message.stamp_ns) * 1e-9
        return None if self.live and behind > SILENCE_TIMEOUT_S and at - heard.at > SILENCE_TIMEOUT_S else heard.message

    @property
    def status(self) -> Status | None:
        """The controller's last word, however old."""
        heard = self._heard.get(STATUS.name)
        return heard.message if heard is not None and isinstance(heard.message, Status) else None

    @property
    def stamp_ns(self) -> int:
        """Of the newest of what begins a stamp; 0 before the first."""
        return max((h.message.stamp_ns for t in SENSOR_TOPICS if (h := self._heard.get(t.name))), default=0)

    def _begin_anew(self) -> None:
        """After a reset, or a replay's jump back: what is known is about another time."""
        self._heard.clear()
        self._moments.clear()
        self._truths.clear()
        self.history.clear()
        self.journal.clear()
        self._waiting, self._latency_ms, self.time_restarted, self.log_changed = None, None, True, True

    def _keep_aside(self, message: Preference | Goal) -> None:
        """What is about no scan."""
        if isinstance(message, Preference):
            self.fields.add(message, self.robot, live=self.live)
            return
        self._goals[message.seq] = message
        if len(self._goals) > MAX_GOALS:
            self._goals.popitem(last=False)

    def _keep(self, message: Stamped) -> None:
        if isinstance(message, Truth):
            self._truths[message.stamp_ns] = message
            if len(self._truths) > MAX_TRUTHS:
                self._truths.popitem(last=False)
            belief = self._heard.get(BELIEF.name)
            if belief is not None and belief.message.stamp_ns == message.stamp_ns:  # the network turned them round
                self._keep(belief.message)
        elif isinstance(message, Belief):
            t, error, speed = message.stamp_ns * 1e-9, self._error(message), self._speed()
            self.history.add(ChartSample(t, message.free_energy, message.accuracy, message.complexity, error, speed))
        elif isinstance(message, CmdVel):
            self._latency_ms = self._latency(message)
        elif isinstance(message, Status):
            self.log_changed |= self.journal.add(message)

    def _error(self, belief: Belief) -> float | None:
        """m, between the belief and the truth of its stamp."""
        truth = self._truths.get(belief.stamp_ns)
        if truth is None:
            return None
        return _length(belief.pose.x - truth.pose.x, belief.pose.y - truth.pose.y)

    def _speed(self) -> float | None:
        """m/s, the true one, or what dead reckoning says."""
        for topic in (TRUTH, ODOM):
            heard = self._heard.get(topic.name)
            if heard is not None and isinstance(heard.message, Truth | Odom):
                return _length(heard.message.twist.vx, heard.message.twist.vy)
        return None

    def _latency(self, command: CmdVel) -> float | None:
        """ms, from the scan's publication to that of the command that answers it; None where they are not a pair."""
        scan, published = self._heard.get(SCAN.name), self._heard[CMD_VEL.name].published_ns
        if not self.live or scan is None or scan.message.stamp_ns != command.stamp_ns:
            return None
        if scan.published_ns == 0 or published < scan.published_ns:
            return None
        return (published - scan.published_ns) * 1e-6

    def _answered(self, at: float) -> bool:
        """Whether all who spoke lately have spoken about the waiting scan."""
        if self._waiting is None:
            return False
        last = (self.fresh(topic, Stamped, at) for topic in ANSWER_TOPICS)
        known = [message for message in last if message is not None and not _is_over(message)]
        # Where nobody has answered yet it is too early to say that nobody will.
        return bool(known) and all(message.stamp_ns >= self._waiting[0] for message in known)

    def _frame(self, at: float) -> bytes | None:
        self._waiting = None
        scan = self._heard[SCAN.name].message
        if not isinstance(scan, Scan):
            return None
        belief = self.fresh(BELIEF, Belief, at)
        header = {
            "type": "frame",
            "t": scan.stamp_ns * 1e-9,
            "stamp_ns": scan.stamp_ns,
            "robot": self.robot,
            "truth": frames.truth_of(self.fresh(TRUTH, Truth, at)),
            "belief": frames.belief_of(belief),
            "odom": frames.odom_of(self.fresh(ODOM, Odom, at)),
            "status": frames.status_of(self.status, self._goals),
            "cmd": frames.cmd_of(self.fresh(CMD_VEL, CmdVel, at)),
            "error": self._error(belief) if belief is not None else None,
            "speed": self._speed(),
            "latency_ms": self._latency_ms,
            "scan": frames.scan_of(scan),
        }
        prediction, plan = self.fresh(PREDICTION, Prediction, at), self.fresh(PLAN, Plan, at)
        self.frame = frames.encode(header, frames.arrays_of(scan, prediction, plan, self.fresh(TRUTH, Truth, at)))
        return self.frame


def _length(x: float, y: float) -> float | None:
    """None where it is beyond all numbers."""
    length = math.hypot(x, y)
    return length if math.isfinite(length) else None


def _is_over(message: Stamped) -> bool:
    """A plan with nothing in it is the last one for a while."""
    return isinstance(message, Plan) and not len(message.path) and not len(message.obstacles)
