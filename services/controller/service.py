"""The controller's thin shell: beliefs and goals in, commands and status out. No torch in this process."""

from __future__ import annotations

import time
from typing import ClassVar

from common.messages import Belief, CmdVel, Goal, Scan, Stamped, Status
from common.robot import Robot
from common.service import Service
from common.topics import BELIEF, CMD_VEL, GOAL, SCAN, STATUS, Topic
from common.world import load_world
from services.controller.action import Preference
from services.controller.navigator import Navigator
from services.controller.settings import ControllerSettings


class ControllerService(Service):
    """Action as a process."""

    name: ClassVar[str] = "controller"
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, BELIEF, GOAL)

    def __init__(self, settings: ControllerSettings) -> None:
        """Standing, until told."""
        super().__init__(settings)
        self.options = settings
        self.navigator = Navigator()
        self._last: tuple[int, CmdVel, Status] | None = None
        self._belief_at: float | None = None  # wall time of the last belief; None: its absence has been said

    def open(self) -> None:
        """Know the robot's limits, and where walls are."""
        options = self.options
        robot = Robot(drive=options.drive, max_speed=options.max_speed, acceleration=options.acceleration)
        world = load_world(options.world) if options.world else None
        self.navigator = Navigator(robot, Preference(gamma=options.gamma, reach=options.reach), world)
        # Declared before anybody asks: the first message on a key just declared may be lost.
        for topic in (STATUS, CMD_VEL):
            self.loop.bus.publisher(topic, self.name)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """A belief is answered by a command of the same stamp; a goal by a status, at once."""
        if isinstance(message, Scan):
            self.navigator.hear_scan(message)
        elif isinstance(message, Goal):
            self.navigator.hear_goal(message)
            self.log.info("goal", x=message.pose.x, y=message.pose.y, cancel=message.cancel)
            self.publish(STATUS, self.navigator.status(self._last[0] if self._last else 0, None))
        elif isinstance(message, Belief):
            self._belief_at = time.monotonic()
            if self._last is None or self._last[0] != message.stamp_ns:  # one sent again is answered again
                before = self.navigator.state
                self._last = (message.stamp_ns, *self.navigator.step(message))
                if self.navigator.state != before:
                    self.log.info(self.navigator.state, reason=self.navigator.reason)
            self._send(self._last[1], self._last[2])

    def due(self) -> float | None:
        """Until the belief is too old."""
        if self._belief_at is None:
            return None
        return self._belief_at + self.options.belief_timeout - time.monotonic()

    def on_timer(self) -> None:
        """No fresh belief: stand, and say so once."""
        self._belief_at = None
        stamp = self._last[0] if self._last is not None else 0
        why = f"no belief for {self.options.belief_timeout:g} s: is the estimator running?"
        self.log.warning("standing", why=why)
        self.counters["belief_timeouts"] += 1
        self._send(*self.navigator.without_belief(stamp, why))

    def _send(self, command: CmdVel, status: Status) -> None:
        self.publish(STATUS, status)
        self.publish(CMD_VEL, command)
