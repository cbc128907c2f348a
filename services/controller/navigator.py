"""From beliefs to commands: the goal, the limits, and what to say about it. No bus, no clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from common import safety
from common.messages import Belief, CmdVel, Goal, Scan, Status, Twist
from common.robot import Robot
from services.controller.action import Preference, next_action, observed_position, preferred_position

if TYPE_CHECKING:
    from common.se2 import Array
    from common.world import World

CREEP = 0.02  # m/s, slower than this is standing
BLOCKED_AFTER = 2.0  # s of standing on the way


@dataclass
class Navigator:
    """Preset `paper`'s controller: state in, command and status out."""

    robot: Robot = field(default_factory=Robot)
    preference: Preference = field(default_factory=Preference)
    world: World | None = None  # to refuse a goal inside a wall; None: any goal is tried

    def __post_init__(self) -> None:
        """Idle, standing."""
        self.goal: Goal | None = None
        self.state: Literal["idle", "navigating", "reached", "blocked", "lost"] = "idle"
        self.reason = ""
        self._refused = False  # the goal lies in a wall
        self._waiting = False  # for a belief that knows where it is
        self._action = np.zeros(2)
        self._velocity = np.zeros(3)
        self._standing_since: int | None = None
        self._last_stamp: int | None = None
        self._points = np.zeros((0, 2))

    def hear_scan(self, scan: Scan) -> None:
        """Remember what stands around, (K, 2) m in base_link."""
        self._points = safety.scan_points(scan)

    def hear_goal(self, goal: Goal) -> None:
        """A new preference, or none; a goal inside a wall is refused."""
        self._action, self._standing_since = np.zeros(2), None
        self.goal, self.state, self.reason, self._refused = goal, "navigating", "", False
        if goal.cancel:
            self.goal, self.state, self.reason = None, "idle", "cancelled"
        elif (refusal := self._refusal(goal)) is not None:
            self.state, self.reason, self._refused = "blocked", refusal, True

    def _refusal(self, goal: Goal) -> str | None:
        if self.world is None:
            return None
        clearance = float(self.world.clearance(goal.pose.array()[:2])[0])
        if clearance < self.robot.radius:
            where = f"({goal.pose.x:.2f}, {goal.pose.y:.2f}) in {self.world.name}"
            return (
                f"goal refused: {where} is {'inside something' if clearance < 0 else f'{clearance:.2f} m from a wall'}"
            )
        return None

    def step(self, belief: Belief) -> tuple[CmdVel, Status]:
        """The answer to one belief, with its stamp."""
        period = 0.0 if self._last_stamp is None else max(0.0, (belief.stamp_ns - self._last_stamp) * 1e-9)
        self._last_stamp = belief.stamp_ns
        pose = belief.pose.array()
        distance = None if self.goal is None else float(np.hypot(*(self.goal.pose.array() - pose)[:2]))
        wanted = self._wanted(belief, pose, distance)
        ramped = safety.ramp(self._velocity, safety.clip_twist(wanted, self.robot), self.robot, period)
        self._velocity, held_back = safety.limit_velocity(ramped, self._points, self.robot)
        self._watch_progress(belief.stamp_ns, held_back=held_back)
        vx, vy, wz = map(float, self._velocity)
        return CmdVel(stamp_ns=belief.stamp_ns, twist=Twist(vx=vx, vy=vy, wz=wz)), self.status(
            belief.stamp_ns, distance
        )

    def _wanted(self, belief: Belief, pose: Array, distance: float | None) -> Array:
        """The command free energy asks for, before any limit; (3,) in base_link."""
        stand = np.zeros(3)
        if self.goal is None or distance is None or self.state == "reached" or self._refused:
            self._action = np.zeros(2)
            return stand
        if belief.state in {"lost", "localising", "ambiguous"}:
            self._action = np.zeros(2)
            self._waiting = True
            self.state = "lost" if belief.state == "lost" else "navigating"
            self.reason = f"standing until localised: the belief is {belief.state}"
            return stand
        if distance <= self.goal.tolerance:
            self.state, self.reason = "reached", f"within {self.goal.tolerance:g} m of the goal"
            self._action = np.zeros(2)
            return stand
        if self._waiting:
            self._waiting, self.state, self.reason = False, "navigating", ""
        observed = observed_position(pose, belief.xi.astype(np.float64), belief.curvature)
        preferred = preferred_position(observed, self.goal.pose.array(), self.preference.reach)
        self._action = next_action(self._action, observed, preferred, float(pose[2]), self.preference)
        return np.array([self._action[0], self._action[1], 0.0])

    def _watch_progress(self, stamp_ns: int, *, held_back: bool) -> None:
        """Navigating, held back by what the scan shows, and standing for a while: blocked."""
        if self.state not in {"navigating", "blocked"} or self._refused or self._waiting:
            self._standing_since = None
            return
        if np.hypot(*self._velocity[:2]) > CREEP or not held_back:
            self._standing_since = None
            self.state, self.reason = "navigating", ""
            return
        self._standing_since = stamp_ns if self._standing_since is None else self._standing_since
        if (stamp_ns - self._standing_since) * 1e-9 >= BLOCKED_AFTER:
            self.state, self.reason = "blocked", "the scan shows something in the way"

    def status(self, stamp_ns: int, distance: float | None) -> Status:
        """What is going on."""
        return Status(
            stamp_ns=stamp_ns,
            state=self.state,
            reason=self.reason,
            goal=self.goal.pose if self.goal is not None else None,
            goal_seq=self.goal.seq if self.goal is not None else 0,
            distance=distance,
        )

    def without_belief(self, stamp_ns: int, why: str) -> tuple[CmdVel, Status]:
        """Stand: nothing is known about now. The goal is kept."""
        self._action, self._velocity = np.zeros(2), np.zeros(3)
        if self.state in {"navigating", "blocked"} and not self._refused:
            self.state, self.reason, self._waiting = "lost", why, True
        status = self.status(stamp_ns, None).model_copy(update={"reason": why})  # idle, too, says so
        return CmdVel(stamp_ns=stamp_ns, twist=Twist()), status
