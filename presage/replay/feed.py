"""Sends recorded inputs to running services, a scan at a time."""

from __future__ import annotations

import time
from collections import Counter

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from common.bus.bus import Bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.definitions import Belief, CmdVel, Health, Stamped
from common.messages.topics import BELIEF, CMD_VEL, DRIVE, GOAL, HEALTH, ODOM, SCAN, STATUS, Topic
from common.messages.wire import DecodeError
from presage.replay.comparison import ReplayOutcome
from presage.replay.goal_times import GoalTimes
from presage.replay.recorded_session import robot_of
from presage.session.stack import Stack
from services.recorder.reader import Raw, Recording
from services.recorder.replaying.player import Player

FIRST_ANSWER_TIMEOUT_S, ANSWER_TIMEOUT_S = 60.0, 10.0  # for the first scan (which compiles code), and for any other
GOAL_TIMEOUT_S = 3.0  # until the services' health messages, sent once a second, count a goal as received
SETTLING_TIME_S = 1.0  # a timed replay ends when no answer has come for so long


class ScanFeed:
    """Sends the recorded inputs to the services, once, and compares their outputs with the recorded ones."""

    def __init__(
        self,
        recording: Recording,
        bus: Bus,
        stack: Stack,
        outcome: ReplayOutcome,
        *,
        rate: float | None,
        every_scan: bool,
    ) -> None:
        """The services of ``stack`` must be alive. Runs in lockstep if ``rate`` is None; fills in ``outcome``."""
        self.recording, self.bus, self.stack, self.outcome = recording, bus, stack, outcome
        self.rate, self.every_scan = rate, every_scan
        self.services = stack.processes.keys() - {"router"}
        robot = robot_of(recording)
        self.outputs: set[Topic] = {t for t in (BELIEF, CMD_VEL) if t.publisher in self.services}
        inputs = {SCAN, ODOM, GOAL, DRIVE, CMD_VEL, BELIEF} - self.outputs
        counts = recording.counts()
        self.topics = {t.key(robot): t for t in inputs | self.outputs if counts[t.key(robot)]}
        self.inbox = Inbox()
        self._received_goals: Counter[str] = Counter()  # by service, from its health messages
        self._sent_goals = 0
        self._answered = False  # whether a scan was answered yet
        # In lockstep: how many goals to send after the answer to each scan, by stamp, and their payloads in order.
        self._goal_times: Counter[int | None] | None = None
        self._pending_goals: list[bytes] = []
        for topic in (*self.outputs, HEALTH):
            bus.subscribe(topic, self.inbox, keep_all=True)

    def run(self, console: Console) -> None:
        """Sends all inputs; raises UserError if a service ends or does not answer the first scan."""
        answered_stamps = self._answered_stamps()
        if self.rate is None and CMD_VEL in self.outputs:
            self._place_goals()
        start_s, player = time.monotonic(), None
        # Not all configurations subscribe to the other topics, so that waiting for them could last until the timeout.
        for topic in {SCAN, GOAL} & set(self.topics.values()):
            self.bus.wait_matching(topic, ANSWER_TIMEOUT_S)
        self._send_goals(None)
        if self.rate is not None:
            player = Player(0.0, float("inf"), self.rate, now=start_s)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        )
        with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
            task = bar.add_task("scans", total=self.outcome.scans)
            for raw in self.recording.payloads(self.topics.keys()):
                if player is not None:
                    at = (raw.logged_ns - self.recording.start_ns) * 1e-9
                    self._listen(player.wait(at, time.monotonic()))
                    player.sent(at, time.monotonic(), whole=True)
                if self.topics[raw.key] is SCAN:
                    bar.advance(task)
                self._process(raw, answered_stamps)
        while player is not None and self._listen(SETTLING_TIME_S):
            pass

    def _answered_stamps(self) -> Counter[int]:
        """Number of recorded beliefs by stamp."""
        return Counter(
            message.stamp_ns for _, message, raw in self.recording.messages(BELIEF) if raw.key in self.topics
        )

    def _process(self, raw: Raw, answered_stamps: Counter[int]) -> None:
        """Adds a recorded output to the comparison, or sends an input and waits for its answers."""
        topic = self.topics[raw.key]
        try:
            message = topic.message.decode(raw.payload)
        except DecodeError:  # the live services could not use it either
            return
        if topic in self.outputs:
            (self.outcome.beliefs if topic is BELIEF else self.outcome.commands).add_recorded(message)
            return
        if topic is SCAN:
            self.outcome.numbers.see(message.seq)
        if topic is SCAN and not self.every_scan:
            if not answered_stamps[message.stamp_ns]:
                self.outcome.left_out += 1
                return
            answered_stamps[message.stamp_ns] -= 1
        if topic is GOAL and self._goal_times is not None:
            return  # it is sent by _send_goals
        self.bus.put(topic, raw.payload)
        self.outcome.given += topic is SCAN
        if topic is GOAL and self.rate is None:
            self._wait_for_goal()
        elif topic is SCAN and self.rate is None:
            self._wait_for_answers(message)
            self._send_goals(message.stamp_ns)

    def _place_goals(self) -> None:
        """Infers from the recorded statuses after which scan the controller accepted each goal, if possible."""
        payloads = [raw.payload for _, _, raw in self.recording.messages(GOAL) if raw.key in self.topics]
        goal_times, robot = GoalTimes(), self.bus.robot
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
            self.bus.put(GOAL, self._pending_goals.pop(0))
            self._wait_for_goal()

    def _wait_for_goal(self) -> None:
        """Waits until the services have received the goal: the bus keeps no order between goals and scans."""
        self._sent_goals += 1
        deadline = time.monotonic() + GOAL_TIMEOUT_S
        while min((self._received_goals[service] for service in self.services), default=0) < self._sent_goals:
            if self._next(deadline - time.monotonic()) is None:
                return

    def _wait_for_answers(self, scan: Stamped) -> None:
        deadline = time.monotonic() + (ANSWER_TIMEOUT_S if self._answered else FIRST_ANSWER_TIMEOUT_S)
        missing = {topic.message for topic in self.outputs}
        while missing:
            message = self._next(min(0.5, deadline - time.monotonic()))
            if message is None:
                self.stack.check()
                if time.monotonic() >= deadline:
                    self.outcome.unanswered += 1
                    if not self._answered:
                        raise UserError(
                            f"no belief came within {FIRST_ANSWER_TIMEOUT_S:g} s of the first scan; to find the cause, "
                            "start `python -m services.estimator` and run `presage replay` beside it"
                        )
                    return
            elif message.stamp_ns == scan.stamp_ns:
                missing.discard(type(message))
        self._answered = True

    def _listen(self, seconds: float) -> bool:
        """Receives messages for ``seconds`` s; returns whether an output of a service was among them."""
        deadline, any_answer = time.monotonic() + seconds, False
        while True:
            message = self._next(deadline - time.monotonic())
            if message is None:
                self.stack.check()
                return any_answer
            any_answer |= not isinstance(message, Health)

    def _next(self, timeout: float) -> Stamped | None:
        """Returns the next message of the services after adding it to the outcome; None after ``timeout`` s."""
        sample = self.inbox.get(max(0.0, timeout))
        if not isinstance(sample, Sample):
            return None
        message = sample.topic.message.decode(sample.payload)
        if isinstance(message, Belief):
            self.outcome.beliefs.add_new(message)
        elif isinstance(message, CmdVel):
            self.outcome.commands.add_new(message)
        elif isinstance(message, Health):
            goals = GOAL.key(self.bus.robot)
            self._received_goals[message.service] = max(
                (row.received for row in message.topics if row.key == goals), default=0
            )
        return message
