"""Velocity limits of a robot, and braking before what its scan shows; where the wheels are, and in the controller."""

from __future__ import annotations

import numpy as np

from common import se2
from common.messages import Scan
from common.robot import Robot
from common.se2 import Array

LATENCY = 2 / 15  # s: the scan is up to one period old, and the command holds for another
SIDE = 0.01  # m beside the footprint that must be free as well


def scan_points(scan: Scan) -> Array:
    """(K, 2) m in base_link of every beam that hit something; too close (-inf) counts as at range_min."""
    ranges = np.where(np.isneginf(scan.ranges), scan.range_min, scan.ranges.astype(np.float64))
    hit = np.isfinite(ranges)
    angles, ranges = scan.angles()[hit], ranges[hit]
    mount = scan.mount.array()
    in_laser = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)
    return mount[:2] + se2.rotate(float(mount[2]), in_laser)


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


def ramp(current: Array, wanted: Array, robot: Robot, dt: float) -> Array:
    """(3,) the velocity after ``dt`` s of changing ``current`` to ``wanted`` as fast as the limits allow."""
    change = wanted - current
    linear, most = float(np.hypot(change[0], change[1])), robot.acceleration * dt
    scale = min(1.0, most / linear) if linear > 0 else 1.0
    turn = robot.turn_acceleration * dt
    return np.array([*(current[:2] + change[:2] * scale), current[2] + np.clip(change[2], -turn, turn)])


def limit_velocity(twist: Array, points: Array, robot: Robot) -> tuple[Array, bool]:
    """The twist (3,) slowed so that the robot can brake before any of ``points`` (K, 2) m in base_link; whether it was.

    The footprint is round, so turning on the spot is free. Moving away is always allowed: a point counts only where
    it lies ahead in the direction of motion, within the width of the footprint.
    """
    if not np.isfinite(twist).all():
        return np.zeros(3), True
    speed = float(np.hypot(twist[0], twist[1]))
    if speed < 1e-9 or len(points) == 0:
        return np.array(twist, float), False
    ahead = twist[:2] / speed
    along, aside = points @ ahead, np.abs(points @ np.array([-ahead[1], ahead[0]]))
    in_way = (along > 0) & (aside < robot.radius + SIDE)
    if not in_way.any():
        return np.array(twist, float), False
    reach = np.sqrt(np.maximum((robot.radius + SIDE) ** 2 - aside[in_way] ** 2, 0.0))
    gap = max(0.0, float(np.min(along[in_way] - reach)) - robot.margin)
    # v LATENCY + v² / 2a <= gap
    allowed = robot.acceleration * (np.sqrt(LATENCY**2 + 2 * gap / robot.acceleration) - LATENCY)
    if allowed >= speed:
        return np.array(twist, float), False
    return np.array([twist[0] * allowed / speed, twist[1] * allowed / speed, twist[2]]), True
