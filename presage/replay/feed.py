"""Sends recorded inputs to services, and compares their outputs with the recorded ones."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable

from rich.console import Console

from common.errors import UserError
from common.messages.definitions import Belief, CmdVel, Scan, Stamped
from common.messages.topics import BELIEF, CMD_VEL, DRIVE, FIELD, GOAL, ODOM, SCAN, STATUS, Topic
from common.messages.wire import DecodeError
from presage.replay.goal_times import GoalTimes
from presage.replay.in_process import InProcessServices
from presage.replay.replay_outcome import ReplayOutcome
from presage.terminal.progress import progress
from services.recorder.reader import RawMessage, Recording


class ScanFeed:
    """Sends the recorded inputs to the services, once, and fills in the outcome."""

    def __init__(
        self,
        recording: Recording,
        services: InProcessServices,
        outputs: set[Topic],
        outcome: ReplayOutcome,
        *,
        every_scan: bool,
    ) -> None:
        """``outputs`` are the topics that the services publish and that are compared."""
        self.recording, self.services, self.outcome = recording, services, outcome
        self.outputs, self.every_scan = outputs, every_scan
        counts = recording.counts
        keys = {topic.key(services.robot): topic for topic in {SCAN, ODOM, GOAL, DRIVE, CMD_VEL, BELIEF} | outputs}
        self.topics = {key: topic for key, topic in keys.items() if counts[key]}
        # How many goals to send after each scan, by stamp, and their payloads in order; None if that is unknown, and
        # each goal is sent where it was recorded.
        self._goal_times: Counter[int | None] | None = None
        self._pending_goals: list[bytes] = []
        self._fields: defaultdict[int, list[bytes]] = defaultdict(list)  # learned while driving, by stamp
        self._answers = 0  # beliefs

    def run(self, console: Console) -> None:
        """Sends all inputs; raises UserError if no scan is answered."""
        answered_stamps = Counter(
            message.stamp_ns for _, message, raw in self.recording.messages(BELIEF) if raw.key in self.topics
        )
        if CMD_VEL in self.outputs:
            self._place_goals()
        for _, message, raw in self.recording.messages(FIELD):
            if raw.key == FIELD.key(self.services.robot):
                self._fields[message.stamp_ns].append(raw.payload)
        self._send_goals(None)
        raws = progress(
            self.recording.payloads(self.topics.keys()),
            "replaying",
            sum(self.recording.counts[key] for key in self.topics),
            console,
            unit="messages",
        )
        for raw in raws:
            self._process(raw, answered_stamps)
        outcome = self.outcome
        outcome.unanswered = max(0, outcome.sent - self._answers)
        if outcome.unanswered == outcome.sent > 0:
            raise UserError(f"the estimator answered no scan: {self.services.notes or 'the log above says why'}")

    def _process(self, raw: RawMessage, answered_stamps: Counter[int]) -> None:
        """Adds a recorded output to the comparison, or sends an input."""
        topic = self.topics[raw.key]
        try:
            message = topic.message.decode(raw.payload)
        except DecodeError:  # the live services could not use it either
            return
        if topic in self.outputs:
            (self.outcome.beliefs if topic is BELIEF else self.outcome.commands).add_recorded(message)
        elif isinstance(message, Scan):
            self.outcome.numbers.add(message.seq)
            if not self.every_scan:
                if not answered_stamps[message.stamp_ns]:
                    self.outcome.left_out += 1
                    return
                answered_stamps[message.stamp_ns] -= 1
            self._send_scan(message, raw.payload)
        elif topic is not GOAL or self._goal_times is None:
            self._add(self.services.send(topic, raw.payload))

    def _send_scan(self, scan: Scan, payload: bytes) -> None:
        self.outcome.sent += 1
        self._add(self.services.send(SCAN, payload))
        for field in self._fields.pop(scan.stamp_ns, ()):  # used for the scans after it
            self._add(self.services.send(FIELD, field))
        self._send_goals(scan.stamp_ns)

    def _place_goals(self) -> None:
        """Infers from the recorded statuses after which scan the controller accepted each goal, if possible."""
        payloads = [raw.payload for _, _, raw in self.recording.messages(GOAL) if raw.key in self.topics]
        goal_times, robot = GoalTimes(), self.services.robot
        keys = {STATUS.key(robot), CMD_VEL.key(robot)}
        goal_times.add(message for _, message, raw in self.recording.messages(STATUS, CMD_VEL) if raw.key in keys)
        self._pending_goals, self._goal_times = payloads, goal_times.accepted(len(payloads))
        self.outcome.goals_placed = self._goal_times is not None
        if self._goal_times is None:
            self.outcome.notes.append("when the controller accepted each goal is unknown: its commands may differ")
        if DRIVE in self.topics.values():
            self.outcome.goals_placed = False
            self.outcome.notes.append("the robot was driven by hand, at times that are unknown: commands may differ")

    def _send_goals(self, stamp_ns: int | None) -> None:
        """Sends the goals that were accepted after the answer to the scan of that stamp."""
        for _ in range(self._goal_times.pop(stamp_ns, 0) if self._goal_times is not None else 0):
            self._add(self.services.send(GOAL, self._pending_goals.pop(0)))

    def _add(self, published: Iterable[Stamped]) -> None:
        for message in published:
            if isinstance(message, Belief):
                self._answers += 1
                self.outcome.beliefs.add_new(message)
            elif isinstance(message, CmdVel):
                self.outcome.commands.add_new(message)
