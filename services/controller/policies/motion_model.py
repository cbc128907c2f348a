"""Predicted motion under a velocity command, until the robot stands.

The outcome of an action is defined as the place where the robot would stand if it braked after the action. Acceleration
limits are thus part of the prediction, and if an action's outcome is free, the robot can always stop in time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.base import Robot

HOLD_S = 0.4  # how long a prediction holds an action; the next scan leads to a new decision
STEP_S = 1 / 15
TURN_ACCELERATION_SHARE = 0.4  # share of the acceleration that a turn during motion may use
NEAR_ATTRACTOR_M = 0.5
STANDING_SPEED = 0.02  # m/s or rad/s; anything slower counts as standing


def rollouts(current: Array, actions: Array, robot: Robot, hold: float = HOLD_S) -> tuple[Array, Array, Array]:
    """Predict the motion of actions (N, 3) that are held for ``hold`` s and then braked.

    ``current`` (3,) is the present velocity in base_link. A holonomic base keeps its direction in the map while it
    turns, because each scan leads to a new command; a differential base drives arcs.

    Returns poses (N, T, 3) in the present base_link, their times (T,) s, and the times (N,) s after which the robot
    stands, apart from a turn on the spot.
    """
    times = np.arange(0, hold + max_braking_time(robot), STEP_S) + STEP_S / 2
    held = times < hold
    change = actions - current
    linear = np.maximum(np.hypot(change[:, 0], change[:, 1]), 1e-12)[:, None]
    progress = np.minimum(1.0, robot.acceleration * np.minimum(times, hold) / linear)  # (N, T) share of the change
    max_turn_change = robot.turn_acceleration * np.minimum(times, hold)
    velocity = np.empty((len(actions), len(times), 3))
    velocity[..., :2] = current[:2] + change[:, None, :2] * progress[..., None]
    velocity[..., 2] = current[2] + np.clip(change[:, None, 2], -max_turn_change, max_turn_change)
    braking_time = np.where(held, 0.0, times - hold)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), 1e-12)
    velocity[..., :2] *= np.maximum(0.0, 1 - robot.acceleration * braking_time / speed)[..., None]
    max_turn_braking = robot.turn_acceleration * braking_time
    velocity[..., 2] -= np.clip(velocity[..., 2], -max_turn_braking, max_turn_braking)
    yaw = np.cumsum(velocity[..., 2], axis=1) * STEP_S
    linear_velocity = velocity[..., :2]
    if robot.drive == "differential":
        yaw_at_middle = yaw - velocity[..., 2] * STEP_S / 2
        cos, sin = np.cos(yaw_at_middle), np.sin(yaw_at_middle)
        vx, vy = velocity[..., 0], velocity[..., 1]
        linear_velocity = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1)
    poses = np.concatenate([np.cumsum(linear_velocity, axis=1) * STEP_S, yaw[..., None]], axis=-1)
    top_speed = np.hypot(*(current[:2] + change[:, :2] * np.minimum(1.0, robot.acceleration * hold / linear)).T)
    return poses, times + STEP_S / 2, hold + top_speed / robot.acceleration


def is_moving(velocity: Array) -> bool:
    """Whether a velocity (3,) is more than `STANDING_SPEED`."""
    return float(np.hypot(velocity[0], velocity[1])) + abs(float(velocity[2])) > STANDING_SPEED


def max_braking_time(robot: Robot) -> float:
    """Seconds until the robot stands, from its maximum speed and turn rate."""
    return max(robot.max_speed / robot.acceleration, robot.max_turn / robot.turn_acceleration)


def braking_speed(distance: float, robot: Robot, hold: float = HOLD_S) -> float:
    """Speed in m/s that, held for ``hold`` s and then braked, covers ``distance`` m: v hold + v^2 / 2a = distance."""
    a = robot.acceleration
    return min(robot.max_speed, float(a * (np.sqrt(hold**2 + 2 * max(distance, 0.0) / a) - hold)))


def turn_rate(angle: float, robot: Robot) -> float:
    """Turn rate in rad/s towards a heading that is ``angle`` rad away, from which the robot can brake in time."""
    rate = robot.turn_acceleration * (np.sqrt(STEP_S**2 + 2 * abs(angle) / robot.turn_acceleration) - STEP_S)
    return float(np.sign(angle) * min(robot.max_turn, rate))


def turn_to_attractor(action: Array, attractor: Array, robot: Robot, *, may_turn: bool, forward: float = 0.0) -> Array:
    """Add a turn to the action (3,) of a holonomic base, so that the scanner looks where the robot goes.

    The side at bearing ``forward`` rad in base_link is turned towards the attractor (2,) m. The heading is kept near
    the attractor if that lies ahead. Returns the action unchanged for a differential base, and if ``may_turn`` is
    False.
    """
    if robot.drive != "holonomic" or not may_turn:
        return np.array(action)
    bearing = float(se2.wrap(np.arctan2(attractor[1], attractor[0]) - forward))
    if np.hypot(*attractor) < NEAR_ATTRACTOR_M and abs(bearing) < np.pi / 3:
        return np.array([action[0], action[1], 0.0])
    # A base that turns must change its velocity in base_link to keep it in map, which takes acceleration.
    max_turn = TURN_ACCELERATION_SHARE * robot.acceleration / max(float(np.hypot(action[0], action[1])), 1e-3)
    turn = float(np.clip(turn_rate(bearing, robot), -max_turn, max_turn))
    return np.array([*se2.rotate(-turn * STEP_S / 2, action[:2]), turn])


def candidate_actions(current: Array, attractor: Array, robot: Robot) -> Array:
    """Actions (N, 3) in base_link to choose from: standing, the current one, and a fan around the attractor (2,) m.

    One of the speeds is that which ends at the attractor.
    """
    bearing, distance = float(np.arctan2(attractor[1], attractor[0])), float(np.hypot(*attractor))
    speeds = np.unique([*(robot.max_speed * np.array([0.08, 0.2, 0.4, 0.7, 1.0])), braking_speed(distance, robot)])
    if robot.drive == "holonomic":
        fan = np.deg2rad([0, 8, 17, 28, 42, 60, 85, 115])
        directions = bearing + np.concatenate([fan, -fan[1:], [np.pi]])
        v, d = (each.ravel() for each in np.meshgrid(speeds, directions))
        actions = np.stack([v * np.cos(d), v * np.sin(d), np.zeros_like(v)], axis=-1)
    else:
        turns = robot.max_turn * np.array([0, 0.06, 0.14, 0.25, 0.45, 0.7, 1.0])
        v, w = (each.ravel() for each in np.meshgrid([0.0, *speeds], np.concatenate([turns, -turns[1:]])))
        # For each speed also the arc through the attractor, and a turn on the spot until the attractor lies ahead.
        arcs = np.clip(2 * speeds * np.sin(bearing) / max(distance, 0.1), -robot.max_turn, robot.max_turn)
        v, w = np.concatenate([v, speeds, [0.0]]), np.concatenate([w, arcs, [turn_rate(bearing, robot)]])
        actions = np.stack([v, np.zeros_like(v), w], axis=-1)
    return np.concatenate([np.zeros((1, 3)), current[None], actions])
