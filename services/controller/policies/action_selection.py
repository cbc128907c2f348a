"""Selects the velocity of least expected free energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.scan_geometry import ALL_ROUND, Sector
from services.controller.policies import motion_model as motion

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.base import Robot

COMFORT_GAP_M = 0.25  # beside the footprint; progress through narrower gaps is discounted
MAX_DISCOUNT = 0.5  # of progress, at gap 0
HEADING_FADE_M = 0.3  # closer to the attractor, the cost of turning towards it fades out
BLIND_SPEED = 0.25  # m/s into directions that the scanner does not see, for a base that may not turn; others turn first
VIEW_MARGIN_RAD = np.pi / 4  # the view must extend this far beyond the direction of motion, because the body is wide
MIN_VIEW_DIVISOR = 3  # with a narrow view, motion is still allowed in this fraction of it around its centre
MIN_PROGRESS_M = 0.004  # an action with less progress is replaced by standing
CHANGE_COST = 0.02  # m per m/s of change of the velocity, so that equivalent actions do not alternate


@dataclass(frozen=True)
class Surroundings:
    """Walls and obstacles that a motion must keep away from, in the present base_link."""

    wall_distance: Callable[[Array], Array]  # (..., 2) m -> (...,) m to the nearest mapped wall; inf without a map
    points: Array  # (K, 2) m, obstacles that are not in the map
    moving: Array  # (K,) bool, points that may approach
    min_wall_distance: float  # m from the robot's centre
    min_point_distance: float  # m from the robot's centre
    walking_speed: float = 1.0  # m/s assumed for moving points
    view: Sector = ALL_ROUND  # directions that the scanner sees
    may_turn: bool = True  # if the base may turn, it never has to move into a direction that the scanner does not see

    def sees(self, bearings: Array | float) -> npt.NDArray[np.bool_]:
        """Whether the scanner sees all that the body can meet on the way into ``bearings`` (...,) rad; (...,) bool."""
        if self.view.half >= np.pi:
            return np.ones(np.shape(bearings), bool)
        off_centre = np.abs(se2.wrap(bearings - self.view.centre))
        max_off_centre = max(self.view.half - VIEW_MARGIN_RAD, self.view.half / MIN_VIEW_DIVISOR)
        return np.asarray(off_centre <= max_off_centre + 1e-9)

    @property
    def forward(self) -> float:
        """Bearing in rad to turn towards a target: 0 if the scanner sees ahead, otherwise the middle of its view."""
        return 0.0 if bool(self.sees(0.0)) else self.view.centre

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
        relevant = times <= until + motion.STEP_S  # the robot does not move after that
        positions, times, in_motion = poses[relevant][:, :2], times[relevant], (times <= until)[relevant]
        gap = np.minimum(self.wall_distance(positions) - self.min_wall_distance, max_gap)
        reach = float(np.hypot(*positions.T).max(initial=0.0)) + self.min_point_distance + max_gap
        distance = np.hypot(*self.points.T)
        static = self.points[(distance < reach) & np.logical_not(self.moving)]
        if len(static):
            gap = np.minimum(gap, least_distance(positions, static) - self.min_point_distance)
        approach = self.walking_speed * times[in_motion]
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
class SelectedAction:
    """The best candidate action."""

    action: Array  # (3,) m/s, m/s, rad/s in base_link
    motion: Array  # (T, 3) predicted poses in the present base_link, until standstill
    progress: float  # m by which the place of standstill is closer to the attractor
    hindered: bool  # an obstacle, or one that may approach, ruled out a better action


def select_action(current: Array, attractor: Array, surroundings: Surroundings, robot: Robot) -> SelectedAction:
    """The candidate action of least expected free energy.

    ``current`` (3,) is the present velocity and ``attractor`` (2,) m the target, both in base_link.

    The preference is ``-ln p = lambda d`` with the distance d to go from where the robot would stand. In units of
    lambda, the expected free energy of an action is therefore the d that remains, and lambda does not affect the
    choice. An action is excluded if its motion is not free, or may not stay free until the robot stands.
    """
    actions = motion.candidate_actions(current, attractor, robot)
    actions = _visible_actions(actions, surroundings)
    poses, times, standing_after = motion.rollouts(current, actions, robot)
    gaps = surroundings.gaps(poses, times, standing_after, COMFORT_GAP_M)
    present_gap = float(surroundings.gaps(np.zeros((1, 1, 3)), np.zeros(1), max_gap=COMFORT_GAP_M)[0, 0])
    # If the robot is too close to something already, every motion that leads away from it counts as free.
    free = np.all(gaps >= min(0.0, present_gap) - 1e-3, axis=1)
    progress = remaining_distance(poses[0, -1], attractor, robot) - remaining_distance(poses[:, -1], attractor, robot)
    tightness = np.clip(1 - np.min(gaps, axis=1) / COMFORT_GAP_M, 0, 1)
    value = np.where(progress > 0, progress * (1 - MAX_DISCOUNT * tightness**2), progress)
    value = value - CHANGE_COST * np.hypot(*(actions - current)[:, :2].T)
    # Action 0, braking, is always allowed, even if an obstacle may approach meanwhile.
    allowed_value = np.where(free, value, -np.inf)
    allowed_value[0] = 0.0
    best = int(np.argmax(allowed_value))
    if progress[best] < MIN_PROGRESS_M:
        best = 0
    unhindered = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
    hindered = bool(value[unhindered] > allowed_value[best] + 0.05)
    return SelectedAction(actions[best], poses[best], float(progress[best]), hindered=hindered)


def remaining_distance(poses: Array, attractor: Array, robot: Robot) -> Array:
    """Distance (...,) m from poses (..., 3) to the attractor.

    For a differential base it includes the distance that could be driven in the time that the turn takes.
    """
    offset = attractor - poses[..., :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    if robot.drive == "holonomic":
        return np.asarray(distance)
    turn = np.abs(se2.wrap(np.arctan2(offset[..., 1], offset[..., 0]) - poses[..., 2]))
    return np.asarray(distance + turn * robot.max_speed / robot.max_turn * np.minimum(1.0, distance / HEADING_FADE_M))


def _visible_actions(actions: Array, surroundings: Surroundings) -> Array:
    """Removes actions (N, 3) into directions that the scanner does not see, or slows them if the base may not turn."""
    speed = np.hypot(actions[:, 0], actions[:, 1])
    too_fast = speed > BLIND_SPEED if not surroundings.may_turn else speed > motion.STANDING_SPEED
    blind = ~surroundings.sees(np.arctan2(actions[:, 1], actions[:, 0])) & too_fast
    if surroundings.may_turn:
        return actions[~blind]
    scale = np.where(blind, BLIND_SPEED / np.maximum(speed, 1e-9), 1.0)
    return np.column_stack([actions[:, :2] * scale[:, None], actions[:, 2]])
