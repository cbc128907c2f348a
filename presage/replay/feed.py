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
from presage.replay.comparison import Outcome
from presage.replay.goal_times import Goals
from presage.replay.recorded_session import robot_of
from presage.session.stack import Stack
from services.recorder.reader import Raw, Recording
from services.recorder.replaying.player import Player

FIRST_WITHIN, WITHIN = 60.0, 10.0  # s for the answer to the first scan, and to any other
HEARD_WITHIN = 3.0  # s; health says once a second what was received
QUIET = 1.0  # s without an answer, after which none is expected at the end of a timed replay


class Feed:
    """One recording, one pass."""

    def __init__(
        self, recording: Recording, bus: Bus, stack: Stack, outcome: Outcome, *, rate: float | None, every_scan: bool
    ) -> None:
        """``rate`` None: in lockstep. The services of ``stack`` are alive."""
        self.recording, self.bus, self.stack, self.outcome = recording, bus, stack, outcome
        self.rate, self.every_scan = rate, every_scan
        self.services = stack.processes.keys() - {"router"}
        robot = robot_of(recording)
        self.asked: set[Topic] = {t for t in (BELIEF, CMD_VEL) if t.publisher in self.services}
        heard = {SCAN, ODOM, GOAL, DRIVE, CMD_VEL, BELIEF} - self.asked
        there = recording.counts()
        self.topics = {t.key(robot): t for t in heard | self.asked if there[t.key(robot)]}
        self.heard = heard
        self.inbox = Inbox()
        self._received: Counter[str] = Counter()  # goals, by service, as their health says
        self._goals = 0
        self._answered = False  # once
        self._when: Counter[int | None] | None = None  # goals by the stamp after whose answer they came
        self._held: list[bytes] = []  # goals still to come, where that is known
        for topic in (*self.asked, HEALTH):
            bus.subscribe(topic, self.inbox, keep_all=True)

    def run(self, console: Console) -> None:
        """Raises UserError where a service ends."""
        taken = self._taken()
        if self.rate is None and CMD_VEL in self.asked:
            self._place_goals()
        began, player = time.monotonic(), None
        for topic in {SCAN, GOAL} & set(self.topics.values()):  # all others are of no use to most configurations
            self.bus.wait_matching(topic, WITHIN)
        self._give_goals(None)
        if self.rate is not None:
            player = Player(0.0, float("inf"), self.rate, now=began)
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
                self._take(raw, taken)
        while player is not None and self._listen(QUIET):
            pass

    def _taken(self) -> Counter[int]:
        """Stamps the live estimator answered, and how often."""
        return Counter(
            message.stamp_ns for _, message, raw in self.recording.messages(BELIEF) if raw.key in self.topics
        )

    def _take(self, raw: Raw, taken: Counter[int]) -> None:
        topic = self.topics[raw.key]
        try:
            message = topic.message.decode(raw.payload)
        except DecodeError:  # nobody could use it then, nobody can now
            return
        if topic in self.asked:
            (self.outcome.beliefs if topic is BELIEF else self.outcome.commands).recorded(message)
            return
        if topic is SCAN:
            self.outcome.numbers.see(message.seq)
        if topic is SCAN and not self.every_scan:
            if not taken[message.stamp_ns]:
                self.outcome.left_out += 1
                return
            taken[message.stamp_ns] -= 1
        if topic is GOAL and self._when is not None:
            return  # has its place already
        self.bus.put(topic, raw.payload)
        self.outcome.given += topic is SCAN
        if topic is GOAL and self.rate is None:
            self._goal_heard()
        elif topic is SCAN and self.rate is None:
            self._wait_for_answers(message)
            self._give_goals(message.stamp_ns)

    def _place_goals(self) -> None:
        """Where the controller took them, if its statuses tell."""
        held = [raw.payload for _, _, raw in self.recording.messages(GOAL) if raw.key in self.topics]
        goals, robot = Goals(), self.bus.robot
        mine = {STATUS.key(robot), CMD_VEL.key(robot)}
        goals.see(message for _, message, raw in self.recording.messages(STATUS, CMD_VEL) if raw.key in mine)
        self._held, self._when = held, goals.taken(len(held))
        self.outcome.goals_placed = self._when is not None
        if self._when is None:
            self.outcome.notes.append("when the controller took which goal is not known: its commands may differ")
        if DRIVE in self.topics.values():
            self.outcome.goals_placed = False
            self.outcome.notes.append("somebody drove by hand, between which scans is not known: commands may differ")

    def _give_goals(self, stamp_ns: int | None) -> None:
        """Those that came after the answer to the scan of that stamp."""
        for _ in range(self._when.pop(stamp_ns, 0) if self._when is not None else 0):
            self.bus.put(GOAL, self._held.pop(0))
            self._goal_heard()

    def _goal_heard(self) -> None:
        """Goals and scans go on keys of their own, between which the bus keeps no order."""
        self._goals += 1
        deadline = time.monotonic() + HEARD_WITHIN
        while min((self._received[service] for service in self.services), default=0) < self._goals:
            if self._next(deadline - time.monotonic()) is None:
                return

    def _wait_for_answers(self, scan: Stamped) -> None:
        deadline = time.monotonic() + (WITHIN if self._answered else FIRST_WITHIN)
        missing = {topic.message for topic in self.asked}
        while missing:
            message = self._next(min(0.5, deadline - time.monotonic()))
            if message is None:
                self.stack.check()
                if time.monotonic() >= deadline:
                    self.outcome.unanswered += 1
                    if not self._answered:
                        raise UserError(
                            f"no belief came within {FIRST_WITHIN:g} s of the first scan; try it step by step: start "
                            "`python -m services.estimator` and replay beside it"
                        )
                    return
            elif message.stamp_ns == scan.stamp_ns:
                missing.discard(type(message))
        self._answered = True

    def _listen(self, seconds: float) -> bool:
        """For so long take what comes; whether any answer did."""
        deadline, any_answer = time.monotonic() + seconds, False
        while True:
            message = self._next(deadline - time.monotonic())
            if message is None:
                self.stack.check()
                return any_answer
            any_answer |= not isinstance(message, Health)

    def _next(self, timeout: float) -> Stamped | None:
        """The next message of the services, counted; None within ``timeout`` s."""
        sample = self.inbox.get(max(0.0, timeout))
        if not isinstance(sample, Sample):
            return None
        message = sample.topic.message.decode(sample.payload)
        if isinstance(message, Belief):
            self.outcome.beliefs.new(message)
        elif isinstance(message, CmdVel):
            self.outcome.commands.new(message)
        elif isinstance(message, Health):
            goals = GOAL.key(self.bus.robot)
            self._received[message.service] = max(
                (row.received for row in message.topics if row.key == goals), default=0
            )
        return message
