"""The goal, the limits and the status: from a belief to a command."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Scan, Status, Twist
from common.robot.base import Robot
from common.runtime import safety
from services.controller.manual_drive import Hand
from services.controller.policies.decision import Decision, Preset
from services.controller.policies.motion_model import moves, turn_rate
from services.controller.policies.paper_action import Preference
from services.controller.policies.straight_line import Straight

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

BLOCKED_AFTER = 2.0  # s of standing on the way


@dataclass
class Navigator:
    """State in, command and status out; how a goal becomes an action is the preset's."""

    robot: Robot = field(default_factory=Robot)
    preference: Preference = field(default_factory=Preference)  # of preset `paper`
    world: World | None = None  # to refuse a goal inside a wall; None: any goal is tried
    preset: Preset | None = None  # None: `paper`

    def __post_init__(self) -> None:
        """Idle, standing."""
        self.mind: Preset = self.preset or Straight(self.robot, self.preference, self.world)
        self.decision = Decision()  # the last one
        self.goal: Goal | None = None
        self.state: Literal["idle", "navigating", "reached", "blocked", "lost", "exploring"] = "idle"
        self.reason = ""
        self._refused = False  # the goal lies in a wall
        self._waiting = False  # for a belief that knows where it is
        self._velocity = np.zeros(3)
        self._standing_since: int | None = None
        self._last_stamp: int | None = None  # of the last command
        self._scan: Scan | None = None
        self._points = np.zeros((0, 2))
        self._hand = Hand()
        self._interrupted: Array | None = None  # the velocity when time stood still

    def hear_scan(self, scan: Scan) -> None:
        """Remember what stands around, (K, 2) m in base_link."""
        self._points, self._scan = safety.scan_points(scan), scan

    def hear_drive(self, drive: Drive) -> None:
        """Somebody drives by hand: that goes before any goal."""
        scan = self._scan.stamp_ns if self._scan is not None else 0
        self._hand.hear(drive, max(scan, self._last_stamp or 0))

    def hear_goal(self, goal: Goal) -> None:
        """A new preference, or none; a goal inside a wall is refused."""
        self._standing_since = None
        self.goal, self.state, self.reason, self._refused = goal, "navigating", "", False
        if goal.cancel:
            self.goal, self.state, self.reason = None, "idle", "cancelled"
        elif (refusal := self.mind.refusal(goal.pose.array()[:2])) is not None:
            self.state, self.reason, self._refused = "blocked", refusal, True
        self.mind.aim(None if self.goal is None or self._refused else goal.pose.array()[:2])

    @property
    def scan_stamp(self) -> int | None:
        """Of the last scan, ns."""
        return None if self._scan is None else self._scan.stamp_ns

    @property
    def wants_to_go(self) -> bool:
        """Whether there is a goal that it is on the way to."""
        return self.goal is not None and not self._refused and self.state != "reached"

    def step(self, belief: Belief) -> tuple[CmdVel, Status]:
        """The answer to one belief, with its stamp."""
        pose, by_hand = belief.pose.array(), self._hand.twist(belief.stamp_ns)
        self._go_on(belief.stamp_ns)
        self.decision = Decision()
        if self._scan is not None and self._scan.stamp_ns == belief.stamp_ns:
            self.mind.see(self._scan, belief)
        if by_hand is not None:
            self._put_goal_off()
        distance = None if self.goal is None else float(np.hypot(*(self.goal.pose.array() - pose)[:2]))
        wanted = self._wanted(belief, pose, distance) if by_hand is None else by_hand
        command, held_back = self._limited(belief.stamp_ns, wanted)
        if by_hand is not None:
            return command, self._manual(belief.stamp_ns, distance)
        self._watch_progress(belief.stamp_ns, held_back=held_back)
        return command, self.status(belief.stamp_ns, distance)

    def steer(self, stamp_ns: int) -> tuple[CmdVel, Status] | None:
        """The answer to a scan that no belief follows: a hand needs none. None where nobody drives and it stands."""
        by_hand = self._hand.twist(stamp_ns)
        if by_hand is None and not self._velocity.any():
            return None
        self._go_on(stamp_ns)
        if by_hand is not None:
            self._put_goal_off()
            return self._limited(stamp_ns, by_hand)[0], self._manual(stamp_ns, None)
        self._lose_goal("no belief: is the estimator running?")
        return self._limited(stamp_ns, np.zeros(3))[0], self.status(stamp_ns, None)

    def _go_on(self, stamp_ns: int) -> None:
        """As before an interruption, where no time has passed since by the stamps: a simulation that was paused."""
        if self._interrupted is None:
            return
        if self._last_stamp is not None and 0 < stamp_ns - self._last_stamp <= self.robot.command_age * 1e9:
            self._velocity = self._interrupted
            self.mind.go_on()
        self._interrupted = None

    def _limited(self, stamp_ns: int, wanted: Array) -> tuple[CmdVel, bool]:
        """What is wanted (3,) within every limit; whether the scan held it back."""
        period = 0.0 if self._last_stamp is None else max(0.0, (stamp_ns - self._last_stamp) * 1e-9)
        self._last_stamp = stamp_ns
        ramped = safety.ramp(self._velocity, safety.clip_twist(wanted, self.robot), self.robot, period)
        self._velocity, held_back = safety.limit_velocity(ramped, self._points, self.robot)
        vx, vy, wz = map(float, self._velocity)
        return CmdVel(stamp_ns=stamp_ns, twist=Twist(vx=vx, vy=vy, wz=wz)), held_back

    def _put_goal_off(self) -> None:
        """A goal waits while somebody drives; one that was reached is done with."""
        if self.state == "reached":
            self.goal = None
        if not self._refused:
            self.state, self.reason = "idle" if self.goal is None else "navigating", ""
        self.mind.interrupt()
        self._standing_since, self._waiting = None, False

    def _manual(self, stamp_ns: int, distance: float | None) -> Status:
        """By hand: the goal's own state is kept for later."""
        reason = "driven by hand" + ("; the goal waits" if self.goal is not None and not self._refused else "")
        return self.status(stamp_ns, distance).model_copy(update={"state": "manual", "reason": reason})

    def _wanted(self, belief: Belief, pose: Array, distance: float | None) -> Array:
        """The command free energy asks for, before any limit; (3,) in base_link."""
        if self.goal is None or distance is None or self._refused or self.state == "reached":
            return np.zeros(3)
        if belief.state in {"lost", "localising", "ambiguous"}:
            self.decision, self._waiting = self.mind.seek(belief, self._velocity), True
            self.state, self.reason = self.decision.state, self.decision.reason
            return self.decision.action
        if self._waiting:
            self._waiting, self.state, self.reason = False, "navigating", ""
        if distance <= self.goal.tolerance:
            self.mind.interrupt()
            turn = self._turn(pose)
            if turn is None:
                self.state, self.reason = "reached", f"within {self.goal.tolerance:g} m of the goal"
                return np.zeros(3)
            self.decision = Decision(turn, "there: turning into the goal's heading")
            return turn
        self.decision = self.mind.decide(belief, self._velocity)
        if self.decision.refused:
            self.state, self.reason, self._refused = "blocked", self.decision.reason, True
        return self.decision.action

    def _turn(self, pose: Array) -> Array | None:
        """At the goal: into the heading asked for, (3,) in base_link; None where it has it, or none is asked for."""
        if self.goal is None or self.goal.yaw_tolerance is None:
            return None
        away = float(se2.wrap(self.goal.pose.yaw - pose[2]))
        if abs(away) <= self.goal.yaw_tolerance:
            return None
        return np.array([0.0, 0.0, turn_rate(away, self.robot)])

    def _watch_progress(self, stamp_ns: int, *, held_back: bool) -> None:
        """Standing for a while on the way, for what the scan shows or for what the preset says: blocked."""
        if self.state not in {"navigating", "blocked"} or self._refused or self._waiting:
            self._standing_since = None
            return
        self.reason = self.decision.reason or ("slowed by the scan" if held_back else "")
        if self.decision.recovering:
            self.state = "blocked"
            return
        waits = held_back or self.decision.state == "blocked"
        if moves(self._velocity) or not waits:
            self._standing_since = None
            self.state = "navigating"
            return
        self._standing_since = stamp_ns if self._standing_since is None else self._standing_since
        if (stamp_ns - self._standing_since) * 1e-9 >= BLOCKED_AFTER:
            self.state, self.reason = "blocked", self.decision.reason or "the scan shows something in the way"

    def status(self, stamp_ns: int, distance: float | None) -> Status:
        """What is going on."""
        return Status(
            stamp_ns=stamp_ns,
            state=self.state,
            reason=self.reason,
            refused=self._refused,
            goal=self.goal.pose if self.goal is not None else None,
            goal_seq=self.goal.seq if self.goal is not None else 0,
            distance=distance,
        )

    def without_belief(self, stamp_ns: int, why: str) -> tuple[CmdVel, Status]:
        """Stand: nothing is known about now. The goal is kept."""
        if self._scan is not None and self._scan.stamp_ns == self._last_stamp:
            self._interrupted = self._velocity  # no scan waits for its belief: it is time that stands
        self.mind.interrupt()
        self._velocity = np.zeros(3)
        self._lose_goal(why)
        status = self.status(stamp_ns, None)
        if not self._refused:  # why a goal was refused is still to be read
            status = status.model_copy(update={"reason": why})  # idle, too, says so
        return CmdVel(stamp_ns=stamp_ns, twist=Twist()), status

    def _lose_goal(self, why: str) -> None:
        """The way to it waits for a belief."""
        if self.state in {"navigating", "blocked", "exploring"} and not self._refused:
            self.state, self.reason, self._waiting = "lost", why, True
