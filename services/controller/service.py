"""The controller service: beliefs in, velocity commands out."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from common.geometry.world import load_world
from common.limits import MAX_FIELD_SIDE
from common.messages.definitions import Belief, Drive, Goal, Map, Plan, Pose, Preference, Scan, Stamped, Status
from common.messages.requests import PredictReply, PredictRequest, Reply
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    DRIVE,
    GOAL,
    MAP,
    PLAN,
    PREDICT,
    PREFERENCE,
    SCAN,
    STATUS,
    Query,
    Topic,
)
from common.runtime.service import Service
from services.controller.background_job import BackgroundJob
from services.controller.belief_wait import Answered, AwaitsPredictions, AwaitsScan, BeliefWait, NoBelief
from services.controller.navigator import Answer, Navigator
from services.controller.policies import grid_paths
from services.controller.policies.exploration import choose_viewpoint
from services.controller.policies.paper_action import ActionParameters
from services.controller.policies.planner import GeodesicPolicy
from services.controller.policies.straight_line import StraightLinePolicy
from services.controller.settings import ControllerSettings

if TYPE_CHECKING:
    from services.controller.growing_map import PlanningMap
    from services.controller.policies.exploration import ExplorationState, NoPath, Viewpoint
    from services.controller.policies.geodesic_field import CostField

PREDICTED_BEAMS = 61  # beams of a predicted scan: enough to tell places apart, and a short reply
FIELD_PERIOD_NS = 5_000_000_000  # an unchanged cost field is published again after this time
SCAN_TIMEOUT_S = 0.2  # how long a belief waits for its scan
PREDICTION_TIMEOUT_S = 0.3  # how long a belief waits for predictions, which are requested once a second at most
MAX_FIELD_CELLS = 250_000  # of a published cost field, so that the message is smaller than `MAX_BYTES`
NO_REQUEST = -1  # differs from the number of every request


def preference_message(field: CostField, goal: Goal, stamp_ns: int) -> Preference:
    """The cost field of a goal as a message.

    In a large building, a cell of the message is a square of several cells and has the least cost in it.
    """
    grid = field.graph.grid
    known = np.where(field.graph.free.unknown, np.inf, field.cost)
    side = math.ceil(math.sqrt(known.size / MAX_FIELD_CELLS))
    side = max(side, *(math.ceil(length / MAX_FIELD_SIDE) for length in known.shape))
    padded = np.pad(known, [(0, -length % side) for length in known.shape], constant_values=np.inf)
    rows, columns = padded.shape[0] // side, padded.shape[1] // side
    return Preference(
        stamp_ns=stamp_ns,
        goal=goal.pose,
        origin=Pose(x=grid.origin[0], y=grid.origin[1]),
        resolution=grid.resolution * side,
        width=columns,
        height=rows,
        distance=padded.reshape(rows, side, columns, side).min(axis=(1, 3)).ravel().astype(np.float32),
    )


class ControllerService(Service):
    """Runs a `Navigator` on the bus.

    Each belief is answered by a command with the belief's stamp, usually at once; `belief_wait` describes when it has
    to wait. If no belief arrives for `belief_timeout`, the controller commands a stop, once. From then on each scan is
    answered instead, so that manual driving works without an estimator.
    """

    name: ClassVar[str] = "controller"
    single: ClassVar[bool] = True
    restores_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, BELIEF, GOAL, DRIVE, MAP)

    settings: ControllerSettings

    def __init__(self, settings: ControllerSettings) -> None:
        super().__init__(settings)
        self.navigator: Navigator  # made by `open`
        self.geodesic: GeodesicPolicy | None = None  # the policy if the preset is `geodesic`
        self._last_map: Map | None = None  # from the mapper
        self._restored_goal: Goal | None = None  # of the previous controller instance; waits for the mapper's first map
        self._map: PlanningMap | None = None  # the mapper's, if the policy plans in it
        self._map_job: BackgroundJob[PlanningMap] = BackgroundJob(self._wake)
        self._viewpoint_job: BackgroundJob[tuple[Viewpoint | NoPath | None, ExplorationState]] = BackgroundJob(
            self._wake
        )
        self._wait: BeliefWait = NoBelief()
        self._belief_received_s = 0.0  # time.monotonic() of the latest belief
        self._latest_request = NO_REQUEST  # number of the latest request for predictions

        # What was published last.
        self._last_answer: Answer | None = None
        self._field_published_ns = -FIELD_PERIOD_NS
        self._plan_shown = False  # whether the last published plan has content

    def open(self) -> None:
        """Loads the map and creates the navigator."""
        settings = self.settings
        settings.check()
        robot = settings.build_robot()
        world = None
        if settings.world:
            self.log.info("loading the world", world=settings.world)
            world = load_world(settings.world)
        if settings.preset == "geodesic":
            grid_paths.prepare()
            keep_heading = settings.heading == "keep"
            self.geodesic = GeodesicPolicy(robot, world, keep_heading=keep_heading, epistemic=settings.epistemic)
        policy = self.geodesic or StraightLinePolicy(robot, ActionParameters(gamma=settings.gamma), world)
        self.navigator = Navigator(robot, world, policy, settings.build_self_filter())
        # Declare the publishers now: the first message on a key that was just declared may be lost.
        for topic in (STATUS, CMD_VEL, PLAN, PREFERENCE):
            self.loop.bus.publisher(topic, self.name)

    def on_restored(self, last: dict[Topic, Stamped]) -> None:
        """Resumes the goal of the previous controller instance, if it was still under way."""
        goal, status = last.get(GOAL), last.get(STATUS)
        if not isinstance(goal, Goal) or not isinstance(status, Status) or goal.cancel or goal.explore:
            return
        if self.navigator.goal_state.goal is not None:
            return  # a new goal has arrived already
        under_way = status.state not in {"idle", "reached"} and not status.refused
        if under_way and status.goal == goal.pose_in_map(self.navigator.world) and status.goal_seq == goal.seq:
            if self.geodesic is not None and not self.settings.world:
                self._restored_goal = goal  # without a map it would be refused
            else:
                self._resume(goal)

    def _resume(self, goal: Goal) -> None:
        self.navigator.on_goal(goal)
        self.log.warning("resuming the goal of the previous controller instance", x=goal.pose.x, y=goal.pose.y)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Answers a belief by a command with its stamp, and a goal by a status at once."""
        if isinstance(message, Scan):
            self._on_scan(message)
        elif isinstance(message, Drive):
            self.navigator.on_drive(message)
        elif isinstance(message, Goal):
            self._restored_goal = None
            self.navigator.on_goal(message)
            if isinstance(self._wait, NoBelief):
                self.navigator.goal_state.lose_belief("no {}: {}".format(*self._missing_input()))
            self._log_goal(message)
            self.publish(STATUS, self.navigator.status(self._last_stamp_ns))
        elif isinstance(message, Belief):
            self._on_belief(message)
        elif isinstance(message, Map) and self.geodesic is not None and not self.settings.world:
            self._plan_in(message, self.geodesic.robot.radius)

    def _log_goal(self, goal: Goal) -> None:
        if goal.cancel:
            self.log.info("goal cancelled")
        elif goal.explore:
            self.log.info("exploration requested")
        else:
            floor = {"floor": goal.map_id} if goal.map_id else {}
            self.log.info("goal", x=goal.pose.x, y=goal.pose.y, **floor)

    def _plan_in(self, message: Map, radius: float) -> None:
        """Prepares a map for planning in a thread, unless it is the last one again, repeated for late subscribers."""
        from services.controller.growing_map import PlanningMap

        last, self._last_map = self._last_map, message
        if last is None or message.model_copy(update={"stamp_ns": last.stamp_ns, "seq": last.seq}) != last:
            self._map_job.submit(lambda: PlanningMap.of(message, radius))

    def close(self) -> None:
        """Waits for the background threads."""
        self._map_job.close()
        self._viewpoint_job.close()

    def _wake(self) -> None:
        self.loop.inbox.wake()

    def _on_scan(self, scan: Scan) -> None:
        self.navigator.on_scan(scan)
        if isinstance(self._wait, AwaitsScan) and self._wait.belief.stamp_ns <= scan.stamp_ns:
            self._process(self._wait.belief)
        # Manual driving needs no belief, so it works without an estimator.
        if isinstance(self._wait, NoBelief) and (answer := self.navigator.step_without_belief(scan.stamp_ns)):
            self._answer(answer)

    def _on_belief(self, belief: Belief) -> None:
        self._belief_received_s = time.monotonic()
        if isinstance(self._wait, NoBelief):
            self._wait = Answered()
        if self._last_answer is not None and self._last_stamp_ns == belief.stamp_ns:
            self._send(self._last_answer)  # a repeated belief gets the same answer again
            return
        if isinstance(self._wait, AwaitsScan | AwaitsPredictions) and self._wait.belief.stamp_ns == belief.stamp_ns:
            return  # repeated before it was answered
        if isinstance(self._wait, AwaitsScan):
            self._process(self._wait.belief)
        scan_stamp_ns = self.navigator.scan_stamp
        if scan_stamp_ns is None or scan_stamp_ns >= belief.stamp_ns:
            self._process(belief)
            return
        if isinstance(self._wait, AwaitsPredictions):
            self._step(self._wait.belief, self._wait.cpu_ns)
        self._wait = AwaitsScan(belief, self._belief_received_s + SCAN_TIMEOUT_S)

    def _process(self, belief: Belief) -> None:
        """Answers a belief, or requests predictions first if the policy needs them."""
        self._wait = Answered()  # set first, so that a belief whose step raises an exception is not processed again
        start_ns, paths = time.thread_time_ns(), None
        if self.geodesic is not None and self.navigator.goal_state.active:
            paths = self.geodesic.prediction_request(belief)
        cpu_ns = time.thread_time_ns() - start_ns
        if paths is None:
            self._step(belief, cpu_ns)
            return
        request = PredictRequest(poses=paths.poses().reshape(-1, 3), beams=PREDICTED_BEAMS)
        self._latest_request = self.send_request(PREDICT, request, PREDICTION_TIMEOUT_S)
        self._wait = AwaitsPredictions(belief, cpu_ns)

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:  # noqa: ARG002 - PREDICT is the only query
        """Passes predictions to the policy, and answers the belief that waits for them, even if the request failed."""
        if number != self._latest_request or self.geodesic is None:
            return
        if isinstance(reply, PredictReply) and reply.ok:
            self.geodesic.use_predictions(reply)
        else:
            self.geodesic.fail_prediction(reply.reason)
            self.log.warning("no predictions", reason=reply.reason)
        if isinstance(self._wait, AwaitsPredictions):
            self._step(self._wait.belief, self._wait.cpu_ns)

    def _step(self, belief: Belief, cpu_ns: int) -> None:
        """Answers a belief by a command; ``cpu_ns`` is the CPU time that this thread has spent on it so far."""
        self._wait = Answered()
        start_ns = time.thread_time_ns()
        answer = self.navigator.step(belief)
        self._choose_viewpoint()
        took_us = (time.thread_time_ns() - start_ns + cpu_ns) // 1000
        self.counters["steps"] += 1
        self.counters["step_us"] += took_us
        self.counters["step_us_max"] = max(self.counters["step_us_max"], took_us)
        self._answer(answer)

    @property
    def _last_stamp_ns(self) -> int:
        """Stamp of the last answer; 0 before the first one."""
        return 0 if self._last_answer is None else self._last_answer.command.stamp_ns

    def _answer(self, answer: Answer) -> None:
        status = answer.status
        if status.state != ("idle" if self._last_answer is None else self._last_answer.status.state):
            self.log.info(status.state, **({"reason": status.reason} if status.reason else {}))
        self._last_answer = answer
        self._send(answer)
        self._publish_plan(answer.command.stamp_ns)

    def due(self) -> float | None:
        """Seconds until the deadline of the present wait, 0 if a job is done; None if there is nothing to wait for."""
        return 0.0 if self._map_job.ready or self._viewpoint_job.ready else self._deadline()

    def _deadline(self) -> float | None:
        """Seconds until the deadline of the present wait; None before the first belief, and after a timeout."""
        if isinstance(self._wait, NoBelief):
            return None
        deadline_s = self._belief_received_s + self.settings.belief_timeout
        if isinstance(self._wait, AwaitsScan):
            deadline_s = min(deadline_s, self._wait.deadline_s)
        return deadline_s - time.monotonic()

    def on_timer(self) -> None:
        """Uses the result of a job; at a deadline, processes the belief that waits for its scan, or stops the robot."""
        if self._map_job.ready:
            self._use_map(self._map_job.take())
            return
        if self._viewpoint_job.ready:
            self.navigator.use_viewpoint(*self._viewpoint_job.take())
            return
        if isinstance(self._wait, AwaitsScan):
            self._process(self._wait.belief)
            return
        self._wait = NoBelief()
        missing, question = self._missing_input()
        reason = f"no {missing} for {self.settings.belief_timeout:g} s: {question}"
        # A robot that stands may well wait for a search of the whole map, as after `presage relocalise`.
        if self._last_answer is not None and self._last_answer.command.twist.array().any():
            self.log.warning("stopping the robot", reason=reason)
        self.counters["belief_timeouts"] += 1
        self._send(self.navigator.stop_without_belief(self._last_stamp_ns, reason))

    def _missing_input(self) -> tuple[str, str]:
        """What does not arrive, and the question that helps to find out why."""
        if self.navigator.waits_for_scan:
            return "scan", "is the simulation paused, or the scanner silent?"
        return "belief", "is the estimator running?"

    def _use_map(self, planned: PlanningMap) -> None:
        assert self.geodesic is not None  # noqa: S101 - it plans in the map
        self.geodesic.use_map(planned.graph, jumped=self._map is not None and planned.jumped_from(self._map))
        self._map = planned
        self.navigator.on_map(planned)
        restored, self._restored_goal = self._restored_goal, None
        if restored is not None:
            self._resume(restored)
        self._choose_viewpoint()

    def _choose_viewpoint(self) -> None:
        """Starts to choose a viewpoint in a thread, if the exploration needs one."""
        if (exploration_state := self.navigator.take_exploration_state()) is not None:
            self._viewpoint_job.submit(lambda: (choose_viewpoint(exploration_state), exploration_state))

    def _send(self, answer: Answer) -> None:
        self.publish(STATUS, answer.status)
        self.publish(CMD_VEL, answer.command)

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
        if (self.geodesic.field_changed or repeat) and (goal := self.navigator.goal_state.goal) is not None:
            self.geodesic.field_changed, self._field_published_ns = False, stamp_ns
            if (field := self.geodesic.field) is not None:
                self.publish(PREFERENCE, preference_message(field, goal, stamp_ns))
