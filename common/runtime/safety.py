"""Velocity limits, and braking before obstacles in the scan."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.definitions import Scan
from common.robot.base import Robot
from common.robot.ranges import surfaces

REACTION_TIME_S = 2 / 15  # s: the scan is up to one period old, and the command holds for another
SIDE = 0.01  # m beside the footprint that must be free as well
STEP = 1 / 60  # s between the points of a way looked at: 17 mm at 1 m/s, 0.1 mm off between two of them


def scan_points(scan: Scan) -> Array:
    """(K, 2) m in base_link of every beam that hit something; too close (-inf) counts as at range_min."""
    close = np.isneginf(scan.ranges)
    hit = surfaces(scan.ranges) | close
    ranges = np.where(close, scan.range_min, scan.ranges.astype(np.float64))
    angles, ranges = scan.angles()[hit], ranges[hit]
    in_laser = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)
    return se2.transform(scan.mount.array(), in_laser)


def clip_twist(twist: Array, robot: Robot) -> Array:
    """(3,) vx, vy m/s, wz rad/s within the robot's limits, direction kept; not finite: standing."""
    if not np.isfinite(twist).all():
        return np.zeros(3)
    linear = np.array([twist[0], twist[1] if robot.drive == "holonomic" else 0.0])
    # Halved before squared: the greatest float must not overflow.
    speed = float(np.hypot(linear[0] / 2, linear[1] / 2)) * 2
    if speed > robot.max_speed:
        linear = linear / np.abs(linear).max()
        linear *= robot.max_speed / float(np.hypot(*linear))
    return np.array([*linear, np.clip(twist[2], -robot.max_turn, robot.max_turn)])


def ramp(current: Array, wanted: Array, robot: Robot, dt: float, *, hard: bool = False) -> Array:
    """(3,) the velocity after ``dt`` s of changing ``current`` to ``wanted`` as fast as the limits allow.

    ``hard``: as fast as the base can, which is meant for standing.
    """
    # Hard is never less than at ease, whatever the base's own acceleration.
    change, harder = wanted - current, max(1.0, robot.braking / robot.acceleration) if hard else 1.0
    linear, most = float(np.hypot(change[0], change[1])), robot.acceleration * harder * dt
    scale = min(1.0, most / linear) if linear > 0 else 1.0
    turn = robot.turn_acceleration * harder * dt
    return np.array([*(current[:2] + change[:2] * scale), current[2] + np.clip(change[2], -turn, turn)])


def limit_velocity(
    twist: Array, points: Array, robot: Robot, current: Array | None = None, hold: float = REACTION_TIME_S
) -> tuple[Array, bool]:
    """The twist (3,) slowed so that the robot can brake before any of ``points`` (K, 2) m in base_link; whether it was.

    The footprint is round, so turning on the spot is free. Moving away is always allowed: a point counts only where
    the robot comes nearer to it. ``current`` (3,) is the velocity the robot has now, ``twist`` itself where not given;
    ``hold`` s is how long the result is followed until the next scan. Where ``current`` leaves no other way out, all
    three components are 0. An admissible velocity in the sense of the dynamic window (Fox, Burgard, Thrun 1997).
    """
    if not np.isfinite(twist).all():
        return np.zeros(3), True
    allowed = np.array([*(twist[:2] * _straight_scale(twist, points, robot)), twist[2]])
    if current is None and twist[2] == 0:
        return allowed, bool((allowed != twist).any())

    def clear(scale: float) -> bool:
        wanted = allowed * [scale, scale, 1.0]
        return _clear(wanted if current is None else current, wanted, points, robot, hold)

    if clear(1.0):
        return allowed, bool((allowed != twist).any())
    if not clear(0.0):
        return np.zeros(3), True
    low, high = 0.0, 1.0
    for _ in range(6):
        middle = (low + high) / 2
        low, high = (middle, high) if clear(middle) else (low, middle)
    return allowed * [low, low, 1.0], True


def _straight_scale(twist: Array, points: Array, robot: Robot) -> float:
    """By what to multiply the speed so that the robot, going straight on, stops ``robot.margin`` before any point."""
    speed = float(np.hypot(twist[0], twist[1]))
    if speed < 1e-9 or len(points) == 0:
        return 1.0
    ahead = twist[:2] / speed
    along, aside = points @ ahead, np.abs(points @ np.array([-ahead[1], ahead[0]]))
    in_way = (along > 0) & (aside < robot.radius + SIDE)
    if not in_way.any():
        return 1.0
    reach = np.sqrt(np.maximum((robot.radius + SIDE) ** 2 - aside[in_way] ** 2, 0.0))
    gap = max(0.0, float(np.min(along[in_way] - reach)) - robot.margin)
    # v REACTION_TIME_S + v² / 2a <= gap
    allowed = robot.acceleration * (np.sqrt(REACTION_TIME_S**2 + 2 * gap / robot.acceleration) - REACTION_TIME_S)
    return min(1.0, float(allowed) / speed)


def stopping_path(current: Array, wanted: Array, robot: Robot, hold: float) -> Array:
    """(T, 2) m in base_link of now: the way from ``current`` (3,) towards ``wanted`` for ``hold`` s, then to a stop.

    Both within the limits of acceleration, as `ramp` has them. A twist turns with the robot, so the way is curved.
    """
    began = _ramped(current, wanted, robot, np.arange(0, hold, STEP) + STEP / 2)
    then = _ramped(current, wanted, robot, np.array([hold]))[0]
    longest = max(float(np.hypot(then[0], then[1])) / robot.acceleration, STEP)
    velocity = np.concatenate([began, _ramped(then, np.zeros(3), robot, np.arange(0, longest, STEP) + STEP / 2)])
    yaw = np.cumsum(velocity[:, 2]) * STEP - velocity[:, 2] * STEP / 2
    cos, sin = np.cos(yaw), np.sin(yaw)
    vx, vy = velocity[:, 0], velocity[:, 1]
    steps = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1) * STEP
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _ramped(current: Array, wanted: Array, robot: Robot, times: Array) -> Array:
    """(T, 3) velocities at ``times`` (T,) s of a ramp."""
    change = wanted - current
    linear = max(float(np.hypot(change[0], change[1])), 1e-12)
    scale = np.minimum(1.0, robot.acceleration * times / linear)
    turn = robot.turn_acceleration * times
    return np.column_stack([current[:2] + change[:2] * scale[:, None], current[2] + np.clip(change[2], -turn, turn)])


def _clear(current: Array, wanted: Array, points: Array, robot: Robot, hold: float) -> bool:
    """Whether no point comes nearer than the footprint on the way to a stop."""
    path, near = stopping_path(current, wanted, robot, hold), robot.radius + SIDE
    travelled = float(np.hypot(*np.diff(path, axis=0).T).sum())
    points = points[np.hypot(points[:, 0], points[:, 1]) < near + travelled]
    distance = np.hypot(path[:, None, 0] - points[:, 0], path[:, None, 1] - points[:, 1])
    return not bool(((distance[1:] < near) & (np.diff(distance, axis=0) < -1e-7)).any())
