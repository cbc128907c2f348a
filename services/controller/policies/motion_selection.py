"""Selects the candidate motion of least expected free energy; `motion_model` defines candidate motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.scan_geometry import ALL_ROUND, Sector
from services.controller.policies import expected_free_energy as efe
from services.controller.policies import motion_model
from services.controller.policies.expected_free_energy import NATS_PER_METRE, ExpectedFreeEnergy
from services.controller.policies.geodesic_field import MAX_WALL_COST, WALL_COST_RANGE_M

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.robot import Robot
    from services.controller.policies.scan_information import ScanInformation

HEADING_FADE_M = 0.3  # closer to the lookahead point, the cost of turning towards it fades out
BLIND_SPEED = 0.25  # m/s into directions that the scanner does not see, for a base that may not turn; others turn first
# The field of view must extend this far to either side of the direction of motion, because the body is wide: on a curve
# whose radius is twice the body's, its inner side passes places that were 60 degrees beside the direction of motion.
# In a field of view too narrow for that, motion is allowed in its middle third.
FIELD_OF_VIEW_MARGIN_RAD, FIELD_OF_VIEW_DIVISOR = np.pi / 3, 3
# Cost in m of a change of velocity by 1 m/s, so that the choice does not alternate between motions of equal merit.
CHANGE_COST_S = 0.02
WALKING_SPEED = 1.0  # m/s at which moving obstacles are assumed to approach
HINDERED_M = 0.05  # a status text is shown if walls and obstacles make the way longer by this much
GAP_TOLERANCE_M = 1e-3  # for rounding errors


@dataclass(frozen=True)
class Surroundings:
    """Walls and obstacles that a motion must keep away from, in the present base_link."""

    wall_distance: Callable[[Array], Array]  # (..., 2) m -> (...,) m to the nearest mapped wall; inf without a map
    points: Array  # (K, 2) m, obstacles that are not in the map
    moving: npt.NDArray[np.bool_]  # (K,) points that may approach
    min_wall_distance: float  # m from the robot's centre
    min_point_distance: float  # m from the robot's centre

    field_of_view: Sector = ALL_ROUND  # directions that the scanner sees
    may_turn: bool = True  # if the base may turn, it never has to move in a direction that the scanner does not see

    def sees(self, bearings: Array | float) -> npt.NDArray[np.bool_]:
        """Whether the scanner sees all that the body can meet on the way into ``bearings`` (...,) rad; (...,) bool."""
        if self.field_of_view.half >= np.pi:
            return np.ones(np.shape(bearings), bool)
        return self.turn_until_seen(bearings) <= 1e-9

    def turn_until_seen(self, bearings: Array | float) -> Array:
        """Angle (...,) rad by which the base must turn before it `sees` the way into ``bearings`` (...,) rad."""
        off_centre = np.abs(se2.wrap(bearings - self.field_of_view.centre))
        max_off_centre = max(
            self.field_of_view.half - FIELD_OF_VIEW_MARGIN_RAD, self.field_of_view.half / FIELD_OF_VIEW_DIVISOR
        )
        return np.asarray(np.maximum(off_centre - max_off_centre, 0.0))

    @property
    def forward(self) -> float:
        """Bearing in rad to turn towards a target: 0 if the scanner sees ahead, else its field of view's middle."""
        return 0.0 if bool(self.sees(0.0)) else self.field_of_view.centre

    def gaps(
        self, poses: Array, times: Array, standing_after: Array | float = np.inf, max_gap: float = np.inf
    ) -> Array:
        """Gap (N, T) m between footprint and nearest obstacle at poses (N, T, 3), reached at ``times`` (T,) s.

        Moving obstacles are assumed to approach at walking speed, until the robot stands after ``standing_after`` (N,)
        s: people do not walk into a standing robot (passive safety). Gaps are clipped at ``max_gap`` m, which saves
        most of the work.
        """
        shape = poses.shape[:-1]
        times = np.broadcast_to(times, shape)
        until = np.broadcast_to(np.asarray(standing_after)[..., None], shape)
        relevant = times <= until + motion_model.STEP_S  # the robot does not move after that
        positions, times, in_motion = poses[relevant][:, :2], times[relevant], (times <= until)[relevant]
        gap = np.minimum(self.wall_distance(positions) - self.min_wall_distance, max_gap)
        reach = float(np.hypot(*positions.T).max(initial=0.0)) + self.min_point_distance + max_gap
        distance = np.hypot(*self.points.T)
        static = self.points[(distance < reach) & np.logical_not(self.moving)]
        if len(static):
            gap = np.minimum(gap, least_distance(positions, static) - self.min_point_distance)
        approach = WALKING_SPEED * times[in_motion]
        moving = self.points[self.moving & (distance < reach + approach.max(initial=0.0))]
        if len(moving):
            remaining = least_distance(positions[in_motion], moving) - self.min_point_distance - approach
            gap[in_motion] = np.minimum(gap[in_motion], remaining)
        gaps = np.full(shape, max_gap)
        gaps[relevant] = gap
        return gaps


def least_distance(positions: Array, points: Array) -> Array:
    """Distance (N,) m from each of ``positions`` (N, 2) to the nearest of ``points`` (K, 2), all near the origin.

    Computed as one matrix product, which for a few hundred points is several times faster than a tree.
    """
    p = np.vstack([positions.T, np.ones(len(positions))])
    q = np.column_stack([-2 * points, np.sum(points**2, axis=1)])
    return np.asarray(np.sqrt(np.maximum((q @ p).min(axis=0) + np.sum(positions**2, axis=1), 0.0)))


@dataclass(frozen=True)
class PoseBelief:
    """The belief about the pose, and the expected information of scans. By default the pose is known."""

    pose: Array = field(default_factory=lambda: np.zeros(3))  # (3,) base_link in map
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))  # (3, 3) in map
    scans: ScanInformation | None = None

    @property
    def variance(self) -> float:
        """Variance of the position, m², over both axes."""
        return float(self.covariance[0, 0] + self.covariance[1, 1])

    def ambiguity_and_gain(self, motions: Array, lookahead: Array, seconds: float) -> tuple[Array, Array]:
        """Ambiguity and information gain (N,) nats about the pose, of motions (N, T, 3) and the lines beyond.

        The lines lead to the lookahead point (2,) m. All is in base_link, and the motions take ``seconds``.
        """
        if self.scans is None:
            return np.zeros(len(motions)), np.zeros(len(motions))
        ends, before, after = motions[:, -1, :2], motions[:, :-1, :2], motions[:, 1:, :2]
        line_length = np.hypot(*(lookahead - ends).T)[:, None]
        # One sample per cell of the ambiguity: with fewer, errors of its integral exceed differences between motions.
        samples = max(1, int(np.ceil(line_length.max() / self.scans.ambiguity_grid.resolution)))
        fraction = (np.arange(samples)[:, None] + 0.5) / samples
        line = ends[:, None] + fraction * (lookahead - ends)[:, None]
        points = se2.transform(self.pose, np.concatenate([(before + after) / 2, line], axis=1))
        # Length of the part of the way that each point represents
        metres = np.concatenate(
            [
                np.linalg.norm(after - before, axis=-1),
                np.repeat(line_length / samples, samples, axis=1),
            ],
            axis=1,
        )
        ambiguity = np.sum(metres * self.scans.ambiguity_grid.interpolate(self.scans.ambiguity, points), axis=1)
        information = self.scans.information[self.scans.information_grid.cell_of(se2.transform(self.pose, ends))]
        information = information * seconds / self.scans.scan_period
        present = efe.remaining_entropy(self.covariance, np.zeros((3, 3)))
        return ambiguity, present - efe.remaining_entropy(self.covariance, information)


@dataclass(frozen=True)
class SelectedMotion:
    """The best candidate motion."""

    action: Array  # (3,) m/s, m/s, rad/s in base_link
    poses: Array  # (T, 3) predicted, in the present base_link, until standstill
    terms: dict[str, float]  # of its expected free energy, nats, and its probability
    hindered: bool  # a wall, or an obstacle that is there or may approach, ruled out a better motion


def select_motion(
    current: Array,
    lookahead: Array,
    surroundings: Surroundings,
    robot: Robot,
    belief: PoseBelief | None = None,
    cost_beyond: float = 0.0,
) -> SelectedMotion:
    """The candidate motion of least expected free energy.

    ``current`` (3,) is the present velocity and ``lookahead`` (2,) m the lookahead point, both in base_link. Motions
    are sampled around the latter, and then once more around the best of them. A motion is excluded if something is in
    its way, or may come into its way before the robot stands. ``cost_beyond`` m, that of the path from the lookahead
    point on, is the same for all motions; it is only added to the risk in the result.
    """
    evaluator = _Evaluator(current, lookahead, surroundings, robot, belief or PoseBelief())
    sampled = evaluator.evaluate(motion_model.candidate_motions(current, lookahead, robot), braking_is_free=True)
    evaluations = [sampled]
    if sampled.motions[sampled.best, :3].any():
        evaluations.append(evaluator.evaluate(motion_model.refined_motions(sampled.motions[sampled.best], robot)))
    chosen = min(evaluations, key=lambda evaluation: evaluation.least)
    hindered = float(sampled.energy.total.min()) < chosen.least - HINDERED_M * NATS_PER_METRE
    best = chosen.best
    terms = chosen.energy.of(best, np.concatenate([each.allowed_energy for each in evaluations]))
    terms["risk"] += 2 * NATS_PER_METRE * cost_beyond  # in the mean distance during the motion and in that at its end
    return SelectedMotion(chosen.motions[best, :3], chosen.poses[best], terms, hindered=hindered)


@dataclass(frozen=True)
class _Evaluation:
    """Candidate motions and their expected free energy."""

    motions: Array  # (N, 5)
    poses: Array  # (N, T, 3) to which they lead
    energy: ExpectedFreeEnergy
    allowed_energy: Array  # (N,) total energy in nats; +inf for excluded motions

    @property
    def best(self) -> int:
        return int(np.argmin(self.allowed_energy))

    @property
    def least(self) -> float:
        return float(self.allowed_energy.min())


class _Evaluator:
    """Evaluates candidate motions in one situation."""

    def __init__(
        self, current: Array, lookahead: Array, surroundings: Surroundings, robot: Robot, belief: PoseBelief
    ) -> None:
        self.current, self.lookahead, self.surroundings = current, lookahead, surroundings
        self.robot, self.belief = robot, belief
        # If the robot is too close to something already, every motion that leads away from it counts as free.
        present_gap = float(surroundings.gaps(np.zeros((1, 1, 3)), np.zeros(1), max_gap=WALL_COST_RANGE_M)[0, 0])
        self._min_gap = min(0.0, present_gap) - GAP_TOLERANCE_M

    def evaluate(self, motions: Array, *, braking_is_free: bool = False) -> _Evaluation:
        """Expected free energy of candidate motions (N, 5); `_visible_motions` first removes or slows some of them.

        With ``braking_is_free``, motion 0, which brakes, is never excluded, even if an obstacle may approach meanwhile.
        """
        motions = _visible_motions(motions, self.surroundings)
        poses, times, standing_after = motion_model.rollouts(self.current, self._with_turn(motions), self.robot)
        deviation = np.sqrt(self.belief.variance / 2)
        gaps = self.surroundings.gaps(poses, times, standing_after, WALL_COST_RANGE_M + 2 * deviation)
        free = np.all(gaps >= self._min_gap, axis=1)
        if braking_is_free:
            free[0] = True
        metres = self._risk_metres(motions, poses, gaps, deviation)
        ambiguity, information = self.belief.ambiguity_and_gain(poses, self.lookahead, float(times[-1]))
        energy = ExpectedFreeEnergy(NATS_PER_METRE * metres, ambiguity, information, np.zeros(len(motions)))
        return _Evaluation(motions, poses, energy, np.where(free, energy.total, np.inf))

    def _with_turn(self, motions: Array) -> Array:
        """The motions (N, 5) with the turn that `motion_model.turn_to_lookahead` adds for a holonomic base."""
        if self.robot.drive == "differential" or not self.surroundings.may_turn:
            return motions
        speed = np.hypot(motions[:, 0], motions[:, 1])
        speed = np.where(speed > 0, speed, np.hypot(*self.current[:2]))
        turn = motion_model.turn_rate_while_moving(self.lookahead, speed, self.robot, self.surroundings.forward)
        return np.column_stack([motions[:, :2], turn, motions[:, 3:]])

    def _risk_metres(self, motions: Array, poses: Array, gaps: Array, deviation: float) -> Array:
        """Risk (N,) in m to go, with the ``deviation`` m of the belief's position.

        It is the sum of the mean distance to go during the motion, the distance to go at its end, additional metres if
        its narrowest gap is small, and the cost of the change of velocity.
        """
        distance = remaining_distance(poses, self.lookahead, self.robot, self.surroundings)
        distance = efe.expected_distance(distance, self.belief.variance)
        closeness = efe.expected_square(1 - gaps.min(axis=1) / WALL_COST_RANGE_M, deviation / WALL_COST_RANGE_M)
        effort = CHANGE_COST_S * np.hypot(*(motions[:, :2] - self.current[:2]).T)
        near_obstacles = MAX_WALL_COST * closeness * path_lengths(poses)
        return np.asarray(distance.mean(axis=1) + distance[:, -1] + near_obstacles + effort)


def path_lengths(poses: Array) -> Array:
    """Length (N,) m of each path of poses (N, T, 3)."""
    return np.asarray(np.hypot(*np.diff(poses[..., :2], axis=1).T).sum(axis=0))


def remaining_distance(poses: Array, lookahead: Array, robot: Robot, surroundings: Surroundings) -> Array:
    """Distance (...,) m from poses (..., 3) to the lookahead point, all in the present base_link.

    It includes the distance that could be driven during the turn that must come first: of a differential base, until
    the lookahead point lies ahead, of a holonomic one, until the scanner sees the way there.
    """
    offset = lookahead - poses[..., :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    bearing = se2.wrap(np.arctan2(offset[..., 1], offset[..., 0]) - poses[..., 2])
    if robot.drive == "differential":
        turn = np.abs(bearing)
    elif surroundings.may_turn:
        turn = surroundings.turn_until_seen(bearing)
    else:
        return np.asarray(distance)
    return np.asarray(distance + turn * robot.max_speed / robot.max_turn * np.minimum(1.0, distance / HEADING_FADE_M))


def _visible_motions(motions: Array, surroundings: Surroundings) -> Array:
    """Removes motions (N, 5) into directions that the scanner does not see; if the base may not turn, slows them."""
    speed = np.hypot(motions[:, 0], motions[:, 1])
    too_fast = speed > BLIND_SPEED if not surroundings.may_turn else speed > motion_model.STANDING_SPEED
    blind = ~surroundings.sees(np.arctan2(motions[:, 1], motions[:, 0])) & too_fast
    if surroundings.may_turn:
        return motions[~blind]
    scale = np.where(blind, BLIND_SPEED / np.maximum(speed, 1e-9), 1.0)
    return np.column_stack([motions[:, :2] * scale[:, None], motions[:, 2:]])
