"""The process."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Plan, Pose, Scan, Stamped, Status
from common.messages.definitions import Preference as Prior
from common.messages.requests import PredictReply, PredictRequest, Reply
from common.messages.topics import BELIEF, CMD_VEL, DRIVE, GOAL, PLAN, PREDICT, PREFERENCE, SCAN, STATUS, Query, Topic
from common.runtime.service import Service
from services.controller.navigator import Navigator
from services.controller.policies.paper_action import Preference
from services.controller.settings import ControllerSettings

if TYPE_CHECKING:
    from services.controller.policies.geodesic_field import Field
    from services.controller.policies.planner import Pilot

PREDICTED_BEAMS = 61  # of a scan expected elsewhere
SHOWN_AGAIN = 5_000_000_000  # ns between two messages of one field
SCAN_WITHIN = 0.2  # s that a belief waits for its own scan
PREDICTED_WITHIN = 0.3  # s that a command waits for predictions; once a second at most, and only while it seeks


def prior_of(field: Field, goal: Goal, stamp_ns: int) -> Prior:
    """The message of a field."""
    grid = field.roads.grid
    rows, columns = grid.shape
    return Prior(
        stamp_ns=stamp_ns, goal=goal.pose, origin=Pose(x=grid.origin[0], y=grid.origin[1]), resolution=grid.resolution,
        width=columns, height=rows, distance=field.cost.ravel().astype(np.float32),
    )  # fmt: skip


class ControllerService(Service):
    """Action as a process."""

    name: ClassVar[str] = "controller"
    single: ClassVar[bool] = True
    restores_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, BELIEF, GOAL, DRIVE)

    def __init__(self, settings: ControllerSettings) -> None:
        """Standing, until told."""
        super().__init__(settings)
        self.options = settings
        self.navigator = Navigator()
        self.pilot: Pilot | None = None
        self.blind = settings.build_self_filter()
        self._last: tuple[int, CmdVel, Status] | None = None
        self._waiting: Belief | None = None  # for predictions
        self._questioning_ns = 0
        self._shown = -SHOWN_AGAIN  # ns, when the field was sent
        self._early: Belief | None = None  # it came before its scan
        self._early_at = 0.0
        self._asked, self._asked_at = -1, 0.0  # number of that request, and when it was made
        self._planned = False  # a plan was published that is not empty
        self._belief_at: float | None = None  # wall time of the last belief; None: its absence has been said

    def open(self) -> None:
        """Know the robot's limits, and where walls are."""
        options = self.options
        options.check()
        robot = options.build_robot()
        if options.world:
            self.log.info("loading the world", world=options.world)
        world = load_world(options.world) if options.world else None
        if options.preset == "geodesic" and world is not None:
            # scipy takes a third of a second to import; preset paper does without.
            from services.controller.policies.planner import Pilot  # noqa: PLC0415

            self.pilot = Pilot(robot, world, keep_heading=options.heading == "keep", epistemic=options.epistemic)
        preference = Preference(gamma=options.gamma, reach=options.reach)
        self.navigator = Navigator(robot, preference, world, self.pilot)
        # Declared before anybody asks: the first message on a key just declared may be lost.
        for topic in (STATUS, CMD_VEL, PLAN, PREFERENCE):
            self.loop.bus.publisher(topic, self.name)

    def on_restored(self, last: dict[Topic, Stamped]) -> None:
        """The goal that a controller before this one was on its way to, unless told to begin with none."""
        goal, status = last.get(GOAL), last.get(STATUS)
        if not self.options.resume or not isinstance(goal, Goal) or not isinstance(status, Status) or goal.cancel:
            return
        if self.navigator.goal is not None:
            return  # somebody was quicker
        under_way = status.state not in {"idle", "reached"} and not status.refused
        if under_way and status.goal == goal.pose and status.goal_seq == goal.seq:
            self.navigator.hear_goal(goal)
            self.log.warning("going on to the goal of the controller before this one", x=goal.pose.x, y=goal.pose.y)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """A belief is answered by a command of the same stamp; a goal by a status, at once."""
        if isinstance(message, Scan):
            self.navigator.hear_scan(self.blind.mask_for_planning(message))
            if self._early is not None and self._early.stamp_ns <= message.stamp_ns:
                self._take_early()
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
            if self._last is not None and self._last[0] == message.stamp_ns:
                self._send(self._last[1], self._last[2])  # one sent again is answered again
            elif self._waiting is None or self._waiting.stamp_ns != message.stamp_ns:
                self._take_early()
                scan = self.navigator.scan_stamp
                if scan is not None and scan < message.stamp_ns:  # the network turned them round
                    self._early, self._early_at = message, time.monotonic()
                else:
                    self._take(message)

    def _take_early(self) -> None:
        """The belief that waits for its scan."""
        belief, self._early = self._early, None
        if belief is not None:
            self._take(belief)

    def _take(self, belief: Belief) -> None:
        """Answer it; where it must be known first what would be seen elsewhere, ask, and answer when that has come."""
        began = time.thread_time_ns()
        options = self.pilot.question(belief) if self.pilot is not None and self.navigator.wants_to_go else None
        self._questioning_ns = time.thread_time_ns() - began
        if options is None:
            self._waiting = None
            self._step(belief)
        else:
            self._waiting, self._asked_at = belief, time.monotonic()
            self._asked = self.request(
                PREDICT, PredictRequest(poses=options.poses(), beams=PREDICTED_BEAMS), PREDICTED_WITHIN
            )

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:  # noqa: ARG002 - it asks for nothing else
        """What is expected elsewhere has come, or a refusal."""
        if number != self._asked or self.pilot is None:
            return
        if isinstance(reply, PredictReply) and reply.ok:
            self.pilot.answer(reply)
        else:
            self.log.warning("no predictions", why=reply.reason)
        self._go_without()

    def _go_without(self) -> None:
        """Answer the belief that waits."""
        belief, self._waiting, self._asked = self._waiting, None, -1
        if belief is not None:
            self._step(belief)

    def _step(self, belief: Belief) -> None:
        """One belief, one command; what it costs is counted in the thread's own time."""
        began = time.thread_time_ns()
        answer = self.navigator.step(belief)
        took = (time.thread_time_ns() - began + self._questioning_ns) // 1000
        self.counters["steps"] += 1
        self.counters["step_us"] += took
        self.counters["step_us_max"] = max(self.counters["step_us_max"], took)
        self._answer(*answer)

    def _answer(self, command: CmdVel, status: Status) -> None:
        if status.state != (self._last[2].state if self._last is not None else "idle"):
            self.log.info(status.state, reason=status.reason)
        self._last = (command.stamp_ns, command, status)
        self._send(command, status)
        self._show(command.stamp_ns)

    def due(self) -> float | None:
        """Until the belief is too old, or what was asked for too late."""
        if self._belief_at is None:
            return None
        until = self._belief_at + self.options.belief_timeout
        if self._waiting is not None:
            until = min(until, self._asked_at + PREDICTED_WITHIN)
        if self._early is not None:
            until = min(until, self._early_at + SCAN_WITHIN)
        return until - time.monotonic()

    def on_timer(self) -> None:
        """No fresh belief: stand, and say so once."""
        if self._early is not None:
            self._take_early()
            return
        if self._waiting is not None:
            self._go_without()
            return
        self._belief_at = None
        stamp = self._last[0] if self._last is not None else 0
        why = f"no belief for {self.options.belief_timeout:g} s: is the estimator running?"
        self.log.warning("standing", why=why)
        self.counters["belief_timeouts"] += 1
        self._send(*self.navigator.without_belief(stamp, why))

    def _send(self, command: CmdVel, status: Status) -> None:
        self.publish(STATUS, status)
        self.publish(CMD_VEL, command)

    def _show(self, stamp_ns: int) -> None:
        """What it means to do and why, for whoever looks on."""
        if self.pilot is None:
            return
        decision, obstacles = self.navigator.decision, self.pilot.obstacles.points().astype(np.float32)
        path, motion = decision.path.astype(np.float32), decision.motion.astype(np.float32)
        something = bool(len(path) or len(obstacles))
        if something or self._planned:  # once more where there is nothing any more
            self.publish(PLAN, Plan(stamp_ns=stamp_ns, path=path, motion=motion, obstacles=obstacles))
        self._planned = something
        again = not 0 <= stamp_ns - self._shown < SHOWN_AGAIN  # for who comes later
        if (self.pilot.changed or again) and self.navigator.goal is not None:
            self.pilot.changed, self._shown = False, stamp_ns
            if (field := self.pilot.field) is not None:
                self.publish(PREFERENCE, prior_of(field, self.navigator.goal, stamp_ns))
