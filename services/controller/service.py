"""The controller's thin shell: beliefs and goals in, commands and status out. No torch in this process."""

from __future__ import annotations

import time
from typing import ClassVar

from common.messages import Belief, CmdVel, Drive, Goal, Scan, Stamped, Status
from common.robot import Robot
from common.service import Service
from common.topics import BELIEF, CMD_VEL, DRIVE, GOAL, SCAN, STATUS, Topic
from common.world import load_world
from services.controller.action import Preference
from services.controller.navigator import Navigator
from services.controller.settings import ControllerSettings


class ControllerService(Service):
    """Action as a process."""

    name: ClassVar[str] = "controller"
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, BELIEF, GOAL, DRIVE)

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
            # A hand needs no belief, and so no estimator.
            if self._belief_at is None and (answer := self.navigator.steer(message.stamp_ns)) is not None:
                self._answer(*answer)
        elif isinstance(message, Drive):
            self.navigator.hear_drive(message)
        elif isinstance(message, Goal):
            self.navigator.hear_goal(message)
            self.log.info("goal", x=message.pose.x, y=message.pose.y, cancel=message.cancel)
            self.publish(STATUS, self.navigator.status(self._last[0] if self._last else 0, None))
        elif isinstance(message, Belief):
            self._belief_at = time.monotonic()
            if self._last is None or self._last[0] != message.stamp_ns:
                self._answer(*self.navigator.step(message))
            else:  # one sent again is answered again
                self._send(self._last[1], self._last[2])

    def _answer(self, command: CmdVel, status: Status) -> None:
        if status.state != (self._last[2].state if self._last is not None else "idle"):
            self.log.info(status.state, reason=status.reason)
        self._last = (command.stamp_ns, command, status)
        self._send(command, status)

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
