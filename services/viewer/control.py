"""Goals, teleports, obstacles and driving over the bus.

Every action returns an `ActionResult`. An action that cannot be carried out raises UserError with the reason, which
`RobotControl.carry_out` turns into a result.
"""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

from common.bus.bus import Bus, wait_until
from common.errors import UserError
from common.messages.definitions import GOAL_TOLERANCE_M, Drive, Goal, Pose, Status, Twist
from common.messages.requests import (
    LocaliseRequest,
    ObstacleRequest,
    PoseRequest,
    RecordReply,
    RecordRequest,
    Reply,
    Request,
    ResetRequest,
    SaveMapReply,
    SaveMapRequest,
    SpeedRequest,
)
from common.messages.topics import (
    DRIVE,
    GOAL,
    LOCALISE,
    OBSTACLE,
    PAUSE,
    RECORDING,
    RESET,
    RESUME,
    SAVE_MAP,
    SPEED,
    STEP,
    TELEPORT,
    Query,
    Topic,
)
from common.runtime.session_files import session_of, start_command
from services.viewer import visitor_requests as requests
from services.viewer.state.roster import Roster

ANSWER_TIMEOUT_S = 3.0
YAW_TOLERANCE_RAD = 0.15  # for goals with a heading
SUBSCRIBER_TIMEOUT_S = 2.0  # to wait for a subscriber, because messages sent before it exists are lost
CLOCK_QUERIES = {"pause": PAUSE, "resume": RESUME, "step": STEP}
CLOCK_RESULTS = {"pause": "paused", "resume": "running", "step": "one scan further"}
R = TypeVar("R", bound=Reply)


@dataclass(frozen=True)
class ActionResult:
    """The answer to a browser's request."""

    ok: bool
    reason: str = ""
    more: dict[str, Any] = field(default_factory=dict)  # further fields of the answer


@dataclass(frozen=True)
class RobotLookup:
    """Access to the state of a robot, by its name."""

    status: Callable[[str], Status | None]  # the controller's last status
    stamp_ns: Callable[[str], int]  # stamp of the newest sensor message


class RobotControl:
    """Carries out actions on robots."""

    def __init__(self, bus: Bus, roster: Roster, lookup: RobotLookup, connect: str = "") -> None:
        """``connect`` are the endpoints shown in the command that starts a missing service; empty for the default."""
        self._bus, self._roster, self._lookup, self._connect = bus, roster, lookup, connect
        self._numbers: defaultdict[str, Iterator[int]] = defaultdict(itertools.count)  # of drive messages, by robot
        self._handlers: dict[type[requests.Action], Callable[[str, Any], ActionResult]] = {
            requests.GoTo: self._goal,
            requests.CancelGoal: self._cancel,
            requests.Explore: self._explore,
            requests.Teleport: self._teleport,
            requests.Localise: self._localise,
            requests.EditObstacle: self._obstacle,
            requests.ControlClock: self._clock,
            requests.ResetSimulation: self._reset,
            requests.SetSpeed: self._speed,
            requests.DriveByHand: self._drive,
            requests.ControlRecorder: self._record,
            requests.SaveMap: self._save_map,
        }

    def carry_out(self, robot: str, action: requests.Action) -> ActionResult:
        """Carries out an action. Returns the reason if that fails; does not raise UserError."""
        if "replay" in self._roster.services(robot):
            return ActionResult(ok=False, reason="this is a recording: choose the live robot to act on it")
        try:
            return self._handlers[type(action)](robot, action)
        except UserError as error:
            return ActionResult(ok=False, reason=str(error))

    def send_request(self, robot: str, query: Query, request: Request, reply: type[R]) -> R:
        """Returns the reply of a service. Raises UserError if it is not running, does not reply or refuses."""
        self._check_running(robot, query.server)
        answer = self._bus.query(query, request, reply, ANSWER_TIMEOUT_S, robot=robot)
        if not answer.ok:
            raise UserError(answer.reason or f"the {query.server} refused")
        return answer

    def query(self, robot: str, query: Query, request: Request, reply: type[R]) -> R:
        """Returns the reply of any service, which may be a refusal. Raises UserError if no service replies."""
        return self._bus.query(query, request, reply, ANSWER_TIMEOUT_S, robot=robot)

    def _check_running(self, robot: str, service: str) -> None:
        if service not in self._roster.services(robot):
            start = start_command(service, robot, self._connect, session_of(robot, self._connect))
            raise UserError(f"the {service} is not running; start it with: {start}")

    def _check_controller(self, robot: str, topic: Topic) -> None:
        """Waits until the controller has subscribed to the topic. Raises UserError if it does not."""
        self._check_running(robot, "controller")
        if not self._bus.wait_matching(topic, SUBSCRIBER_TIMEOUT_S, key=topic.key(robot)):
            raise UserError(f"the controller does not listen to {topic.name}: is it of this version?")

    def _goal(self, robot: str, action: requests.GoTo) -> ActionResult:
        self._check_controller(robot, GOAL)
        # Numbered by the time, so that the controller's status can be matched to this goal among those of others.
        goal = Goal(
            stamp_ns=self._lookup.stamp_ns(robot),
            seq=time.time_ns(),
            pose=Pose(x=action.x, y=action.y, yaw=action.yaw or 0.0),
            tolerance=action.tolerance or GOAL_TOLERANCE_M,
            yaw_tolerance=None if action.yaw is None else YAW_TOLERANCE_RAD,
        )
        self._bus.put(GOAL, goal.encode(), key=GOAL.key(robot))
        status = self._wait_for_status(robot, lambda status: status.goal_seq == goal.seq)
        if status is None:
            raise UserError(f"the controller did not take the goal within {ANSWER_TIMEOUT_S:g} s")
        if status.refused:
            raise UserError(status.reason)
        return ActionResult(ok=True)  # the page knows on which floor the place is

    def _explore(self, robot: str, _action: requests.Explore) -> ActionResult:
        self._check_controller(robot, GOAL)
        stamp_ns, seq = self._lookup.stamp_ns(robot), time.time_ns()
        goal = Goal(stamp_ns=stamp_ns, seq=seq, pose=Pose(x=0.0, y=0.0), explore=True)
        self._bus.put(GOAL, goal.encode(), key=GOAL.key(robot))
        status = self._wait_for_status(
            robot, lambda status: seq in {status.goal_seq, status.exploration.seq if status.exploration else None}
        )
        if status is None:
            raise UserError(f"the controller did not begin to explore within {ANSWER_TIMEOUT_S:g} s")
        if status.exploration is None:
            raise UserError(status.reason)
        return ActionResult(ok=True, reason="exploring until nothing is left to see; goals take precedence")

    def _cancel(self, robot: str, _action: requests.CancelGoal) -> ActionResult:
        self._check_controller(robot, GOAL)
        goal = Goal(stamp_ns=self._lookup.stamp_ns(robot), seq=time.time_ns(), pose=Pose(x=0.0, y=0.0), cancel=True)
        self._bus.put(GOAL, goal.encode(), key=GOAL.key(robot))
        if self._wait_for_status(robot, lambda status: status.goal is None and status.exploration is None) is None:
            raise UserError(f"the controller did not cancel the goal within {ANSWER_TIMEOUT_S:g} s")
        return ActionResult(ok=True, reason="goal cancelled")

    def _wait_for_status(self, robot: str, condition: Callable[[Status], bool]) -> Status | None:
        """The first status that meets the condition. Returns None if there is none within the timeout."""
        found: list[Status] = []

        def check() -> bool:
            status = self._lookup.status(robot)
            if status is not None and condition(status):
                found.append(status)
            return bool(found)

        return found[0] if wait_until(check, ANSWER_TIMEOUT_S) else None

    def _teleport(self, robot: str, action: requests.Teleport) -> ActionResult:
        pose = Pose(x=action.x, y=action.y, yaw=action.yaw)
        self.send_request(robot, TELEPORT, PoseRequest(pose=pose), Reply)
        return ActionResult(ok=True)

    def _localise(self, robot: str, action: requests.Localise) -> ActionResult:
        if (action.x is None) != (action.y is None):
            raise UserError("a place is x and y, in m")
        pose = None
        if action.x is not None and action.y is not None:
            pose = Pose(x=action.x, y=action.y, yaw=action.yaw or 0.0)
        self.send_request(robot, LOCALISE, LocaliseRequest(pose=pose, heading_known=action.yaw is not None), Reply)
        return ActionResult(ok=True, reason="searching near there" if pose is not None else "searching the whole map")

    def _obstacle(self, robot: str, action: requests.EditObstacle) -> ActionResult:
        request = ObstacleRequest(action=action.action, name=action.name, obstacle=action.obstacle)
        self.send_request(robot, OBSTACLE, request, Reply)
        done = {"add": "added", "move": "moved", "remove": "removed"}[action.action]
        return ActionResult(ok=True, reason=f"{action.name}: {done}")

    def _clock(self, robot: str, action: requests.ControlClock) -> ActionResult:
        self.send_request(robot, CLOCK_QUERIES[action.do], Request(), Reply)
        return ActionResult(ok=True, reason=CLOCK_RESULTS[action.do])

    def _reset(self, robot: str, action: requests.ResetSimulation) -> ActionResult:
        self.send_request(robot, RESET, ResetRequest(seed=action.seed), Reply)
        seed = "" if action.seed is None else f" with seed {action.seed}"
        return ActionResult(ok=True, reason=f"simulation restarted{seed}")

    def _speed(self, robot: str, action: requests.SetSpeed) -> ActionResult:
        if not 0.1 <= action.factor <= 20:
            raise UserError(f"{action.factor:g} times real time cannot be: between 0.1 and 20")
        self.send_request(robot, SPEED, SpeedRequest(factor=action.factor), Reply)
        return ActionResult(ok=True, reason=f"{action.factor:g} times real time")

    def _drive(self, robot: str, action: requests.DriveByHand) -> ActionResult:
        key = DRIVE.key(robot)
        if robot not in self._numbers:
            self._check_controller(robot, DRIVE)
        else:
            self._check_running(robot, "controller")
        twist = Twist(vx=action.vx, vy=action.vy, wz=action.wz)
        drive = Drive(stamp_ns=self._lookup.stamp_ns(robot), seq=next(self._numbers[robot]), twist=twist)
        self._bus.put(DRIVE, drive.encode(), key=key)
        return ActionResult(ok=True)

    def _record(self, robot: str, action: requests.ControlRecorder) -> ActionResult:
        reply = self.send_request(robot, RECORDING, RecordRequest(action=action.action), RecordReply)
        more = {
            "recording": reply.recording,
            "file": reply.file,
            "messages": reply.messages,
            "seconds": reply.seconds,
        }
        state = f"recorded {reply.file}" if reply.file else "idle"
        if reply.recording:
            state = f"recording into {reply.file}"
        return ActionResult(ok=True, reason=state, more=more)

    def _save_map(self, robot: str, action: requests.SaveMap) -> ActionResult:
        file = self.send_request(robot, SAVE_MAP, SaveMapRequest(name=action.name), SaveMapReply).file
        use = f"presage train --world {file}, then presage up --world {file}"
        return ActionResult(ok=True, reason=f"map saved; to drive in it: {use}")
