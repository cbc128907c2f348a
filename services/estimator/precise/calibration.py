"""What real scans say of the density's parameters, of how a robot moves, and of the pose's stated precision.

From posed scans that the field has not learned from: the reference poses' own error counts as the model's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from common import se2
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion import MotionNoise

if TYPE_CHECKING:
    from common.se2 import Array
    from services.estimator.generative import Expected

EM_STEPS = 30
SEEN_BEFORE = 10.0  # beams: as if so many of every kind had been seen besides
LEAST_SIGMA = 0.003  # m


def noise_of(ranges: Array) -> float:
    """M, the scanner's noise from its scans (N, B) alone: second differences along a smooth surface vanish but for it.

    Median absolute deviation: where a beam meets another surface than its neighbours they do not.
    """
    finite = np.where(np.isfinite(ranges), ranges, np.nan)
    bend = finite[:, 2:] - 2 * finite[:, 1:-1] + finite[:, :-2]
    return max(LEAST_SIGMA, float(1.4826 * np.nanmedian(np.abs(bend)) / np.sqrt(6)))


def learn_shares(measured: Array, expected: Expected, range_max: float, start: Likelihood) -> Likelihood:
    """The shares that make scans (N, B) most likely, by expectation maximisation; sigma stays ``start``'s."""
    surface = (expected.ranges < range_max) & np.isfinite(expected.scale) & ~np.isnan(measured) & (measured > -np.inf)
    hit = surface & np.isfinite(measured)
    o, g, m = measured[hit], np.maximum(expected.ranges[hit], 1e-3), expected.scale[hit]
    variance = start.sigma**2 + m**2
    core = np.exp(-0.5 * (o - g) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
    early, flat = (o < g) / g, np.full(len(o), 1 / range_max)
    short, random = start.short, start.random
    for _ in range(EM_STEPS):
        parts = np.stack([(1 - short - random) * core, short * early, random * flat])
        counts = (parts / parts.sum(axis=0)).sum(axis=1) + SEEN_BEFORE
        short, random = (float(x) for x in counts[1:] / counts.sum())
    none = float((np.isposinf(measured) & surface).sum())
    unseen = (none + SEEN_BEFORE) / (float(surface.sum()) + 2 * SEEN_BEFORE)
    return replace(start, short=short, random=random, unseen=unseen)


def learn_motion(stamps: Array, poses: Array, odom: Array | None) -> MotionNoise:
    """How the robot moved, from reference poses (N, 3) of consecutive scans at ``stamps`` (N,) s."""
    period = np.diff(stamps)
    steps = se2.between(poses[:-1], poses[1:])
    good = (period > 0) & (period < 3 * np.median(period))
    usual = float(np.median(period[good]))
    both = good[1:] & good[:-1]
    velocity = steps / np.maximum(period, 1e-6)[:, None]
    change = steps[1:] - velocity[:-1] * period[1:, None]
    change[:, 2] = se2.wrap(change[:, 2])
    change = np.abs(change[both]) / usual**2
    pace = np.hypot(velocity[good, 0], velocity[good, 1])

    def deviation(values: Array) -> float:
        return float(np.quantile(values, 0.9) / 1.645)

    learned = MotionNoise(
        period=usual,
        acceleration=deviation(change[:, :2].max(axis=1)),
        turn_acceleration=deviation(change[:, 2]),
        speed=float(np.quantile(pace, 0.99)),
        turn=float(np.quantile(np.abs(velocity[good, 2]), 0.99)),
    )
    return learned if odom is None else _odometry(learned, steps[good], se2.between(odom[:-1], odom[1:])[good])


def _odometry(noise: MotionNoise, steps: Array, told: Array) -> MotionNoise:
    """Its variances a metre and a radian: least squares of the squared errors, the worst hundredth cut off."""
    off = se2.between(told, steps)
    by = np.column_stack([np.hypot(told[:, 0], told[:, 1]), np.abs(told[:, 2])])
    across = np.mean(off[:, :2] ** 2, axis=1)
    around = off[:, 2] ** 2
    (path_by_path, path_by_turn), (turn_by_path, turn_by_turn) = (
        _not_negative(by, np.minimum(square, np.quantile(square, 0.99))) for square in (across, around)
    )
    return replace(
        noise, path_by_path=path_by_path, path_by_turn=path_by_turn, turn_by_path=turn_by_path,
        turn_by_turn=turn_by_turn,
    )  # fmt: skip


def _not_negative(by: Array, square: Array) -> tuple[float, float]:
    found, *_ = np.linalg.lstsq(by, square, rcond=None)
    if found.min() < 0:  # one of the two alone
        k = int(found.argmax())
        found = np.zeros(2)
        found[k] = max(0.0, float(by[:, k] @ square / (by[:, k] @ by[:, k])))
    return float(found[0]) + 1e-6, float(found[1]) + 1e-6
