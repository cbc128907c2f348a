"""Motion models: odometry (Thrun et al. 2005, chapter 5.4), command, random walk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Alphas = tuple[float, float, float, float, float]

MIN_PATH_M = 0.01  # for shorter steps the direction of travel is noise


def omni(poses: Array, step: Array, alphas: Alphas, rng: np.random.Generator) -> Array:
    """Moves poses (N, 3) by an odometry ``step`` (3,) in base_link with noise: nav2's OmniMotionModel.

    With path p and turn t the variances are alpha3 p² + alpha1 t² along the path, alpha1 t² + alpha5 p² sideways, and
    alpha4 t² + alpha2 p² in heading.
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
    """Moves poses (N, 3) by an odometry ``step`` (3,) in base_link with noise: nav2's DifferentialMotionModel.

    A step is a turn, a straight path and another turn. nav2 takes every path shorter than a centimetre as forward. Here
    steps are often that short, so the path keeps its sign.
    """
    a1, a2, a3, a4, _ = alphas
    path, first = float(np.hypot(step[0], step[1])), float(np.arctan2(step[1], step[0]))
    if path < MIN_PATH_M:
        path, first = float(step[0]), 0.0
    second = float(se2.wrap(step[2] - first))
    # A turn by about pi means driving backwards, and gets the noise of a small turn.
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
    """Motion (3,) in base_link caused by a constant velocity ``command`` (3,), m/s, m/s, rad/s, in ``dt`` s."""
    vx, vy, w = (float(v) for v in command)
    turn = w * dt
    # sin(t)/t and (1 - cos t)/t, from numpy's sinc, which has the right limits at 0.
    straight, bent = float(np.sinc(turn / np.pi)), turn / 2 * float(np.sinc(turn / (2 * np.pi))) ** 2
    return np.array([dt * (vx * straight - vy * bent), dt * (vx * bent + vy * straight), turn])


def jitter(poses: Array, position: Array | float, heading: Array | float, rng: np.random.Generator) -> Array:
    """Adds Gaussian noise to poses (N, 3).

    The standard deviations are ``position`` m in x and in y, and ``heading`` rad, for all poses or for each (N,).
    """
    spread = np.broadcast_arrays(position, position, heading)
    return np.asarray(poses + np.stack(spread, axis=-1) * rng.standard_normal((len(poses), 3)))
