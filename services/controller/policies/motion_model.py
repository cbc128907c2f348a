"""Candidate motions, and the poses that they lead to, until the robot stands.

A candidate motion (5,) consists of an action, which is a velocity in m/s, m/s and rad/s in base_link, and two times in
s: how long the linear part of the action is held before the robot brakes, and how long its turn. Acceleration limits
are part of the prediction, so on a motion without collision the robot can always stop in time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan
    from common.robot.robot import Robot

HOLD_S = 0.4  # how long most motions hold their action; the next scan leads to a new decision
STEP_S = 1 / 15  # time step of predicted motion, in s, and the period of a scanner that does not state its own
SHORT_HOLDS_S = STEP_S * np.arange(1, 6)  # of motions that stop at the target, or end their turn in its direction
TURN_ACCELERATION_SHARE = 0.4  # share of the acceleration that a turn during motion may use
NEAR_LOOKAHEAD_M = 0.5  # nearer than this, the robot no longer turns to a lookahead point that lies ahead
STANDING_SPEED = 0.02  # m/s or rad/s; anything slower counts as standing


def period_of(scan: Scan | None) -> float:
    """Time in s between scans, and so between commands; `STEP_S` if the scanner does not state it."""
    return (scan.scan_time if scan is not None else 0.0) or STEP_S


def delay_until_effect(robot: Robot, scan: Scan | None) -> float:
    """Time in s from a scan's stamp until the command that responds to it takes effect."""
    return robot.latency + (scan.sweep_time if scan is not None else 0.0)


def rollouts(current: Array, motions: Array, robot: Robot) -> tuple[Array, Array, Array]:
    """Predicts the poses of candidate motions (N, 5).

    ``current`` (3,) is the present velocity in base_link. A holonomic base keeps its direction in the map while it
    turns, because each scan leads to a new command; a differential base drives arcs.

    Returns poses (N, T, 3) in the present base_link, their times (T,) s, and the times (N,) s after which the robot
    stands, apart from a turn on the spot.
    """
    times = np.arange(0, HOLD_S + max_braking_time(robot), STEP_S) + STEP_S / 2  # middles of the steps
    velocity = _velocities(current, motions, times, robot)
    return _integrate(velocity, robot), times + STEP_S / 2, _standing_times(current, motions, robot)


def _velocities(current: Array, motions: Array, times: Array, robot: Robot) -> Array:
    """Velocities (N, T, 3) of motions (N, 5) at ``times`` (T,) s: accelerated, held, then braked."""
    actions, hold, turn_hold = motions[:, :3], motions[:, 3], motions[:, 4]
    accelerating = np.minimum(times, hold[:, None])  # (N, T) s until then
    turning = np.minimum(times, turn_hold[:, None])
    change = actions - current
    share = np.minimum(1.0, robot.acceleration * accelerating / _speed_or_tiny(change)[:, None])  # of the change
    max_turn_change = robot.turn_acceleration * turning
    velocity = np.empty((len(actions), len(times), 3))
    velocity[..., :2] = current[:2] + change[:, None, :2] * share[..., None]
    velocity[..., 2] = current[2] + np.clip(change[:, None, 2], -max_turn_change, max_turn_change)
    # Then braking.
    share_left = np.maximum(0.0, 1 - robot.acceleration * (times - accelerating) / _speed_or_tiny(velocity))
    velocity[..., :2] *= share_left[..., None]
    turn_left = np.abs(velocity[..., 2]) - robot.turn_acceleration * (times - turning)
    if robot.drive == "differential":  # it brakes on its arc, if it can brake its turn as fast
        on_arc = np.abs(velocity[..., 2]) * share_left * (turn_hold >= hold)[:, None]
        turn_left = np.maximum(turn_left, on_arc)
    velocity[..., 2] = np.sign(velocity[..., 2]) * np.maximum(0.0, turn_left)
    return velocity


def _integrate(velocity: Array, robot: Robot) -> Array:
    """Poses (N, T, 3) after each step with the ``velocity`` (N, T, 3)."""
    yaw = np.cumsum(velocity[..., 2], axis=1) * STEP_S
    linear_velocity = velocity[..., :2]
    if robot.drive == "differential":
        yaw_at_middle = yaw - velocity[..., 2] * STEP_S / 2
        cos, sin = np.cos(yaw_at_middle), np.sin(yaw_at_middle)
        vx, vy = velocity[..., 0], velocity[..., 1]
        linear_velocity = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1)
    return np.concatenate([np.cumsum(linear_velocity, axis=1) * STEP_S, yaw[..., None]], axis=-1)


def _standing_times(current: Array, motions: Array, robot: Robot) -> Array:
    """Times (N,) s after which the robot stands, apart from a turn on the spot."""
    hold, change = motions[:, 3], motions[:, :3] - current
    share = np.minimum(1.0, robot.acceleration * hold[:, None] / _speed_or_tiny(change)[:, None])
    top_speed = np.hypot(*(current[:2] + change[:, :2] * share).T)
    return np.asarray(hold + top_speed / robot.acceleration)


def _speed_or_tiny(velocity: Array) -> Array:
    """Speeds (...,) m/s of velocities (..., 3), at least 1e-12, so that one can divide by them."""
    return np.asarray(np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), 1e-12))


def is_moving(velocity: Array) -> bool:
    """Whether a velocity (3,) is more than `STANDING_SPEED`."""
    return float(np.hypot(velocity[0], velocity[1])) + abs(float(velocity[2])) > STANDING_SPEED


def max_braking_time(robot: Robot) -> float:
    """Seconds until the robot stands, from its maximum speed and turn rate."""
    return max(robot.max_speed / robot.acceleration, robot.max_turn / robot.turn_acceleration)


def stopping_distance(robot: Robot) -> float:
    """Distance in m that a motion at maximum speed covers until the robot stands."""
    return robot.max_speed * HOLD_S + robot.max_speed**2 / (2 * robot.acceleration)


def braking_speed(distance: float, robot: Robot, hold: float = HOLD_S) -> float:
    """Speed in m/s that, held for ``hold`` s and then braked, covers ``distance`` m: v hold + v^2 / 2a = distance."""
    a = robot.acceleration
    return min(robot.max_speed, float(a * (np.sqrt(hold**2 + 2 * max(distance, 0.0) / a) - hold)))


def stopping_action(current: Array, target: Array, robot: Robot, hold: float) -> Array | None:
    """Action (3,) that, held for ``hold`` s and then braked, ends at a target (2,) m in base_link.

    ``current`` (3,) is the present velocity. Returns None if it is too early to brake even for an action held for
    `HOLD_S`, or if the target lies beside or behind a differential base.
    """
    bearing, distance = float(np.arctan2(target[1], target[0])), float(np.hypot(*target))
    if braking_speed(distance, robot) >= robot.max_speed:
        return None
    # In the first step the speed changes from the present one: (current + v) STEP_S / 2 + v (hold - STEP_S) + v^2 / 2a.
    speed = braking_speed(distance - float(np.hypot(current[0], current[1])) * STEP_S / 2, robot, hold - STEP_S / 2)
    if robot.drive == "holonomic":
        return np.array([speed * np.cos(bearing), speed * np.sin(bearing), 0.0])
    turn = 2 * speed * np.sin(bearing) / max(distance, 1e-9)
    return np.array([speed, 0.0, turn]) if np.cos(bearing) > 0 and abs(turn) <= robot.max_turn else None


def turn_rate(angle: float, robot: Robot, hold: float = STEP_S) -> float:
    """Turn rate in rad/s that, held for ``hold`` s and then braked, ends at a heading ``angle`` rad away."""
    rate = robot.turn_acceleration * (np.sqrt(hold**2 + 2 * abs(angle) / robot.turn_acceleration) - hold)
    return float(np.sign(angle) * min(robot.max_turn, rate))


def turn_rate_while_moving(
    lookahead: Array, speed: Array | float, robot: Robot, forward: float = 0.0, hold: float = HOLD_S
) -> Array:
    """Turn rates (...,) rad/s of a holonomic base that moves at ``speed`` (...,) m/s.

    The side at bearing ``forward`` rad in base_link is turned towards the lookahead point (2,) m, unless that is near
    and lies ahead. Held for ``hold`` s and then braked, the turn ends there. A fast base turns slowly, because its
    velocity in base_link must rotate back to stay constant in map, which takes acceleration.
    """
    bearing = float(se2.wrap(np.arctan2(lookahead[1], lookahead[0]) - forward))
    if np.hypot(*lookahead) < NEAR_LOOKAHEAD_M and abs(bearing) < np.pi / 3:
        return np.zeros(np.shape(speed))
    max_turn = TURN_ACCELERATION_SHARE * robot.acceleration / np.maximum(speed, 1e-3)
    return np.asarray(np.clip(turn_rate(bearing, robot, hold), -max_turn, max_turn))


def turn_to_lookahead(
    current: Array,
    action: Array,
    lookahead: Array,
    robot: Robot,
    *,
    may_turn: bool,
    forward: float = 0.0,
    period: float = STEP_S,
) -> Array:
    """Adds a turn to the action (3,) of a holonomic base, so that the scanner faces the direction of motion.

    The turn is `turn_rate_while_moving`. ``current`` (3,) is the present velocity, and ``period`` s the time until the
    next command. Returns the action unchanged for a differential base, and if ``may_turn`` is False.
    """
    if robot.drive != "holonomic" or not may_turn:
        return np.array(action)
    brakes = not action.any()
    speed = float(np.hypot(*(current if brakes else action)[:2]))
    turn = float(turn_rate_while_moving(lookahead, speed, robot, forward, period))
    if not brakes:
        return np.array([*se2.rotate(-turn * period / 2, action[:2]), turn])
    # Braking alone would take all the acceleration, and the base would drift off the line on which it is to stop. In a
    # period it gets only 1 / `steps` of the way to the action, so the action turns the velocity back `steps` times.
    max_change = robot.turn_acceleration * period
    turned = (current[2] + float(np.clip(turn - current[2], -max_change, max_change))) * period
    kept = se2.rotate(-turned, current[:2])
    steps = max(1.0, speed / (robot.acceleration * period))
    return np.array([*(current[:2] + steps * (kept - current[:2]) - kept), turn])


def candidate_motions(current: Array, lookahead: Array, robot: Robot) -> Array:
    """Motions (N, 5) to choose from: braking, the current action, and a fan around the lookahead point.

    The lookahead point (2,) m is in base_link. One of the speeds is that with which the robot stops there. The last
    motions hold a higher speed for less time. A differential base may also turn until the lookahead point lies ahead,
    and drive straight from then on.
    """
    bearing, distance = float(np.arctan2(lookahead[1], lookahead[0])), float(np.hypot(*lookahead))
    speeds = np.unique([*(robot.max_speed * np.array([0.08, 0.2, 0.4, 0.7, 1.0])), braking_speed(distance, robot)])
    fan = _holonomic_fan(speeds, bearing) if robot.drive == "holonomic" else _arcs(speeds, bearing, distance, robot)
    others = np.concatenate([current[None], fan])
    others = others[others.any(axis=1)]  # standing is the same as braking
    held = np.pad(np.concatenate([np.zeros((1, 3)), others]), ((0, 0), (0, 2)), constant_values=HOLD_S)
    stopping = [(stopping_action(current, lookahead, robot, hold), hold) for hold in SHORT_HOLDS_S]
    motions = [[*action, hold, hold] for action, hold in stopping if action is not None]
    if robot.drive == "differential":
        rates = [(turn_rate(bearing, robot, hold), hold) for hold in SHORT_HOLDS_S]
        motions += [[v, 0.0, rate, HOLD_S, hold] for rate, hold in rates for v in [0.0, *speeds]]
    return np.concatenate([held, np.reshape(motions, (-1, 5))])


def _holonomic_fan(speeds: Array, bearing: float) -> Array:
    """Actions (N, 3) of a holonomic base in directions around ``bearing`` rad, and in the opposite one."""
    fan = np.deg2rad([0, 8, 17, 28, 42, 60, 85, 115])
    directions = bearing + np.concatenate([fan, -fan[1:], [np.pi]])
    v, d = (each.ravel() for each in np.meshgrid(speeds, directions))
    return np.stack([v * np.cos(d), v * np.sin(d), np.zeros_like(v)], axis=-1)


def _arcs(speeds: Array, bearing: float, distance: float, robot: Robot) -> Array:
    """Actions (N, 3) of a differential base: arcs to both sides, and those to a place in base_link."""
    turns = robot.max_turn * np.array([0, 0.06, 0.14, 0.25, 0.45, 0.7, 1.0])
    v, w = (each.ravel() for each in np.meshgrid([0.0, *speeds], np.concatenate([turns, -turns[1:]])))
    to_place = np.clip(2 * speeds * np.sin(bearing) / max(distance, 0.1), -robot.max_turn, robot.max_turn)
    v, w = np.concatenate([v, speeds]), np.concatenate([w, to_place])
    return np.stack([v, np.zeros_like(v), w], axis=-1)


def refined_motions(motion: Array, robot: Robot) -> Array:
    """Motions (N, 5) near a ``motion`` (5,): slightly faster or slower, and in slightly other directions."""
    factor, turn = (each.ravel() for each in np.meshgrid([0.85, 0.93, 1.0, 1.07, 1.15], np.linspace(-1, 1, 7)))
    changed = (factor != 1) | (turn != 0)
    factor, turn = factor[changed], turn[changed]
    actions = factor[:, None] * motion[:3]
    if robot.drive == "holonomic":
        actions[:, :2] = se2.rotate(np.deg2rad(4) * turn, actions[:, :2])
    else:
        actions[:, 2] += 0.05 * robot.max_turn * turn
    speed = np.hypot(actions[:, 0], actions[:, 1])
    actions[:, :2] *= np.minimum(1.0, robot.max_speed / np.maximum(speed, 1e-9))[:, None]
    actions[:, 2] = np.clip(actions[:, 2], -robot.max_turn, robot.max_turn)
    return np.column_stack([actions, np.broadcast_to(motion[3:], (len(actions), 2))])
