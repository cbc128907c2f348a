"""Motion models: odometry (Thrun et al. 2005, chapter 5.4), command, random walk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Alphas = tuple[float, float, float, float, float]

TURN_IN_PLACE = 0.01  # m, below it the direction of travel is noise


def omni(poses: Array, step: Array, alphas: Alphas, rng: np.random.Generator) -> Array:
    """Poses (N, 3) after the odometry moved by ``step`` (3,) in base_link: nav2's OmniMotionModel.

    Variances, with path p and turn t: along alpha3 p² + alpha1 t², sideways alpha1 t² + alpha5 p², turn
    alpha4 t² + alpha2 p².
    """
    a1, a2, a3, a4, a5 = alphas
    path, turn = float(np.hypot(step[0], step[1])), float(step[2])
    deviation = np.sqrt([a3 * path**2 + a1 * turn**2, a1 * turn**2 + a5 * path**2, a4 * turn**2 + a2 * path**2])
    along, sideways, turned = (np.array([path, 0.0, turn]) + deviation * rng.standard_normal((len(poses), 3))).T
    bearing = poses[:, 2] + np.arctan2(step[1], step[0])
    cos, sin = np.cos(bearing), np.sin(bearing)
    return np.stack(
        [poses[:, 0] + along * cos + sideways * sin, poses[:, 1] + along * sin - sideways * cos, poses[:, 2] + turned],
        axis=-1,
    )


def differential(poses: Array, step: Array, alphas: Alphas, rng: np.random.Generator) -> Array:
    """Poses (N, 3) after the odometry moved by ``step`` (3,) in base_link: nav2's DifferentialMotionModel.

    A step is a turn, a straight path, a turn. Below a centimetre nav2 takes the path as forward; here a scan's step
    is often shorter than that, so it keeps its sign.
    """
    a1, a2, a3, a4, _ = alphas
    path, first = float(np.hypot(step[0], step[1])), float(np.arctan2(step[1], step[0]))
    if path < TURN_IN_PLACE:
        path, first = float(step[0]), 0.0
    second = float(se2.wrap(step[2] - first))
    # Driving backwards is no turn by pi.
    noisy1, noisy2 = (min(abs(turn), abs(float(se2.wrap(turn - np.pi)))) for turn in (first, second))
    deviation = np.sqrt(
        [
            a1 * noisy1**2 + a2 * path**2,
            a3 * path**2 + a4 * (noisy1**2 + noisy2**2),
            a1 * noisy2**2 + a2 * path**2,
        ]
    )
    turn1, moved, turn2 = (np.array([first, path, second]) + deviation * rng.standard_normal((len(poses), 3))).T
    bearing = poses[:, 2] + turn1
    return np.stack(
        [poses[:, 0] + moved * np.cos(bearing), poses[:, 1] + moved * np.sin(bearing), bearing + turn2], axis=-1
    )


def arc(command: Array, dt: float) -> Array:
    """(3,) motion in base_link by a velocity command (3,) m/s, m/s, rad/s held for ``dt`` s."""
    vx, vy, w = (float(v) for v in command)
    turn = w * dt
    # sin(t)/t and (1 - cos t)/t, by numpy's sinc that knows their limit at 0.
    straight, bent = float(np.sinc(turn / np.pi)), turn / 2 * float(np.sinc(turn / (2 * np.pi))) ** 2
    return np.array([dt * (vx * straight - vy * bent), dt * (vx * bent + vy * straight), turn])


def jitter(poses: Array, position: Array | float, heading: Array | float, rng: np.random.Generator) -> Array:
    """Poses (N, 3) moved by Gaussian noise: deviation ``position`` m in x and y, ``heading`` rad; one, or (N,)."""
    spread = np.broadcast_arrays(position, position, heading)
    return np.asarray(poses + np.stack(spread, axis=-1) * rng.standard_normal((len(poses), 3)))
