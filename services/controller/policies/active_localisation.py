"""Moves to find out where the robot is.

While several places are possible, destinations are scored by what a scan there is expected to tell between them
(`epistemic`). While none is known at all, the robot goes where there is most room: what it has not seen yet tells most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.ranges import surfaces
from common.robot.scan_geometry import Sweep
from services.controller.policies.decision import Decision
from services.controller.policies.epistemic import Explorer, Options
from services.controller.policies.motion_model import facing
from services.controller.policies.policy import Around, choose

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan
    from common.messages.requests import PredictReply
    from common.robot.base import Robot
    from common.robot.scan_geometry import Sector
    from services.controller.policies.geodesic_field import Field, Roads

LIKELY = 0.02  # weight of the hypotheses that count
MOST = 6  # hypotheses
SPACING = 1.0  # m between destinations
NEAREST, FARTHEST = 0.8, 12.0  # m to drive to one
DESTINATIONS = 60
AGAIN = 1_000_000_000  # ns between two choices
SPEED = 0.5  # m/s at most, for what is behind and beside is not known
FIRST_LOOK = 1_000_000_000  # ns that the estimator is given before anybody moves
ROOM_ENOUGH = 5.0  # m; more room than this is no better
WINDOW = 0.35  # rad to either side of a direction that must be free
ROOM = 0.7  # m; with less in every direction it turns on the spot


class Seeker:
    """Where to go to know where one is."""

    def __init__(self, robot: Robot, roads: Roads, keep: float, *, turns: bool = True) -> None:
        """``keep`` m from the robot's centre to whatever the scan shows; ``turns``: not bound to its heading."""
        self.turns = turns
        self.robot = robot.model_copy(update={"max_speed": min(robot.max_speed, SPEED)})
        self.roads, self.keep = roads, keep
        self.explorer = Explorer()
        self._asked: tuple[int, Options] | None = None  # ns, and what predictions are awaited for
        self._field: tuple[Array, Field | None] | None = None  # of a destination (2,) m
        self._since: int | None = None  # ns, nothing is known since

    def forget(self) -> None:
        """It is known, or nobody asks any more."""
        self.explorer.forget()
        self._asked, self._field, self._since = None, None, None

    def question(self, belief: Belief) -> Options | None:
        """The destinations whose predicted scans are needed now; None: none."""
        hypotheses = [h for h in belief.hypotheses if h.weight >= LIKELY][:MOST]
        if belief.state != "ambiguous" or len(hypotheses) < 2:
            return None
        stamp = belief.stamp_ns
        if self._asked is not None and 0 <= stamp - self._asked[0] < AGAIN:
            return None
        poses, weights = np.array([h.pose.array() for h in hypotheses]), np.array([h.weight for h in hypotheses])
        displacements, lengths = self._destinations(poses[0])
        if (kept := self.explorer.displacement(poses[0])) is not None:
            displacements = np.concatenate([kept[None], displacements])
            lengths = np.concatenate([[np.hypot(*kept[:2])], lengths])
        if not len(lengths):
            return None
        self._asked = (stamp, Options(poses, weights, displacements, lengths))
        return self._asked[1]

    def answer(self, reply: PredictReply, range_max: float) -> None:
        """The predictions of the last question; a refusal leaves things as they were."""
        if self._asked is None or not reply.ok:
            return
        stamp, options = self._asked
        shape = (len(options.hypotheses), len(options.displacements), -1)
        ranges = reply.ranges.astype(np.float64).reshape(shape)
        sigma = reply.sigma.astype(np.float64).reshape(shape) if len(reply.sigma) else np.full_like(ranges, 0.05)
        self.explorer.choose(stamp, options, ranges, sigma, range_max)

    def act(self, belief: Belief, scan: Scan, points: Array, velocity: Array, view: Sector) -> Decision:
        """The action now; ``points`` (K, 2) m in base_link stand about, it sees ``view``."""
        around = Around(_unknown, points, np.zeros(len(points), bool), 0.0, self.keep, view=view, turns=self.turns)
        likely = [h for h in belief.hypotheses if h.weight >= LIKELY][:MOST]
        if belief.state == "ambiguous" and likely:
            self._since = None
            poses, weights = np.array([h.pose.array() for h in likely]), np.array([h.weight for h in likely])
            target = self.explorer.follow(belief.stamp_ns, poses, weights)
            if target is not None:
                return self._go(poses[0], target, around, velocity, len(likely))
            return Decision(reason=f"{len(likely)} places are possible: looking for where to tell them apart")
        if self._since is None or belief.stamp_ns < self._since:
            self._since = belief.stamp_ns
        if belief.stamp_ns - self._since < FIRST_LOOK:
            return Decision(reason=f"the belief is {belief.state}: looking", state="lost")
        return self._wander(belief, scan, around, velocity)

    def _destinations(self, pose: Array) -> tuple[Array, Array]:
        """(M, 3) displacements in base_link and (M,) m to drive, for one hypothesis (3,)."""
        field = self.roads.from_(pose[:2], self.keep + SPACING)
        if field is None:
            return np.zeros((0, 3)), np.zeros(0)
        step = max(1, round(SPACING / self.roads.grid.resolution))
        rows, columns = np.meshgrid(*(np.arange(step // 2, n, step) for n in field.cost.shape), indexing="ij")
        cells = (rows * field.cost.shape[1] + columns).ravel()
        cost = field.cost.ravel()[cells]
        cells, cost = (each[(cost > NEAREST) & (cost < FARTHEST)] for each in (cells, cost))
        nearest = np.argsort(cost, kind="stable")[:: max(1, -(-len(cost) // DESTINATIONS))]
        cells, cost = cells[nearest], cost[nearest]
        there, before = self.roads.grid.centres(cells), self.roads.grid.centres(field.before[cells])
        heading = np.arctan2(*(there - before).T[::-1])  # as it will arrive
        return se2.between(pose, np.column_stack([there, heading])), cost

    def _go(self, pose: Array, target: Array, around: Around, velocity: Array, places: int) -> Decision:
        if self._field is None or np.hypot(*(self._field[0] - target[:2])) > self.roads.grid.resolution:
            self._field = (np.array(target[:2]), self.roads.from_(target[:2], self.keep + SPACING))
        field = self._field[1]
        way = field.path(pose[:2]) if field is not None else np.zeros((0, 2))
        reason = f"{places} places are possible: going to ({target[0]:.1f}, {target[1]:.1f}) to tell them apart"
        if field is None or not len(way):
            self.explorer.forget()
            return Decision(reason="no way to where places could be told apart", state="blocked")
        point = field.attractor(pose[:2], way)
        attractor = se2.rotate(-pose[2], point - pose[:2])
        return self._towards(attractor, around, velocity, reason, way)

    def _wander(self, belief: Belief, scan: Scan, around: Around, velocity: Array) -> Decision:
        """Towards the most room, rather ahead than aside."""
        ranges = np.where(np.isneginf(scan.ranges), 0.0, scan.ranges.astype(np.float64))
        ranges = np.minimum(ranges, ROOM_ENOUGH)
        # Not measured, or cut out: their neighbours speak for them.
        ranges[~surfaces(scan.ranges) & ~np.isinf(scan.ranges)] = np.inf
        angles = scan.angles() + scan.mount.yaw
        sweep = Sweep.of(scan)
        half = max(1, round(WINDOW / max(sweep.spacing, WINDOW / 1000)))
        # Beyond the outermost beams nothing is known to be free; all round there is no outermost.
        padded = np.pad(ranges, half, mode="wrap") if sweep.all_round else np.pad(ranges, half)
        free = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).min(axis=1)
        free[np.isinf(free)] = 0.0  # where none has measured anything
        best = int(np.argmax(free + 0.5 * np.cos(angles - around.front)))
        reason = f"the belief is {belief.state}: going where there is room, to see more"
        if free[best] < ROOM:
            return Decision(np.array([0.0, 0.0, 0.5]), reason.replace("going", "turning to"), "exploring")
        away = min(float(free[best]) - self.keep, 2.0)
        attractor = away * np.array([np.cos(angles[best]), np.sin(angles[best])])
        return self._towards(attractor, around, velocity, reason, np.zeros((0, 2)))

    def _towards(self, attractor: Array, around: Around, velocity: Array, reason: str, way: Array) -> Decision:
        choice = choose(velocity, attractor, around, self.robot)
        action = facing(choice.action, attractor, self.robot, turns=self.turns, front=around.front)
        if not action.any() and self.turns:  # nothing ahead is free: look elsewhere
            action[2] = 0.5 if attractor[1] >= 0 else -0.5
        return Decision(action, reason, "exploring", way)


def _unknown(places: Array) -> Array:
    """No map: (..., 2) m to (...,)."""
    return np.full(places.shape[:-1], np.inf)
