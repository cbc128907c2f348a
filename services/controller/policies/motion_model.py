"""Where a velocity leads, braking included.

The outcome of an action is not the next place but the place where the robot would stand if it braked after it: limits
of acceleration are then part of what is predicted, and an action whose outcome is free can always be got out of.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.base import Robot

HOLD = 0.4  # s that an action is held in the prediction; the next scan asks anew
STEP = 1 / 15  # s
TURNING = 0.4  # share of the acceleration that a turn on the way may take
NEAR = 0.5  # m
CREEP = 0.02  # m/s, rad/s; slower is standing


def rollouts(current: Array, actions: Array, robot: Robot, hold: float = HOLD) -> tuple[Array, Array, Array]:
    """(N, T, 3) poses in base_link of now at (T,) s, of each action (N, 3) held for ``hold`` s and then braked.

    And (N,) s, after which it stands, but for a turn on the spot.

    ``current`` (3,) is the velocity of now, in base_link. A holonomic base keeps its direction in the map while it
    turns (each scan commands it anew); a differential one drives arcs.
    """
    times = np.arange(0, hold + longest_brake(robot), STEP) + STEP / 2
    held = times < hold
    change = actions - current
    linear = np.maximum(np.hypot(change[:, 0], change[:, 1]), 1e-12)[:, None]
    up = np.minimum(1.0, robot.acceleration * np.minimum(times, hold) / linear)  # (N, T)
    turned = robot.turn_acceleration * np.minimum(times, hold)
    velocity = np.empty((len(actions), len(times), 3))
    velocity[..., :2] = current[:2] + change[:, None, :2] * up[..., None]
    velocity[..., 2] = current[2] + np.clip(change[:, None, 2], -turned, turned)
    after = np.where(held, 0.0, times - hold)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), 1e-12)
    velocity[..., :2] *= np.maximum(0.0, 1 - robot.acceleration * after / speed)[..., None]
    slower = robot.turn_acceleration * after
    velocity[..., 2] -= np.clip(velocity[..., 2], -slower, slower)
    yaw = np.cumsum(velocity[..., 2], axis=1) * STEP
    way = velocity[..., :2]
    if robot.drive == "differential":
        middle = yaw - velocity[..., 2] * STEP / 2
        cos, sin = np.cos(middle), np.sin(middle)
        vx, vy = velocity[..., 0], velocity[..., 1]
        way = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1)
    poses = np.concatenate([np.cumsum(way, axis=1) * STEP, yaw[..., None]], axis=-1)
    fastest = np.hypot(*(current[:2] + change[:, :2] * np.minimum(1.0, robot.acceleration * hold / linear)).T)
    return poses, times + STEP / 2, hold + fastest / robot.acceleration


def moves(velocity: Array) -> bool:
    """Whether a velocity (3,) is more than standing."""
    return float(np.hypot(velocity[0], velocity[1])) + abs(float(velocity[2])) > CREEP


def longest_brake(robot: Robot) -> float:
    """Seconds until the robot stands, from its greatest speed and turn."""
    return max(robot.max_speed / robot.acceleration, robot.max_turn / robot.turn_acceleration)


def braking_speed(distance: float, robot: Robot, hold: float = HOLD) -> float:
    """m/s that, held for ``hold`` s and then braked, ends after ``distance`` m: v hold + v^2 / 2a = distance."""
    a = robot.acceleration
    return min(robot.max_speed, float(a * (np.sqrt(hold**2 + 2 * max(distance, 0.0) / a) - hold)))


def turn_rate(angle: float, robot: Robot) -> float:
    """rad/s towards a heading that is ``angle`` rad away, braked in time."""
    rate = robot.turn_acceleration * (np.sqrt(STEP**2 + 2 * abs(angle) / robot.turn_acceleration) - STEP)
    return float(np.sign(angle) * min(robot.max_turn, rate))


def facing(action: Array, attractor: Array, robot: Robot, *, turns: bool, front: float = 0.0) -> Array:
    """The action (3,) of a holonomic base with a turn towards the attractor (2,) m, so that it sees where it goes.

    ``front`` rad is the side that is turned there.

    Near the attractor, and with it in front, the heading is kept. Any other base's action, and that of one that may not
    turn, is as it was.
    """
    if robot.drive != "holonomic" or not turns:
        return np.array(action)
    bearing = float(se2.wrap(np.arctan2(attractor[1], attractor[0]) - front))
    if np.hypot(*attractor) < NEAR and abs(bearing) < np.pi / 3:
        return np.array([action[0], action[1], 0.0])
    # A base that turns must change its velocity in base_link to keep it in map, for which it has an acceleration.
    most = TURNING * robot.acceleration / max(float(np.hypot(action[0], action[1])), 1e-3)
    turn = float(np.clip(turn_rate(bearing, robot), -most, most))
    return np.array([*se2.rotate(-turn * STEP / 2, action[:2]), turn])


def candidates(current: Array, towards: Array, robot: Robot) -> Array:
    """(N, 3) actions to choose from, in base_link: standing, going on, a fan about the attractor ``towards`` (2,) m.

    Those straight at it have the speed that ends there.
    """
    bearing, away = float(np.arctan2(towards[1], towards[0])), float(np.hypot(*towards))
    speeds = np.unique([*(robot.max_speed * np.array([0.08, 0.2, 0.4, 0.7, 1.0])), braking_speed(away, robot)])
    if robot.drive == "holonomic":
        fan = np.deg2rad([0, 8, 17, 28, 42, 60, 85, 115])
        directions = bearing + np.concatenate([fan, -fan[1:], [np.pi]])
        v, d = (each.ravel() for each in np.meshgrid(speeds, directions))
        many = np.stack([v * np.cos(d), v * np.sin(d), np.zeros_like(v)], axis=-1)
    else:
        turns = robot.max_turn * np.array([0, 0.06, 0.14, 0.25, 0.45, 0.7, 1.0])
        v, w = (each.ravel() for each in np.meshgrid([0.0, *speeds], np.concatenate([turns, -turns[1:]])))
        # The arc through the attractor, for each speed; and turning on the spot until it lies ahead.
        arcs = np.clip(2 * speeds * np.sin(bearing) / max(away, 0.1), -robot.max_turn, robot.max_turn)
        v, w = np.concatenate([v, speeds, [0.0]]), np.concatenate([w, arcs, [turn_rate(bearing, robot)]])
        many = np.stack([v, np.zeros_like(v), w], axis=-1)
    return np.concatenate([np.zeros((1, 3)), current[None], many])
