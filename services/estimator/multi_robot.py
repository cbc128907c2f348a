"""One estimator process for several robots: tracks all of them in one thread, and searches in another."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING

from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.log import LogRateLimiter, logger
from common.messages.topics import ROBOT_NAME_PATTERN, SCAN
from common.names import split_names
from common.runtime.runnable import Runnable
from common.runtime.service import Service
from common.runtime.service_loop import ServiceLoop
from services.estimator.service import EstimatorService, SharedModels
from services.estimator.settings import EstimatorSettings
from services.estimator.shared.interface import SearchingEstimator

if TYPE_CHECKING:
    from common.bus.bus import Bus
    from common.messages.definitions import Scan
    from services.estimator.shared.interface import Observation, PoseEstimator, Posterior

DISCOVERY_PERIOD_S = 0.5  # between two checks for new and absent robots
RETRY_PERIOD_S = 10.0  # after which a robot that could not be served is tried again
HEALTH_CHECK_PERIOD_S = 0.05  # between two checks for due health messages
MAX_MESSAGES_PER_STEP = 20  # handled for one robot before the next one
INBOX_MESSAGES, INBOX_BYTES = 1000, 1 << 24  # of one robot
# A tenth of Python's default, because tracking may wait this long for the search thread.
THREAD_SWITCH_INTERVAL_S = 5e-4
StartSearch = Callable[[Callable[[], "Posterior"]], "Future[Posterior]"]


class FleetRobot(EstimatorService):
    """The estimator of one of several robots; its searches run in another thread."""

    def __init__(
        self, settings: EstimatorSettings, robot: str, models: SharedModels, start_search: StartSearch, *, named: bool
    ) -> None:
        """``settings`` are those of the process; ``start_search`` runs a function in the thread for searches.

        A ``named`` robot stays in the fleet while it is silent; the others were found by a pattern.
        """
        super().__init__(settings.model_copy(update={"robot": robot, "robots": ""}), models)
        self.robot, self.named = robot, named
        self.active = False  # if false, another process serves this robot, and this one stands by
        self.last_seen = time.monotonic()  # when scans or a simulator of this robot were last seen
        self.scans_at_last_check = 0  # number of scans received until the last check
        self.log = logger(self.name).bind(robot=robot)
        self.search: Future[Posterior] | None = None  # while it exists, no further message is handled
        self._start_search = start_search
        self._searched_scan: Scan | None = None

    def update_estimator(self, scan: Scan, estimator: PoseEstimator, observation: Observation) -> None:
        """Tracks at once, and starts a search if one is needed."""
        self.finish_search()  # of the last scan, if its odometry did not arrive until this one came
        if not isinstance(estimator, SearchingEstimator):
            super().update_estimator(scan, estimator, observation)
        elif (posterior := estimator.track(observation)) is not None:
            self.publish_posterior(scan, posterior, estimator.name)
        else:
            self.search, self._searched_scan = self._start_search(estimator.search), scan

    def try_start(self) -> None:
        """Becomes active, unless another process serves this robot."""
        self.active = self.loop.try_start()

    def finish_search(self) -> None:
        """Waits for the search, if there is one, and publishes its result. Raises the exception of a failed search."""
        search, self.search = self.search, None
        if search is not None and self._searched_scan is not None and self.estimator is not None:
            self.publish_posterior(self._searched_scan, search.result(), self.estimator.name)

    def has_work(self) -> bool:
        """Whether a search has ended or a message can be handled."""
        return len(self.loop.inbox) > 0 if self.search is None else self.search.done()

    def reset(self) -> None:
        """Discards the belief; the result of a search that is running will not be used."""
        if self.search is not None:
            self.search.cancel()
        self.odometry_sync.clear()
        self.search = self.estimator = self.geometry = self.command = self.last = None


class FleetService(Service):
    """The service that `main` runs for several robots."""

    settings: EstimatorSettings
    name = EstimatorService.name

    def __init__(self, settings: EstimatorSettings) -> None:
        """Raises UserError if a setting is only for one robot."""
        super().__init__(settings)
        settings.check_several_robots()
        if settings.metrics:
            self.log.warning("--metrics is ignored with --robots: read the health messages of each robot instead")

    def make_loop(self, bus: Bus) -> Runnable:
        """Creates the loop that serves all robots; see Service."""
        return FleetLoop(self.settings, bus)


def key_expression(pattern: str) -> str:
    """Zenoh's key expression for a pattern of names; it matches at least the names that the pattern matches."""
    expression = re.sub(r"[*?]+", "$*", pattern)
    return "*" if expression == "$*" else expression


class FleetLoop:
    """Runs the estimators of all robots on one session."""

    def __init__(self, settings: EstimatorSettings, bus: Bus) -> None:
        """``settings.robots`` are names and patterns of names, separated by commas."""
        self.settings, self.bus = settings, bus
        self.names = settings.robot_names
        self.patterns = [name for name in split_names(settings.robots) if name not in self.names]
        self.log = logger(FleetService.name)
        self._robots: dict[str, FleetRobot] = {}
        self._alive: set[tuple[str, str]] = set()  # robot and service; changed by zenoh's threads
        # Scans of all robots that match a pattern, served or not; only their keys are used, to find robots
        self._found_scans = Inbox(capacity=10 * settings.max_robots)
        self._changed = threading.Condition()  # notified of every message and every search that ended
        self._searches = ThreadPoolExecutor(1, "search")
        self._may_log = LogRateLimiter()
        self._next_health_check = self._next_discovery = 0.0
        self._retry_at: dict[str, float] = {}  # time.monotonic(), by name of a robot that could not be served
        self._stopping = False

    def run(self) -> None:
        """Runs until `stop` is called."""
        sys.setswitchinterval(THREAD_SWITCH_INTERVAL_S)
        self.models = SharedModels(self.settings)
        self._add_named_robots()
        self.bus.watch_robots(self._note_liveliness)
        for pattern in self.patterns:
            self.bus.subscribe(SCAN, self._found_scans, robot=key_expression(pattern))
        self.log.info("ready for robots", named=len(self.names), patterns=",".join(self.patterns) or "none")
        try:
            while not self._stopping:
                self._step()
        finally:
            self._searches.shutdown(cancel_futures=True)

    def stop(self) -> None:
        """Makes `run` return after its current step; safe to call from a signal handler."""
        self._stopping = True
        self._wake()

    def _step(self) -> None:
        """Serves each robot once, and publishes health and looks for robots when it is time."""
        for robot in list(self._robots.values()):
            self._guard(robot, partial(self._serve, robot))
        now = time.monotonic()
        if now >= self._next_health_check:
            self._next_health_check = now + HEALTH_CHECK_PERIOD_S
            for robot in list(self._robots.values()):
                if robot.active:
                    self._guard(robot, robot.loop.publish_health_if_due)
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD_S
            self._add_named_robots()
            self._add_found_robots()
            self._update_robots(now)
        with self._changed:
            if not self._stopping and not any(robot.has_work() for robot in self._robots.values()):
                self._changed.wait(max(0.0, min(self._next_health_check, self._next_discovery) - time.monotonic()))

    def _serve(self, robot: FleetRobot) -> None:
        """Handles the messages of a robot in order, until a search has to end first."""
        for _ in range(MAX_MESSAGES_PER_STEP):
            if not robot.has_work():
                return
            if robot.search is not None:
                robot.loop.run_guarded(robot.finish_search)
            else:
                robot.loop.handle(robot.loop.inbox.get(0))

    def _guard(self, robot: FleetRobot, work: Callable[[], None]) -> None:
        """Does some work for a robot. On a UserError, such as another protocol version, only this robot is removed.

        It is tried again after `RETRY_PERIOD_S`.
        """
        try:
            work()
        except UserError as error:
            self.log.warning(str(error), robot=robot.robot)
            self._remove(robot)
            self._retry_later(robot.robot)

    def _retry_later(self, name: str) -> None:
        """Postpones the next attempt to serve a robot by `RETRY_PERIOD_S`."""
        now = time.monotonic()
        waiting = {other: at for other, at in self._retry_at.items() if at > now}
        self._retry_at = {**waiting, name: now + RETRY_PERIOD_S}

    def _start_search(self, search: Callable[[], Posterior]) -> Future[Posterior]:
        future = self._searches.submit(search)
        future.add_done_callback(lambda _: self._wake())
        return future

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _note_liveliness(self, robot: str, service: str, alive: bool) -> None:  # noqa: FBT001
        if alive:
            self._alive.add((robot, service))
        else:
            self._alive.discard((robot, service))

    def _add_named_robots(self) -> None:
        """Begins to serve the robots named in the settings."""
        for name in self.names:
            if name not in self._robots:
                self._try_to_add(name, named=True)

    def _add_found_robots(self) -> None:
        """Serves robots that a pattern found, unless they have an estimator of their own or there are too many."""
        found = [robot for robot, service in list(self._alive) if service == "simulator"]
        while isinstance(sample := self._found_scans.get(0), Sample):
            found.append(sample.key.split("/")[1])
        for name in found:
            if name in self._robots or not self._matches(name) or (name, "estimator") in self._alive:
                continue
            if len(self._robots) < self.settings.max_robots:
                self._try_to_add(name, named=False)
            elif self._may_log("many"):
                self.log.warning("too many robots", not_served=name, max_robots=self.settings.max_robots)

    def _matches(self, name: str) -> bool:
        is_name = re.fullmatch(ROBOT_NAME_PATTERN, name) is not None
        return is_name and any(fnmatchcase(name, pattern) for pattern in self.patterns)

    def _update_robots(self, now: float) -> None:
        """Starts robots that can become active, and resets those that sent no scan and had no simulator for long.

        Robots that a pattern found are then removed.
        """
        for name, robot in list(self._robots.items()):
            if not robot.active:
                self._guard(robot, robot.try_start)
                if name not in self._robots:
                    continue
            scans = robot.loop.inbox.received[SCAN.key(name)]
            if scans != robot.scans_at_last_check or (name, "simulator") in self._alive:
                robot.scans_at_last_check, robot.last_seen = scans, now
            elif now - robot.last_seen > self.settings.forget:
                if robot.estimator is not None or not robot.named:
                    self.log.info("robot forgotten", robot=name, seconds=self.settings.forget)
                robot.reset()
                robot.last_seen = now  # so that it is not reset again at each check
                if not robot.named:
                    self._remove(robot)

    def _try_to_add(self, name: str, *, named: bool) -> None:
        """Begins to serve a robot; on a UserError logs the reason. Does nothing while the attempt is postponed."""
        if time.monotonic() < self._retry_at.get(name, 0.0):
            return
        robot = FleetRobot(self.settings, name, self.models, self._start_search, named=named)
        loop = ServiceLoop(robot, self.bus.for_robot(name), Inbox(INBOX_MESSAGES, INBOX_BYTES, self._changed))
        try:
            loop.open()
            robot.try_start()
        except UserError as error:
            loop.bus.undeclare_all()
            if self._may_log(name):
                self.log.warning(str(error), robot=name)
            self._retry_later(name)
            return
        self._robots[name] = robot
        self._update_counters()

    def _remove(self, robot: FleetRobot) -> None:
        robot.reset()
        del self._robots[robot.robot]
        robot.loop.bus.undeclare_all()
        self._update_counters()

    def _update_counters(self) -> None:
        for robot in self._robots.values():
            robot.counters["robots_served"] = len(self._robots)
