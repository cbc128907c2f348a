"""Velocity limits, and braking before obstacles in the scan."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.definitions import Scan
from common.robot.ranges import is_surface
from common.robot.robot import Robot

REACTION_TIME_S = 2 / 15  # the scan is up to one 15 Hz period old, and the command holds for another
PATH_STEP_S = 1 / 60  # between the points of a stopping path: 17 mm at 1 m/s, which is exact to 0.1 mm
# A beam is averaged with its neighbours within 1 cm whose ranges differ by at most 6 cm, a few times the noise of usual
# scanners. Whatever stands farther in front of a wall keeps its distance.
AVERAGE_WITHIN_M, MAX_RANGE_DIFFERENCE_M = 0.01, 0.06
MAX_AVERAGED_BEAMS = 8  # to either side


def scan_points(scan: Scan) -> Array:
    """(K, 2) points in m in base_link on the surfaces that the beams hit; too close (-inf) counts as at range_min.

    Each is the mean of the end points of a beam and of pairs of beams, one to either side, that end within centimetres.
    Otherwise the robot would stop before the largest of hundreds of errors: several centimetres too early. The mean on
    a straight wall lies on the wall, also at its end; that of a round post or a corner lies behind the surface by less
    than a centimetre, of a corner sharper than 60° by up to 3 cm. A post thinner than 2 cm within 6 cm of the wall
    behind it may appear nearly 6 cm too far away.
    """
    close = np.isneginf(scan.ranges)
    hit = is_surface(scan.ranges) | close
    ranges = np.where(close, scan.range_min, scan.ranges.astype(np.float64))
    ranges[~hit] = np.inf
    angles = scan.angles()
    with np.errstate(invalid="ignore"):  # inf times cos(90°)
        ends = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)
    spacing = abs(scan.angle_increment) * ranges  # m between neighbouring end points across the beam
    usable = np.where(close, np.inf, ranges)  # a surface that is too close may be anywhere nearer than range_min
    total, count = ends.copy(), np.ones(len(ranges))
    for offset in range(1, min(MAX_AVERAGED_BEAMS, (len(ranges) - 1) // 2) + 1):
        before, here, after = slice(None, -2 * offset), slice(offset, -offset), slice(2 * offset, None)
        same = offset * spacing[here] <= AVERAGE_WITHIN_M
        for other in (before, after):  # with one of them alone, the mean at the end of a wall would move along it
            with np.errstate(invalid="ignore"):  # inf - inf
                same &= np.abs(usable[here] - usable[other]) <= MAX_RANGE_DIFFERENCE_M
        total[here][same] += ends[before][same] + ends[after][same]
        count[here] += 2 * same
    return se2.transform(scan.mount.array(), total[hit] / count[hit, None])


def clip_twist(twist: Array, robot: Robot) -> Array:
    """Limits a twist (3,) vx, vy m/s, wz rad/s to the robot's maximum velocities, keeping its direction.

    Returns zeros if the twist is not finite.
    """
    if not np.isfinite(twist).all():
        return np.zeros(3)
    linear = np.array([twist[0], twist[1] if robot.drive == "holonomic" else 0.0])
    # Halved first, so that the largest float does not overflow.
    speed = float(np.hypot(linear[0] / 2, linear[1] / 2)) * 2
    if speed > robot.max_speed:
        linear = linear / np.abs(linear).max()
        linear *= robot.max_speed / float(np.hypot(*linear))
    return np.array([*linear, np.clip(twist[2], -robot.max_turn, robot.max_turn)])


def ramp(current: Array, target: Array, robot: Robot, dt: float, *, hard: bool = False) -> Array:
    """(3,) velocity after ``dt`` s of changing from ``current`` to ``target`` within the acceleration limits.

    With ``hard``, brakes as hard as the base can (``robot.braking``); use it only to stop.
    """
    # Never below 1, in case the base's acceleration exceeds its braking.
    change, factor = target - current, max(1.0, robot.braking / robot.acceleration) if hard else 1.0
    linear, max_linear = float(np.hypot(change[0], change[1])), robot.acceleration * factor * dt
    scale = min(1.0, max_linear / linear) if linear > 0 else 1.0
    max_turn = robot.turn_acceleration * factor * dt
    return np.array([*(current[:2] + change[:2] * scale), current[2] + np.clip(change[2], -max_turn, max_turn)])


def limit_velocity(
    twist: Array, points: Array, robot: Robot, current: Array | None = None, hold: float = REACTION_TIME_S
) -> tuple[Array, bool]:
    """Slows a twist (3,) so that the robot can stop before any of the obstacle ``points`` (K, 2) m in base_link.

    Returns the limited twist and whether it was changed. This is an admissible velocity in the sense of the dynamic
    window approach (Fox, Burgard, Thrun 1997). The footprint is round, so turning on the spot is always allowed, and so
    is moving away: a point counts only while the robot approaches it. ``current`` (3,) is the robot's present velocity
    and defaults to ``twist``; ``hold`` is the time in s from the scan until the next command, to which the robot's
    latency is added. Returns zeros if even stopping at once comes too near to a point.
    """
    if not np.isfinite(twist).all():
        return np.zeros(3), True
    hold += robot.latency
    allowed = np.array([*(twist[:2] * _straight_scale(twist, points, robot, hold)), twist[2]])
    if current is None and twist[2] == 0:
        return allowed, bool((allowed != twist).any())

    def is_clear(scale: float) -> bool:
        target = allowed * [scale, scale, 1.0]
        return _is_path_clear(target if current is None else current, target, points, robot, hold)

    if is_clear(1.0):
        return allowed, bool((allowed != twist).any())
    if not is_clear(0.0):
        return np.zeros(3), True
    low, high = 0.0, 1.0
    for _ in range(6):
        middle = (low + high) / 2
        low, high = (middle, high) if is_clear(middle) else (low, middle)
    return allowed * [low, low, 1.0], True


def _straight_scale(twist: Array, points: Array, robot: Robot, hold: float) -> float:
    """Factor of the speed with which the robot, driving straight, can stop ``robot.margin`` before the first point.

    It keeps its speed for ``hold`` s before it brakes.
    """
    speed = float(np.hypot(twist[0], twist[1]))
    if speed < 1e-9 or len(points) == 0:
        return 1.0
    ahead = twist[:2] / speed
    along, aside = points @ ahead, np.abs(points @ np.array([-ahead[1], ahead[0]]))
    in_way = (along > 0) & (aside < robot.radius + robot.margin)
    if not in_way.any():
        return 1.0
    reach = np.sqrt(np.maximum((robot.radius + robot.margin) ** 2 - aside[in_way] ** 2, 0.0))
    gap = max(0.0, float(np.min(along[in_way] - reach)))
    # Solve v hold + v² / 2a = gap for v.
    allowed = robot.acceleration * (np.sqrt(hold**2 + 2 * gap / robot.acceleration) - hold)
    return min(1.0, float(allowed) / speed)


def stopping_path(current: Array, target: Array, robot: Robot, hold: float) -> Array:
    """(T, 2) positions in m, in the present base_link, until the robot stands.

    The velocity changes from ``current`` (3,) towards ``target`` for ``hold`` s and then to zero, both within the
    acceleration limits of `ramp`. A twist turns with the robot, so the path is curved.
    """
    dt = PATH_STEP_S
    ramp_up = _ramp_velocities(current, target, robot, np.arange(0, hold, dt) + dt / 2)
    at_end = _ramp_velocities(current, target, robot, np.array([hold]))[0]
    braking_time = max(float(np.hypot(at_end[0], at_end[1])) / robot.acceleration, dt)
    braking = _ramp_velocities(at_end, np.zeros(3), robot, np.arange(0, braking_time, dt) + dt / 2)
    velocity = np.concatenate([ramp_up, braking])
    yaw = np.cumsum(velocity[:, 2]) * dt - velocity[:, 2] * dt / 2
    cos, sin = np.cos(yaw), np.sin(yaw)
    vx, vy = velocity[:, 0], velocity[:, 1]
    steps = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1) * dt
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _ramp_velocities(current: Array, target: Array, robot: Robot, times: Array) -> Array:
    """(T, 3) velocities at ``times`` (T,) s of a `ramp` from ``current`` to ``target``."""
    change = target - current
    linear = max(float(np.hypot(change[0], change[1])), 1e-12)
    scale = np.minimum(1.0, robot.acceleration * times / linear)
    turn = robot.turn_acceleration * times
    return np.column_stack([current[:2] + change[:2] * scale[:, None], current[2] + np.clip(change[2], -turn, turn)])


def _is_path_clear(current: Array, target: Array, points: Array, robot: Robot, hold: float) -> bool:
    """Whether the footprint keeps the robot's margin from every point that it approaches on the stopping path."""
    path, min_distance = stopping_path(current, target, robot, hold), robot.radius + robot.margin
    travelled = float(np.hypot(*np.diff(path, axis=0).T).sum())
    points = points[np.hypot(points[:, 0], points[:, 1]) < min_distance + travelled]
    distance = np.hypot(path[:, None, 0] - points[:, 0], path[:, None, 1] - points[:, 1])
    return not bool(((distance[1:] < min_distance) & (np.diff(distance, axis=0) < -1e-7)).any())
