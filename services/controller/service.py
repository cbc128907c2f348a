"""The process."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Plan, Pose, Preference, Scan, Stamped, Status
from common.messages.requests import PredictReply, PredictRequest, Reply
from common.messages.topics import BELIEF, CMD_VEL, DRIVE, GOAL, PLAN, PREDICT, PREFERENCE, SCAN, STATUS, Query, Topic
from common.runtime.service import Service
from services.controller.navigator import Navigator
from services.controller.policies.paper_action import ActionParameters
from services.controller.settings import ControllerSettings

if TYPE_CHECKING:
    from services.controller.policies.geodesic_field import CostField
    from services.controller.policies.planner import GeodesicPolicy

PREDICTED_BEAMS = 61  # beams of a predicted scan
FIELD_PERIOD_NS = 5_000_000_000  # an unchanged cost field is published again after this time
SCAN_TIMEOUT_S = 0.2  # how long a belief waits for its scan
PREDICTION_TIMEOUT_S = 0.3  # how long a belief waits for predictions, which are requested once a second at most
NO_REQUEST = -1


def preference_message(field: CostField, goal: Goal, stamp_ns: int) -> Preference:
    """The cost field of a goal as a message."""
    grid = field.graph.grid
    rows, columns = grid.shape
    return Preference(
        stamp_ns=stamp_ns,
        goal=goal.pose,
        origin=Pose(x=grid.origin[0], y=grid.origin[1]),
        resolution=grid.resolution,
        width=columns,
        height=rows,
        distance=field.cost.ravel().astype(np.float32),
    )


class ControllerService(Service):
    """Runs a `Navigator` on the bus.

    Each belief is answered by a command with the belief's stamp, usually at once. Two things can delay the answer, one
    after the other:

    1. The belief arrived before its scan, because the network reordered them. It waits for the scan in
       `_belief_awaiting_scan`, for `SCAN_TIMEOUT_S` at most.
    2. The policy needs predicted scans from the estimator to choose where to go. The belief waits for the reply in
       `_belief_awaiting_predictions`, for `PREDICTION_TIMEOUT_S` at most, and is then answered without them. A newer
       belief takes its place.

    If no belief arrives for `belief_timeout`, the controller commands a stop, once, and `_last_belief_at` becomes None.
    While it is None, each scan is answered instead, so that manual driving works without an estimator.
    """

    name: ClassVar[str] = "controller"
    single: ClassVar[bool] = True
    restores_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, BELIEF, GOAL, DRIVE)

    def __init__(self, settings: ControllerSettings) -> None:
        super().__init__(settings)
        self.options = settings
        self.navigator = Navigator()
        self.geodesic: GeodesicPolicy | None = None  # the policy if the preset is `geodesic`
        self.self_filter = settings.build_self_filter()

        # Beliefs that wait, as described above. Times in s are of time.monotonic().
        self._last_belief_at: float | None = None  # None before the first belief, and after a timeout
        self._belief_awaiting_scan: Belief | None = None
        self._awaiting_scan_since = 0.0  # s
        self._belief_awaiting_predictions: Belief | None = None
        self._prediction_request = NO_REQUEST  # number of the request whose reply is awaited
        self._predictions_requested_at = 0.0  # s
        self._request_cost_ns = 0  # CPU time of preparing the request, which counts as part of the step

        # What was published last.
        self._last_answer: tuple[int, CmdVel, Status] | None = None  # stamp, command, status
        self._field_published_ns = -FIELD_PERIOD_NS
        self._plan_shown = False  # whether the last published plan has content

    def open(self) -> None:
        """Load the map and create the navigator."""
        options = self.options
        options.check()
        robot = options.build_robot()
        if options.world:
            self.log.info("loading the world", world=options.world)
        world = load_world(options.world) if options.world else None
        if options.preset == "geodesic" and world is not None:
            # scipy takes a third of a second to import, and preset paper does not need it.
            from services.controller.policies.planner import GeodesicPolicy  # noqa: PLC0415

            keep_heading = options.heading == "keep"
            self.geodesic = GeodesicPolicy(robot, world, keep_heading=keep_heading, epistemic=options.epistemic)
        parameters = ActionParameters(gamma=options.gamma)
        self.navigator = Navigator(robot, parameters, world, self.geodesic)
        # Declare the publishers now: the first message on a key that was just declared may be lost.
        for topic in (STATUS, CMD_VEL, PLAN, PREFERENCE):
            self.loop.bus.publisher(topic, self.name)

    def on_restored(self, last: dict[Topic, Stamped]) -> None:
        """Resume the goal of the previous controller instance, if it was still under way."""
        goal, status = last.get(GOAL), last.get(STATUS)
        if not isinstance(goal, Goal) or not isinstance(status, Status) or goal.cancel:
            return
        if self.navigator.goal is not None:
            return  # a new goal has arrived already
        under_way = status.state not in {"idle", "reached"} and not status.refused
        if under_way and status.goal == goal.pose and status.goal_seq == goal.seq:
            self.navigator.on_goal(goal)
            self.log.warning("resuming the goal of the previous controller instance", x=goal.pose.x, y=goal.pose.y)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Answer a belief by a command with its stamp, and a goal by a status at once."""
        if isinstance(message, Scan):
            self._on_scan(message)
        elif isinstance(message, Drive):
            self.navigator.on_drive(message)
        elif isinstance(message, Goal):
            self.navigator.on_goal(message)
            self.log.info("goal", x=message.pose.x, y=message.pose.y, cancel=message.cancel)
            stamp_ns = self._last_answer[0] if self._last_answer else 0
            self.publish(STATUS, self.navigator.status(stamp_ns, None))
        elif isinstance(message, Belief):
            self._on_belief(message)

    def _on_scan(self, scan: Scan) -> None:
        self.navigator.on_scan(self.self_filter.mask_for_planning(scan))
        if self._belief_awaiting_scan is not None and self._belief_awaiting_scan.stamp_ns <= scan.stamp_ns:
            self._process_early_belief()
        # Manual driving needs no belief, so it works without an estimator.
        if self._last_belief_at is None and (answer := self.navigator.step_without_belief(scan.stamp_ns)) is not None:
            self._answer(*answer)

    def _on_belief(self, belief: Belief) -> None:
        self._last_belief_at = time.monotonic()
        if self._last_answer is not None and self._last_answer[0] == belief.stamp_ns:
            self._send(self._last_answer[1], self._last_answer[2])  # a repeated belief gets the same answer again
            return
        waiting = self._belief_awaiting_predictions
        if waiting is not None and waiting.stamp_ns == belief.stamp_ns:
            return  # it is being processed already
        self._process_early_belief()
        scan_stamp_ns = self.navigator.scan_stamp
        if scan_stamp_ns is not None and scan_stamp_ns < belief.stamp_ns:
            self._belief_awaiting_scan, self._awaiting_scan_since = belief, time.monotonic()
        else:
            self._process(belief)

    def _process_early_belief(self) -> None:
        """Processes the belief that waits for its scan, if there is one."""
        belief, self._belief_awaiting_scan = self._belief_awaiting_scan, None
        if belief is not None:
            self._process(belief)

    def _process(self, belief: Belief) -> None:
        """Answers a belief, or requests predictions first if the policy needs them."""
        began = time.thread_time_ns()
        motions = None
        if self.geodesic is not None and self.navigator.has_active_goal:
            motions = self.geodesic.prediction_request(belief)
        self._request_cost_ns = time.thread_time_ns() - began
        if motions is None:
            self._belief_awaiting_predictions = None
            self._step(belief)
            return
        self._belief_awaiting_predictions, self._predictions_requested_at = belief, time.monotonic()
        request = PredictRequest(poses=motions.poses(), beams=PREDICTED_BEAMS)
        self._prediction_request = self.request(PREDICT, request, PREDICTION_TIMEOUT_S)

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:  # noqa: ARG002 - PREDICT is the only query
        """Pass predictions on to the policy, and answer the belief that waits for them."""
        if number != self._prediction_request or self.geodesic is None:
            return
        if isinstance(reply, PredictReply) and reply.ok:
            self.geodesic.use_predictions(reply)
        else:
            self.log.warning("no predictions", why=reply.reason)
        self._step_after_predictions()

    def _step_after_predictions(self) -> None:
        """Answers the belief that waits for predictions, whether they came or not."""
        belief, self._belief_awaiting_predictions = self._belief_awaiting_predictions, None
        self._prediction_request = NO_REQUEST
        if belief is not None:
            self._step(belief)

    def _step(self, belief: Belief) -> None:
        """Answers a belief by a command, and counts the CPU time of this thread that it took."""
        began = time.thread_time_ns()
        answer = self.navigator.step(belief)
        took_us = (time.thread_time_ns() - began + self._request_cost_ns) // 1000
        self.counters["steps"] += 1
        self.counters["step_us"] += took_us
        self.counters["step_us_max"] = max(self.counters["step_us_max"], took_us)
        self._answer(*answer)

    def _answer(self, command: CmdVel, status: Status) -> None:
        if status.state != (self._last_answer[2].state if self._last_answer is not None else "idle"):
            self.log.info(status.state, reason=status.reason)
        self._last_answer = (command.stamp_ns, command, status)
        self._send(command, status)
        self._publish_plan(command.stamp_ns)

    def due(self) -> float | None:
        """Seconds until the first of the timeouts: of the belief, the predictions, or the scan."""
        if self._last_belief_at is None:
            return None
        deadline = self._last_belief_at + self.options.belief_timeout
        if self._belief_awaiting_predictions is not None:
            deadline = min(deadline, self._predictions_requested_at + PREDICTION_TIMEOUT_S)
        if self._belief_awaiting_scan is not None:
            deadline = min(deadline, self._awaiting_scan_since + SCAN_TIMEOUT_S)
        return deadline - time.monotonic()

    def on_timer(self) -> None:
        """Answer the belief that has waited too long; if none waits, there has been no belief, so stop the robot."""
        if self._belief_awaiting_scan is not None:
            self._process_early_belief()
            return
        if self._belief_awaiting_predictions is not None:
            self._step_after_predictions()
            return
        self._last_belief_at = None
        stamp_ns = self._last_answer[0] if self._last_answer is not None else 0
        why = f"no belief for {self.options.belief_timeout:g} s: is the estimator running?"
        self.log.warning("stopping the robot", why=why)
        self.counters["belief_timeouts"] += 1
        self._send(*self.navigator.stop_without_belief(stamp_ns, why))

    def _send(self, command: CmdVel, status: Status) -> None:
        self.publish(STATUS, status)
        self.publish(CMD_VEL, command)

    def _publish_plan(self, stamp_ns: int) -> None:
        """Publishes path, predicted motion, obstacles and cost field for the page and for recordings."""
        if self.geodesic is None:
            return
        decision, obstacles = self.navigator.decision, self.geodesic.obstacles.points().astype(np.float32)
        path, motion = decision.path.astype(np.float32), decision.motion.astype(np.float32)
        has_content = bool(len(path) or len(obstacles))
        if has_content or self._plan_shown:  # an empty plan is sent once, to clear the last one
            self.publish(PLAN, Plan(stamp_ns=stamp_ns, path=path, motion=motion, obstacles=obstacles))
        self._plan_shown = has_content
        repeat = not 0 <= stamp_ns - self._field_published_ns < FIELD_PERIOD_NS  # for subscribers that joined later
        if (self.geodesic.field_changed or repeat) and self.navigator.goal is not None:
            self.geodesic.field_changed, self._field_published_ns = False, stamp_ns
            if (field := self.geodesic.field) is not None:
                self.publish(PREFERENCE, preference_message(field, self.navigator.goal, stamp_ns))
