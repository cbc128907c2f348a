"""Default policy: drives to a goal around walls and obstacles.

Pure: beliefs, scans and stamps in, actions and reasons out. The limits that have the last word are the navigator's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.scan_geometry import ALL_ROUND, Sweep
from common.runtime import safety
from services.controller.policies.active_localisation import Seeker
from services.controller.policies.decision import Decision
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import SOFT, Field, Roads
from services.controller.policies.motion_model import facing, moves
from services.controller.policies.obstacles import TemporaryObstacles
from services.controller.policies.policy import Around, choose, least_distance

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from common.messages.definitions import Belief, Scan
    from common.messages.requests import PredictReply
    from common.robot.base import Robot
    from services.controller.policies.epistemic import Options

KEEP = 0.06  # m between footprint and what the map does not know: the scanner's noise, and half a cell
REPLAN = 400_000_000  # ns between two plans for another picture of what stands in the way
REPLAN_AFAR = 1_500_000_000  # ns where it changed elsewhere
STUCK = 3_000_000_000  # ns without progress until it backs off
BACK_OFF = 3_000_000_000  # ns of it
BLIND = "the scanner does not look ahead, and this base goes nowhere else: mount it so that it does"
RANGE = 3.0  # m about the robot within which what the map does not know matters to its next second


class Pilot:
    """Navigation in a known world; heading turned into the way unless told to keep it."""

    def __init__(self, robot: Robot, world: World, *, keep_heading: bool = False, epistemic: bool = True) -> None:
        """Without a goal; ``epistemic``: while it does not know where it is, it moves so as to find out."""
        self.epistemic = epistemic
        self.robot, self.world, self.keep_heading = robot, world, keep_heading
        self.free = FreeSpace.of(world)
        self.roads = Roads(self.free, robot.radius)
        self.obstacles = TemporaryObstacles(self.free)
        self.seeker = Seeker(robot, self.roads, robot.radius + KEEP, turns=not keep_heading)
        self.field: Field | None = None  # of the goal, with what is known to stand in the way
        self.closed = False  # the field is the map's alone, for what stands about leaves no way
        self.changed = False  # the field is another one; for whoever publishes it, who sets it False
        self._goal: Array | None = None
        self._component: int | None = None  # of the roads, where the robot was last known to be
        self._scan: Scan | None = None
        # When roads were last blocked, ns, and the cells that were; whether the field does not know of it yet.
        self._planned: tuple[int, npt.NDArray[Any]] = (-REPLAN, np.zeros(0, int))
        self._outdated = False
        self._vetted_from: int | None = None  # the component from which the goal was found reachable
        self._view = ALL_ROUND
        self._stuck_since: int | None = None
        self._backing_until: int | None = None

    def refusal(self, goal: Array) -> str | None:
        """A goal (2,) inside something, or out of reach of where the robot was last; with the nearest that is not."""
        here = self._component
        cell = self.roads.nearest_free(goal, self.robot.radius, by_map=True)
        clearance = float(self.world.clearance(goal)[0])
        if clearance >= self.robot.radius and cell is not None and here in (None, self.roads.component[cell]):
            return None
        if clearance < 0:
            why = "is inside something, or off the map"
        elif clearance < self.robot.radius or cell is None:
            why = f"is {clearance:.2f} m from a wall"
        else:
            why = "cannot be reached from here"
        nearest = self.roads.nearest_free(goal, component=here, by_map=True)
        instead = ""
        if nearest is not None:
            x, y = self.free.grid.centres([nearest])[0]
            instead = f"; the nearest place that can be reached is ({x:.2f}, {y:.2f})"
        return f"goal refused: ({goal[0]:.2f}, {goal[1]:.2f}) in {self.world.name} {why}{instead}"

    def aim(self, goal: Array | None) -> None:
        """Prefer a place (2,) m in map; None: none."""
        self._goal, self.field, self._vetted_from = goal, None, None
        self.seeker.forget()
        self.interrupt()

    def interrupt(self) -> None:
        """Nobody is stuck who does not drive."""
        self._stuck_since = self._backing_until = None

    def go_on(self) -> None:
        """Nothing was given up."""

    def see(self, scan: Scan, belief: Belief) -> None:
        """What the map does not know, and how far the scanner looks."""
        self._view = Sweep.of(scan).sector(scan.mount.yaw)
        self._scan = scan
        if belief.state != "tracking":
            return  # what was seen before stands where it stood
        self.seeker.forget()
        pose = belief.pose.array()
        self.obstacles.see(scan, pose)
        if (cell := self.roads.nearest_free(pose[:2], self.roads.least, by_map=True)) is not None:
            self._component = int(self.roads.component[cell])

    def decide(self, belief: Belief, velocity: Array) -> Decision:
        """The action of least expected free energy, going with ``velocity`` (3,) in base_link."""
        pose, stamp_ns = belief.pose.array(), belief.stamp_ns
        if self._goal is not None and self._component != self._vetted_from:
            if (refusal := self.refusal(self._goal)) is not None:
                return Decision(reason=refusal, state="blocked", refused=True)
            self._vetted_from = self._component
        points, moving = self.obstacles.points(), self.obstacles.moving(stamp_ns)
        self._plan(pose[:2], points[~moving], stamp_ns)  # whoever walks will have gone on
        way = self.field.path(pose[:2]) if self.field is not None else np.zeros((0, 2))
        if not len(way):
            return Decision(reason="no way to the goal from here", state="blocked")
        around = self._around(pose, points, moving)
        if self._backing_until is not None and stamp_ns < self._backing_until:
            return self._back_off(pose, velocity, around, way)
        assert self.field is not None  # noqa: S101 - there is a way
        point = self.field.attractor(pose[:2], way)
        attractor = se2.rotate(-pose[2], point - pose[:2])
        choice = choose(velocity, attractor, around, self.robot)
        action = facing(choice.action, attractor, self.robot, turns=around.turns, front=around.front)
        # What was driven, not what is wished: the limits may have held it.
        self._watch(stamp_ns, driven=moves(velocity))
        reason = ""
        if choice.held:
            reason = self._what_holds(pose, around, stood=not choice.action.any())
        if self.closed:
            reason = self._no_way(pose, around)
        if self.robot.drive == "differential" and not bool(around.sees(0.0)):
            reason = BLIND
        stands = bool(reason) and not choice.action.any()
        return Decision(
            action, reason, "blocked" if stands else "navigating", way, se2.transform(pose, choice.way[:, :2])
        )

    def question(self, belief: Belief) -> Options | None:
        """Where scans must be predicted before `seek` can choose where to go; None: nowhere, now."""
        if self._goal is None or not self.epistemic:
            return None
        return self.seeker.question(belief)

    def answer(self, reply: PredictReply) -> None:
        """What is expected there."""
        if self._scan is not None:
            self.seeker.answer(reply, self._scan.range_max)

    def seek(self, belief: Belief, velocity: Array) -> Decision:
        """Find out where it is; without the epistemic term the goal leads, as if the best hypothesis were true."""
        if self._scan is None:
            return Decision(reason=f"standing until localised: the belief is {belief.state}")
        if self.epistemic or belief.state != "ambiguous":
            points = safety.scan_points(self._scan)
            points = points[np.hypot(*points.T) < RANGE]
            return self.seeker.act(belief, self._scan, points, velocity, self._view)
        decision = self.decide(belief, velocity)
        decision.reason = decision.reason or f"the belief is {belief.state}: going by its best guess"
        return decision

    def _plan(self, here: Array, points: Array, stamp_ns: int) -> None:
        """The field anew where the goal, or the ``points`` (K, 2) m of what stands about, changed."""
        if self._goal is None:
            self.field = None
            return
        cells = np.unique(self.free.grid.cell_of(points)) if len(points) else np.zeros(0, int)
        when, before = self._planned
        others = np.setxor1d(cells, before, assume_unique=True)
        age = stamp_ns - when
        due = age < 0 or age >= REPLAN_AFAR or (age >= REPLAN and self._on_the_way(here, others))
        if self.field is None or (len(others) and due):
            self.roads.block(points)
            self._planned, self._outdated = (stamp_ns, cells), True
            if self.field is not None and not self.closed:
                return  # the field itself with the next scan: each takes milliseconds
        if self.field is not None and not self._outdated:
            return
        self._outdated = False
        near = self.robot.radius + 2 * self.free.grid.resolution
        self.field, self.changed, self.closed = self.roads.from_(self._goal, near), True, False
        if self.field is None or not self.field.reaches(here):
            # By the map alone: up to what closes the way, and there until it opens.
            self.roads.block(np.zeros((0, 2)))
            self.field, self.closed = self.roads.from_(self._goal, near), bool(len(points))

    def _on_the_way(self, here: Array, cells: npt.NDArray[Any]) -> bool:
        """Whether any of these cells, which came or went, lies near the way from ``here``."""
        if self.field is None or not len(cells) or self.closed:
            return True
        way = self.field.path(here)
        return bool(len(way)) and bool(
            least_distance(self.free.grid.centres(cells), way).min() < self.roads.least + SOFT
        )

    def _around(self, pose: Array, points: Array, moving: npt.NDArray[np.bool_]) -> Around:
        near = np.hypot(*(points - pose[:2]).T) < RANGE
        radius = self.robot.radius

        def known(places: Array) -> Array:
            return self.free.clear(se2.transform(pose, places))

        return Around(
            known, se2.rotate(-pose[2], points[near] - pose[:2]), moving[near], self.roads.least, radius + KEEP,
            view=self._view, turns=not self.keep_heading,
        )  # fmt: skip

    def _watch(self, stamp_ns: int, *, driven: bool) -> None:
        if driven:
            self._stuck_since = None
        elif self._stuck_since is None or stamp_ns < self._stuck_since:
            self._stuck_since = stamp_ns
        elif stamp_ns - self._stuck_since > STUCK:
            self._stuck_since, self._backing_until = None, stamp_ns + BACK_OFF

    def _back_off(self, pose: Array, velocity: Array, around: Around, way: Array) -> Decision:
        """Recovery: towards where there is more room, by the map and by what is seen."""
        angle = np.arange(16) * np.pi / 8
        places = 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        best = int(np.argmax(around.gaps(places[:, None, :], np.zeros(1))[:, 0]))
        choice = choose(velocity, places[best], around, self.robot)
        action = facing(choice.action, places[best], self.robot, turns=around.turns, front=around.front)
        return Decision(
            action, "stuck: backing off", path=way, motion=se2.transform(pose, choice.way[:, :2]), recovering=True
        )

    def _what_holds(self, pose: Array, around: Around, *, stood: bool) -> str:
        does = "waiting" if stood else "slowing"
        if not len(around.points):
            return f"{does}: a wall is near"
        nearest, where = _nearest(pose, around)
        # What has been seen for less than a second may be a person as well as a box that was just moved.
        what = "something that may move" if around.moving[nearest] else "something that is not in the map"
        return f"{does}: {what}, {np.hypot(*around.points[nearest]):.1f} m away at {where}"

    def _no_way(self, pose: Array, around: Around) -> str:
        at = f" at {_nearest(pose, around)[1]}" if len(around.points) else ""
        return f"no way around something that is not in the map{at}: waiting until it clears"


def _nearest(pose: Array, around: Around) -> tuple[int, str]:
    """Index of the nearest of ``around.points``, of which there are some, and where it is in map."""
    nearest = int(np.argmin(np.hypot(*around.points.T)))
    x, y = se2.transform(pose, around.points[nearest])
    return nearest, f"({x:.1f}, {y:.1f})"
