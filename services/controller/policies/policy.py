"""Chooses a velocity by expected free energy."""

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

COMFORT = 0.25  # m beside the footprint, below which progress counts for less
DISCOMFORT = 0.5  # by how much less, at the least gap
CLOSE = 0.3  # m, nearer to the attractor than this the heading towards it matters less and less
BLIND_SPEED = 0.25  # m/s, where the scanner does not look, for a base that may not turn; others turn first
ASIDE = np.pi / 4  # rad by which the scanner must look further than where the body goes, for it is wide
NARROW = 3  # a scanner that sees little more than that still answers for the middle third of what it sees
LEAST_PROGRESS = 0.004  # m; what gains less is as good as standing
STEADY = 0.02  # m per m/s, for going on as before


@dataclass(frozen=True)
class Around:
    """What a motion must keep away from, in base_link of now."""

    known: Callable[[Array], Array]  # (..., 2) m -> (...,) m to the nearest wall of the map; inf where there is no map
    points: Array  # (K, 2) m, seen and not in the map
    moving: Array  # (K,) bool, those that may come nearer
    least: float  # m to anything the map knows
    keep: float  # m to points
    walking: float = 1.0  # m/s, of those that move
    view: Sector = ALL_ROUND  # that the scanner sees
    turns: bool = True  # the base may turn, so nothing need be done unseen

    def sees(self, bearings: Array | float) -> npt.NDArray[np.bool_]:
        """(...,) bool: whether the scanner can answer for what a body meets that goes towards ``bearings`` rad."""
        if self.view.half >= np.pi:
            return np.ones(np.shape(bearings), bool)
        off = np.abs(se2.wrap(bearings - self.view.centre))
        return np.asarray(off <= max(self.view.half - ASIDE, self.view.half / NARROW) + 1e-9)

    @property
    def front(self) -> float:
        """Rad, where to turn towards what lies ahead: x, where the scanner looks there, else the middle of its view."""
        return 0.0 if bool(self.sees(0.0)) else self.view.centre

    def gaps(self, poses: Array, times: Array, stands: Array | float = np.inf, enough: float = np.inf) -> Array:
        """(N, T) m left between footprint and anything at poses (N, T, 3); less where somebody may be by then.

        Once the robot stands, after ``stands`` (N,) s, whoever walks does not walk into it: passive safety. Gaps of
        more than ``enough`` m are not told apart, which saves most of the work.
        """
        shape = poses.shape[:-1]
        times, until = np.broadcast_to(times, shape), np.broadcast_to(np.asarray(stands)[..., None], shape)
        moved = times <= until + motion.STEP  # later places are the last of these
        places, times, awake = poses[moved][:, :2], times[moved], (times <= until)[moved]
        gap = np.minimum(self.known(places) - self.least, enough)
        reach = float(np.hypot(*places.T).max(initial=0.0)) + self.keep + enough
        away = np.hypot(*self.points.T)
        still = self.points[(away < reach) & np.logical_not(self.moving)]
        if len(still):
            gap = np.minimum(gap, least_distance(places, still) - self.keep)
        come = self.walking * times[awake]
        walkers = self.points[self.moving & (away < reach + come.max(initial=0.0))]
        if len(walkers):
            gap[awake] = np.minimum(gap[awake], least_distance(places[awake], walkers) - self.keep - come)
        gaps = np.full(shape, enough)
        gaps[moved] = gap
        return gaps


def least_distance(places: Array, points: Array) -> Array:
    """(N,) m from each of ``places`` (N, 2) to the nearest of ``points`` (K, 2), all of them near the origin.

    As one product of matrices, which for some hundred points is several times faster than a tree.
    """
    p = np.vstack([places.T, np.ones(len(places))])
    q = np.column_stack([-2 * points, np.sum(points**2, axis=1)])
    return np.asarray(np.sqrt(np.maximum((q @ p).min(axis=0) + np.sum(places**2, axis=1), 0.0)))


@dataclass(frozen=True)
class Choice:
    """The best of the candidates."""

    action: Array  # (3,) m/s, m/s, rad/s in base_link
    way: Array  # (T, 3) where it leads, in base_link of now, until it would stand
    progress: float  # m that it brings the place of standing nearer to the goal
    held: bool  # something in the way, or that may come, made it slower


def choose(current: Array, attractor: Array, around: Around, robot: Robot) -> Choice:
    """Of all candidates the one of least expected free energy; ``attractor`` (2,) m and ``current`` (3,) in base_link.

    The preference is ``-ln p = lambda d`` with the distance d to go from where the robot would stand, so a candidate's
    expected free energy, in units of lambda, is the d it leaves. One whose way is not free, or may not stay free before
    the robot stands, has none. lambda does not change which is least.
    """
    actions = motion.candidates(current, attractor, robot)
    actions = _seen(actions, around)
    poses, times, stands = motion.rollouts(current, actions, robot)
    gaps = around.gaps(poses, times, stands, COMFORT)
    now = float(around.gaps(np.zeros((1, 1, 3)), np.zeros(1), enough=COMFORT)[0, 0])
    # From where it is too near already, any way is free that leads away.
    free = np.all(gaps >= min(0.0, now) - 1e-3, axis=1)
    gain = to_go(poses[0, -1], attractor, robot) - to_go(poses[:, -1], attractor, robot)
    tight = np.clip(1 - np.min(gaps, axis=1) / COMFORT, 0, 1)
    weighed = np.where(gain > 0, gain * (1 - DISCOMFORT * tight**2), gain)
    weighed = weighed - STEADY * np.hypot(*(actions - current)[:, :2].T)
    # Braking is always there, though somebody may come meanwhile.
    open_ = np.where(free, weighed, -np.inf)
    open_[0] = 0.0
    best = int(np.argmax(open_))
    if gain[best] < LEAST_PROGRESS:
        best = 0
    wished = int(np.argmax(np.where(np.isfinite(weighed), weighed, -np.inf)))
    return Choice(actions[best], poses[best], float(gain[best]), held=bool(weighed[wished] > open_[best] + 0.05))


def to_go(poses: Array, attractor: Array, robot: Robot) -> Array:
    """(...,) m from poses (..., 3) to the attractor; where a base must turn, with the m it could go meanwhile."""
    away = attractor - poses[..., :2]
    distance = np.hypot(away[..., 0], away[..., 1])
    if robot.drive == "holonomic":
        return np.asarray(distance)
    turn = np.abs(se2.wrap(np.arctan2(away[..., 1], away[..., 0]) - poses[..., 2]))
    return np.asarray(distance + turn * robot.max_speed / robot.max_turn * np.minimum(1.0, distance / CLOSE))


def _seen(actions: Array, around: Around) -> Array:
    """The actions (N, 3) that the scanner can answer for; where a base may not turn, the others too, but slow."""
    speed = np.hypot(actions[:, 0], actions[:, 1])
    moves = speed > BLIND_SPEED if not around.turns else speed > motion.CREEP
    blind = ~around.sees(np.arctan2(actions[:, 1], actions[:, 0])) & moves
    if around.turns:
        return actions[~blind]
    scale = np.where(blind, BLIND_SPEED / np.maximum(speed, 1e-9), 1.0)
    return np.column_stack([actions[:, :2] * scale[:, None], actions[:, 2]])
