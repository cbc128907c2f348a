"""Chooses velocities that help to localise the robot.

While several places are possible, destinations are rated by how well a scan taken there is expected to tell the places
apart (`epistemic`). While no place is known at all, the robot drives where there is most room, because scans from there
show the largest part of the surroundings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.ranges import is_surface
from common.robot.scan_geometry import Sweep
from services.controller.policies.action_selection import Surroundings, select_action
from services.controller.policies.decision import Decision
from services.controller.policies.epistemic import CandidateMotions, DestinationSelector
from services.controller.policies.motion_model import turn_to_attractor

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Belief, Scan
    from common.messages.requests import PredictReply
    from common.robot.base import Robot
    from common.robot.scan_geometry import Sector
    from services.controller.policies.geodesic_field import CostField, FreeSpaceGraph

MIN_WEIGHT = 0.02  # hypotheses with less weight are ignored
MAX_HYPOTHESES = 6
DESTINATION_SPACING_M = 1.0
MIN_PATH_M, MAX_PATH_M = 0.8, 12.0  # length of the path to a destination
MAX_DESTINATIONS = 60
CHOICE_PERIOD_NS = 1_000_000_000  # minimum time between two choices of a destination
MAX_SPEED = 0.5  # m/s, because it is not known what is behind and beside the robot
INITIAL_WAIT_NS = 1_000_000_000  # time for the estimator to localise before the robot moves
MAX_USEFUL_ROOM_M = 5.0  # more room than this is no advantage
WINDOW_RAD = 0.35  # to either side of a direction; its room is the shortest range in this window
MIN_ROOM_M = 0.7  # if every direction has less, the robot turns on the spot


class ActiveLocaliser:
    """Chooses velocities while the pose is ambiguous or unknown."""

    def __init__(
        self, robot: Robot, graph: FreeSpaceGraph, min_point_distance: float, *, may_turn: bool = True
    ) -> None:
        """Keep ``min_point_distance`` m from the robot's centre to scan points; ``may_turn``: the heading is free."""
        self.may_turn = may_turn
        self.robot = robot.model_copy(update={"max_speed": min(robot.max_speed, MAX_SPEED)})
        self.graph, self.min_point_distance = graph, min_point_distance
        self.selector = DestinationSelector()
        self._requested: tuple[int, CandidateMotions] | None = None  # stamp in ns and motions of the last request
        self._field: tuple[Array, CostField | None] | None = None  # a destination (2,) m and its field
        self._unknown_since_ns: int | None = None  # stamp since which there are no likely hypotheses

    def reset(self) -> None:
        """Forget everything. Call it when the pose is known, or the goal has changed."""
        self.selector.reset()
        self._requested, self._field, self._unknown_since_ns = None, None, None

    def prediction_request(self, belief: Belief) -> CandidateMotions | None:
        """Candidate motions; scans must be predicted for their end poses and passed to `use_predictions`.

        Returns None if no predictions are needed now.
        """
        hypotheses = [h for h in belief.hypotheses if h.weight >= MIN_WEIGHT][:MAX_HYPOTHESES]
        if belief.state != "ambiguous" or len(hypotheses) < 2:
            return None
        stamp = belief.stamp_ns
        if self._requested is not None and 0 <= stamp - self._requested[0] < CHOICE_PERIOD_NS:
            return None
        poses, weights = np.array([h.pose.array() for h in hypotheses]), np.array([h.weight for h in hypotheses])
        displacements, lengths = self._destinations(poses[0])
        if (kept := self.selector.displacement(poses[0])) is not None:
            displacements = np.concatenate([kept[None], displacements])
            lengths = np.concatenate([[np.hypot(*kept[:2])], lengths])
        if not len(lengths):
            return None
        self._requested = (stamp, CandidateMotions(poses, weights, displacements, lengths))
        return self._requested[1]

    def use_predictions(self, reply: PredictReply, range_max: float) -> None:
        """Choose a destination with the predictions for the last request. Does nothing if the request was refused."""
        if self._requested is None or not reply.ok:
            return
        stamp, motions = self._requested
        shape = (len(motions.hypotheses), len(motions.displacements), -1)
        ranges = reply.ranges.astype(np.float64).reshape(shape)
        sigma = reply.sigma.astype(np.float64).reshape(shape) if len(reply.sigma) else np.full_like(ranges, 0.05)
        self.selector.choose(stamp, motions, ranges, sigma, range_max)

    def decide(self, belief: Belief, scan: Scan, points: Array, velocity: Array, view: Sector) -> Decision:
        """Choose a velocity; ``points`` (K, 2) m in base_link are obstacles, ``view`` is what the scanner sees."""
        static = np.zeros(len(points), bool)
        surroundings = Surroundings(
            _no_walls, points, static, 0.0, self.min_point_distance, view=view, may_turn=self.may_turn
        )
        likely = [h for h in belief.hypotheses if h.weight >= MIN_WEIGHT][:MAX_HYPOTHESES]
        if belief.state == "ambiguous" and likely:
            self._unknown_since_ns = None
            poses, weights = np.array([h.pose.array() for h in likely]), np.array([h.weight for h in likely])
            destination = self.selector.follow(belief.stamp_ns, poses, weights)
            if destination is not None:
                return self._drive_to(poses[0], destination, surroundings, velocity, len(likely))
            return Decision(reason=f"{len(likely)} places are possible: looking for where to tell them apart")
        if self._unknown_since_ns is None or belief.stamp_ns < self._unknown_since_ns:
            self._unknown_since_ns = belief.stamp_ns
        if belief.stamp_ns - self._unknown_since_ns < INITIAL_WAIT_NS:
            return Decision(reason=f"the belief is {belief.state}: looking", state="lost")
        return self._wander(belief, scan, surroundings, velocity)

    def _destinations(self, pose: Array) -> tuple[Array, Array]:
        """Displacements (M, 3) in base_link and path lengths (M,) m of the destinations around a hypothesis (3,)."""
        field = self.graph.cost_field(pose[:2], self.min_point_distance + DESTINATION_SPACING_M)
        if field is None:
            return np.zeros((0, 3)), np.zeros(0)
        step = max(1, round(DESTINATION_SPACING_M / self.graph.grid.resolution))
        rows, columns = np.meshgrid(*(np.arange(step // 2, n, step) for n in field.cost.shape), indexing="ij")
        cells = (rows * field.cost.shape[1] + columns).ravel()
        cost = field.cost.ravel()[cells]
        cells, cost = (each[(cost > MIN_PATH_M) & (cost < MAX_PATH_M)] for each in (cells, cost))
        # Thin out to MAX_DESTINATIONS, evenly over the costs.
        selected = np.argsort(cost, kind="stable")[:: max(1, -(-len(cost) // MAX_DESTINATIONS))]
        cells, cost = cells[selected], cost[selected]
        # Paths of the field lead to the hypothesis, so a cell's next cell is the previous one on the way there.
        places, previous = self.graph.grid.centres(cells), self.graph.grid.centres(field.next_cell[cells])
        heading = np.arctan2(*(places - previous).T[::-1])  # on arrival
        return se2.between(pose, np.column_stack([places, heading])), cost

    def _drive_to(
        self, pose: Array, destination: Array, surroundings: Surroundings, velocity: Array, count: int
    ) -> Decision:
        """Drive from the first of ``count`` hypotheses towards a destination (3,)."""
        target = destination[:2]
        if self._field is None or np.hypot(*(self._field[0] - target)) > self.graph.grid.resolution:
            field = self.graph.cost_field(target, self.min_point_distance + DESTINATION_SPACING_M)
            self._field = (np.array(target), field)
        field = self._field[1]
        path = field.path(pose[:2]) if field is not None else np.zeros((0, 2))
        reason = f"{count} places are possible: going to ({target[0]:.1f}, {target[1]:.1f}) to tell them apart"
        if field is None or not len(path):
            self.selector.reset()
            return Decision(reason="no way to where places could be told apart", state="blocked")
        point = field.attractor(pose[:2], path)
        attractor = se2.rotate(-pose[2], point - pose[:2])
        return self._approach(attractor, surroundings, velocity, reason, path)

    def _wander(self, belief: Belief, scan: Scan, surroundings: Surroundings, velocity: Array) -> Decision:
        """Drive in the direction with the most room, preferring directions ahead."""
        ranges = np.where(np.isneginf(scan.ranges), 0.0, scan.ranges.astype(np.float64))
        ranges = np.minimum(ranges, MAX_USEFUL_ROOM_M)
        # Beams that were not measured, or were cut out, must not limit the room: their neighbours decide.
        ranges[~is_surface(scan.ranges) & ~np.isinf(scan.ranges)] = np.inf
        angles = scan.angles() + scan.mount.yaw
        sweep = Sweep.of(scan)
        half = max(1, round(WINDOW_RAD / max(sweep.spacing, WINDOW_RAD / 1000)))  # beams
        # Padding with 0: outside the field of view there is no room.
        padded = np.pad(ranges, half, mode="wrap") if sweep.all_round else np.pad(ranges, half)
        room = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).min(axis=1)
        room[np.isinf(room)] = 0.0  # no beam in the window measured anything
        best = int(np.argmax(room + 0.5 * np.cos(angles - surroundings.forward)))
        reason = f"the belief is {belief.state}: going where there is room, to see more"
        if room[best] < MIN_ROOM_M:
            return Decision(np.array([0.0, 0.0, 0.5]), reason.replace("going", "turning to"), "exploring")
        distance = min(float(room[best]) - self.min_point_distance, 2.0)
        attractor = distance * np.array([np.cos(angles[best]), np.sin(angles[best])])
        return self._approach(attractor, surroundings, velocity, reason, np.zeros((0, 2)))

    def _approach(
        self, attractor: Array, surroundings: Surroundings, velocity: Array, reason: str, path: Array
    ) -> Decision:
        selected = select_action(velocity, attractor, surroundings, self.robot)
        action = turn_to_attractor(
            selected.action, attractor, self.robot, may_turn=self.may_turn, forward=surroundings.forward
        )
        if not action.any() and self.may_turn:  # no free motion: turn to look elsewhere
            action[2] = 0.5 if attractor[1] >= 0 else -0.5
        return Decision(action, reason, "exploring", path)


def _no_walls(positions: Array) -> Array:
    """Wall distances (...,) of positions (..., 2) without a map: infinite."""
    return np.full(positions.shape[:-1], np.inf)
