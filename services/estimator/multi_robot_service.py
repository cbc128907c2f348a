"""The process for several robots."""

from __future__ import annotations

import re
import threading
import time
from collections import defaultdict, deque
from dataclasses import dataclass
from fnmatch import fnmatchcase
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.log import LogRateLimiter, logger
from common.messages.topics import SCAN
from common.runtime.runnable import Runnable
from common.runtime.service import Service
from common.runtime.service_loop import Loop
from services.estimator.multi_robot import Fleet, Outcome
from services.estimator.service import EstimatorService, Models
from services.estimator.settings import ROBOT_NAME, EstimatorSettings

if TYPE_CHECKING:
    from common.bus.bus import Bus
    from common.messages.definitions import Scan
    from services.estimator.shared.interface import Estimator, Observation

LOOK_PERIOD = 0.5  # s between two looks at who is there
PULSE_PERIOD = 0.05  # s between two looks at whose health is due
AT_ONCE = 20  # messages of one robot, before the next one's turn
WAITING, WAITING_BYTES = 1000, 1 << 24  # messages, and bytes, of one robot


class FleetRobot(EstimatorService):
    """One robot's estimator; the fleet answers its scans."""

    def __init__(self, settings: EstimatorSettings, robot: str, models: Models, fleet: Fleet) -> None:
        """``settings`` are the process's; what this robot says of itself is what one of its own would say."""
        super().__init__(settings.model_copy(update={"robot": robot, "robots": ""}), models)
        self.robot, self.fleet = robot, fleet
        self.log = logger(self.name).bind(robot=robot)
        self._asked: deque[tuple[Scan, Estimator, Observation]] = deque()  # the first is with the fleet

    def infer(self, scan: Scan, estimator: Estimator, observation: Observation) -> None:
        """Hand the scan to the fleet; one that came without its odometry may go before it."""
        self._asked.append((scan, estimator, observation))
        if len(self._asked) == 1:
            self.fleet.begin(self.robot, estimator, observation)

    def settle(self, outcome: Outcome) -> None:
        """What came of the scan; raises what the estimator raised."""
        scan, estimator, _ = self._asked.popleft()
        try:
            if outcome.error is not None:
                raise outcome.error
            if outcome.posterior is not None:
                self.conclude(scan, outcome.posterior, estimator.name)
        finally:
            if self._asked:
                self.fleet.begin(self.robot, *self._asked[0][1:])

    def forget(self) -> None:
        """Nothing is believed any more; the next scan begins from nothing."""
        self.fleet.drop(self.robot)
        self._asked.clear()
        self.estimator = self.geometry = self.waiting = self.odom = self.command = self.last = None


class FleetService(Service):
    """What `main` runs where several robots are to be served."""

    name = EstimatorService.name

    def __init__(self, settings: EstimatorSettings) -> None:
        """Raises UserError where a setting is for one robot alone."""
        super().__init__(settings)
        self.options = settings
        if settings.initial_pose:
            raise UserError("--initial-pose is of one robot: leave it out with --robots, or ask `localise` of each")

    def make_loop(self, bus: Bus) -> Runnable:
        """See Service."""
        return FleetLoop(self.options, bus)


def key_expression(pattern: str) -> str:
    """A pattern of names as zenoh writes it: the same names or more, so that other sites' scans stay where they are."""
    written = re.sub(r"[*?]+", "$*", pattern)
    return "*" if written == "$*" else written


@dataclass
class Member:
    """A robot that is served."""

    service: FleetRobot
    loop: Loop
    bus: Bus
    named: bool  # not found by a pattern: its keys are kept
    begun: bool = False  # else another estimator of this robot leads
    scans: int = 0  # received at the last look
    heard: float = 0.0  # s, when there was one more


class FleetLoop:
    """Runs the estimators of all robots on one session, in one thread."""

    def __init__(self, settings: EstimatorSettings, bus: Bus) -> None:
        """``settings.robots``: names, and patterns of names, comma-separated."""
        self.settings, self.bus, self.fleet = settings, bus, Fleet()
        wanted = [part.strip() for part in settings.robots.split(",") if part.strip()]
        self.names = list(dict.fromkeys(name for name in wanted if ROBOT_NAME.fullmatch(name)))
        self.patterns = [name for name in wanted if name not in self.names]
        if len(self.names) > settings.max_robots:
            raise UserError(f"{len(self.names)} robots are named, --max-robots is {settings.max_robots}: raise it")
        self.log = logger(FleetService.name)
        self._members: dict[str, Member] = {}
        self._there: dict[str, set[str]] = defaultdict(set)  # services by robot
        self._news: SimpleQueue[tuple[str, str, bool]] = SimpleQueue()
        self._strangers = Inbox(capacity=10 * settings.max_robots)  # scans of whoever matches no name
        self._changed = threading.Condition()
        self._may_log = LogRateLimiter()
        self._pulse_at = self._look_at = 0.0
        self._stopping = False

    def run(self) -> None:
        """Until `stop`."""
        self.models = Models(self.settings)
        for name in self.names:
            self._take_on(name, named=True)
        self.bus.watch_robots(lambda robot, service, there: self._news.put((robot, service, there)))
        for pattern in self.patterns:
            self.bus.subscribe(SCAN, self._strangers, robot=key_expression(pattern))
        self.log.info("ready for robots", named=len(self.names), patterns=",".join(self.patterns) or "none")
        while not self._stopping:
            self._turn()

    def stop(self) -> None:
        """End after the current step; safe from a signal handler."""
        self._stopping = True
        with self._changed:
            self._changed.notify_all()

    def _turn(self) -> None:
        """What has come, a step of inference, what is due."""
        for member in list(self._members.values()):
            self._hear(member)
        for outcome in self.fleet.step():
            member = self._members[outcome.robot]
            member.loop.guard(lambda m=member, o=outcome: m.service.settle(o))  # type: ignore[misc]
        now = time.monotonic()
        if now >= self._pulse_at:
            self._pulse_at = now + PULSE_PERIOD
            for member in self._members.values():
                if member.begun:
                    member.loop.pulse()
        if now >= self._look_at:
            self._look_at = now + LOOK_PERIOD
            self._look(now)
        if self.fleet.idle:
            with self._changed:
                if not self._stopping and not any(len(member.loop.inbox) for member in self._members.values()):
                    self._changed.wait(max(0.0, min(self._pulse_at, self._look_at) - time.monotonic()))

    def _hear(self, member: Member) -> None:
        """Its messages in order, until a scan is being answered: of those that come meanwhile the newest will do."""
        loop = member.loop
        for _ in range(AT_ONCE):
            if not len(loop.inbox) or self.fleet.busy(member.service.robot):
                return
            try:
                loop.handle(loop.inbox.get(0))
            except UserError as error:  # of this robot; the others are served on
                self.log.warning(str(error), robot=member.service.robot)
                self._dismiss(member)
                return

    def _look(self, now: float) -> None:
        """Who has come, who is gone."""
        while True:
            try:
                robot, service, there = self._news.get_nowait()
            except Empty:
                break
            (self._there[robot].add if there else self._there[robot].discard)(service)
            if not self._there[robot]:
                del self._there[robot]
        for name in [*self._heard_strangers(), *(n for n, alive in self._there.items() if "simulator" in alive)]:
            if name not in self._members and self._matches(name):
                self._welcome(name, now)
        for name, member in list(self._members.items()):
            if not member.begun:
                member.begun = member.loop.try_start()
            count = member.loop.inbox.received[SCAN.key(name)]
            if count != member.scans or "simulator" in self._there.get(name, ()):
                member.scans, member.heard = count, now
            elif now - member.heard > self.settings.forget:
                self._forget(name, member)

    def _heard_strangers(self) -> list[str]:
        found = []
        while isinstance(sample := self._strangers.get(0), Sample):
            found.append(sample.key.split("/")[1])
        return found

    def _matches(self, name: str) -> bool:
        return bool(ROBOT_NAME.fullmatch(name)) and any(fnmatchcase(name, pattern) for pattern in self.patterns)

    def _welcome(self, name: str, now: float) -> None:
        """Serve a robot that a pattern found, unless it has an estimator of its own, or there are too many."""
        if "estimator" in self._there.get(name, ()):
            return
        if len(self._members) >= self.settings.max_robots:
            if self._may_log("many"):
                self.log.warning("too many robots", not_served=name, max_robots=self.settings.max_robots)
            return
        self._take_on(name, named=False)
        self._members[name].heard = now

    def _take_on(self, name: str, *, named: bool) -> None:
        service, bus = FleetRobot(self.settings, name, self.models, self.fleet), self.bus.for_robot(name)
        loop = Loop(service, bus, Inbox(WAITING, WAITING_BYTES, self._changed))
        loop.open()
        self._members[name] = Member(service, loop, bus, named, loop.try_start(), heard=time.monotonic())
        self._count()

    def _dismiss(self, member: Member) -> None:
        """Another estimator leads this robot: one that was named stands by."""
        name = member.service.robot
        member.service.forget()
        del self._members[name]
        member.bus.undeclare_all()
        if member.named:
            self._take_on(name, named=True)
        self._count()

    def _forget(self, name: str, member: Member) -> None:
        """Its belief; where a pattern found it, its keys too."""
        if member.service.estimator is not None or not member.named:
            self.log.info("robot forgotten", robot=name, seconds=self.settings.forget)
        member.service.forget()
        member.heard = time.monotonic()
        if not member.named:
            del self._members[name]
            member.bus.undeclare_all()
            self._count()

    def _count(self) -> None:
        for member in self._members.values():
            member.service.counters["robots_served"] = len(self._members)
