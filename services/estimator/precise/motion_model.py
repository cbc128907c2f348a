"""How the robot may have moved since the last scan, and fusion with the scan.

With odometry: dead reckoning with its noise. Without: the robot stands, or goes on as it did (or as it was commanded),
with what it can accelerate. Always, with small probability: any motion the robot is capable of. Which holds is decided
by evidence, so that a standing robot's scans are fused and a moving one's belief does not trail.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.gauss_newton import MAX_STEP, limited

if TYPE_CHECKING:
    from common.geometry.se2 import Array


SMOOTH = 1 / 15  # s, over which velocity is read off the poses at least, however fast scans come
PLAUSIBLE = 3.0  # standard deviations: motion beyond it is not taken for the robot's
FARTHEST = 5 * MAX_STEP  # m, m, rad beyond what is plausible: as far as the last steps of a descent go


@dataclass(frozen=True)
class MotionNoise:
    """Of each axis of base_link; standard deviations where not said otherwise."""

    period: float = 1 / 15  # s between scans, where stamps do not say
    acceleration: float = 1.0  # m/s²
    turn_acceleration: float = 3.0  # rad/s²
    speed: float = 1.0  # m/s
    turn: float = 2.0  # rad/s
    turn_by_turn: float = 1e-3  # odometry's variance, rad² a radian turned (Thrun et al. 2005, table 5.6)
    turn_by_path: float = 5e-4  # rad² a metre travelled
    path_by_path: float = 1e-3  # m² a metre
    path_by_turn: float = 1e-4  # m² a radian
    command_share: float = 0.2  # of the commanded velocity
    standing: float = 1e-4  # m and rad a scan: what a robot that stands may still move
    surprise: float = 0.02  # probability of any other motion


@dataclass(frozen=True)
class Candidate:
    """One way the robot may have moved: a Gaussian over where it is now."""

    name: str
    mean: Array  # (3,)
    covariance: Array  # (3, 3) in map
    probability: float

    def squared_distance(self, pose: Array) -> float:
        """Of ``pose`` (3,) from the mean, squared standard deviations (Mahalanobis)."""
        off = pose - self.mean
        off[2] = se2.wrap(off[2])
        return float(off @ np.linalg.solve(self.covariance, off))


def candidates(
    noise: MotionNoise,
    pose: Array,
    covariance: Array,
    period: float,
    odom: Array | None = None,
    command: Array | None = None,
    velocity: Array | None = None,
) -> list[Candidate]:
    """Priors for now from the last posterior (3,), (3, 3); the last one is the widest.

    ``odom`` (3,): motion since then in base_link; ``command`` and ``velocity`` (3,): m/s, m/s, rad/s in base_link.
    """
    reach = np.array([noise.speed, noise.speed, noise.turn]) * period
    rest = 1 - noise.surprise
    found = []
    if odom is not None:
        moved, turned = float(np.hypot(odom[0], odom[1])), abs(float(odom[2]))
        across = np.sqrt(noise.path_by_path * moved + noise.path_by_turn * turned) + noise.standing
        around = np.sqrt(noise.turn_by_turn * turned + noise.turn_by_path * moved) + noise.standing
        found.append(_moved("odometry", pose, covariance, odom, np.array([across, across, around]), rest))
    else:
        found.append(_moved("standing", pose, covariance, np.zeros(3), np.full(3, noise.standing), rest / 2))
        limits = np.array([noise.acceleration, noise.acceleration, noise.turn_acceleration])
        change = limits * period * max(period, SMOOTH)
        if command is not None:
            change = change + noise.command_share * np.abs(command) * period
            found.append(_moved("commanded", pose, covariance, command * period, change, rest / 2))
        elif velocity is not None:
            velocity = limited(velocity, PLAUSIBLE * np.array([noise.speed, noise.speed, noise.turn]))
            deviation = np.sqrt(change**2 + _read_off(pose, covariance, period))
            found.append(_moved("going on", pose, covariance, velocity * period, deviation, rest / 2))
    centre = odom if odom is not None else np.zeros(3)
    found.append(_moved("any motion", pose, covariance, centre, reach + np.abs(centre), noise.surprise))
    return found


def smoothed(before: Array | None, now: Array, period: float) -> Array:
    """(3,) velocity from that of the last two poses ``now`` and the one ``before``: over `SMOOTH` s at least."""
    share = period / SMOOTH
    return now if before is None or share >= 1 else before + share * (now - before)


def _read_off(pose: Array, covariance: Array, period: float) -> Array:
    """(3,) variances in base_link that going on adds, its velocity having been read off poses of ``covariance``.

    With p the pose, q the one before and g the share of p - q in the velocity, p + g (p - q) has (1 + 2 g + 2 g²) times
    the variance of p. With a slow scanner that is little beside what the robot can accelerate.
    """
    share = min(1.0, period / SMOOTH)
    axes = np.eye(3)
    axes[:2, :2] = se2.rotate(float(pose[2]), np.eye(2))
    return np.asarray(2 * share * (1 + share) * np.diagonal(axes @ covariance @ axes.T))


def _moved(name: str, pose: Array, covariance: Array, step: Array, deviation: Array, probability: float) -> Candidate:
    by_pose, by_step = se2.compose_jacobians(pose, step)
    spread = by_pose @ covariance @ by_pose.T + (by_step * deviation**2) @ by_step.T
    return Candidate(name, se2.compose(pose, step), spread, probability)


def unseen(noise: MotionNoise, option: Candidate, blind: Array, scans: int, period: float) -> Candidate:
    """Along a direction (2,) no scan sees, the robot may have gone at full speed: the deviation grows with time."""
    covariance = option.covariance.copy()
    covariance[:2, :2] += np.outer(blind, blind) * (noise.speed * period) ** 2 * (2 * scans + 1)
    return replace(option, covariance=covariance)


def within_map(option: Candidate, spread: Array) -> Candidate:
    """With no more variance of the position than ``spread`` (3, 3), that of a position of which nothing is known."""
    excess = np.sqrt(np.diag(option.covariance) / np.diag(spread))
    excess[2] = 1.0
    if (excess <= 1).all():
        return option
    scale = 1 / np.maximum(excess, 1.0)
    return replace(option, covariance=option.covariance * np.outer(scale, scale))


def within_reach(noise: MotionNoise, pose: Array, period: float, basin: float) -> Array:
    """(K, 3) poses to which a robot may have driven unseen; none where a descent reaches as far, ``basin`` m or rad."""
    if noise.speed * period < basin and noise.turn * period < basin:
        return np.zeros((0, 3))
    ahead, turned = np.meshgrid(np.array([0.0, 0.5, 1.0]) * noise.speed, np.linspace(-1, 1, 5) * noise.turn)
    steps = np.stack([ahead.ravel(), np.zeros(ahead.size), turned.ravel()], axis=-1) * period
    return se2.compose(pose, steps)


@dataclass(frozen=True)
class Fused:
    """A candidate updated by a scan."""

    candidate: Candidate
    mean: Array  # (3,)
    information: Array  # (3, 3) H + P^-1
    complexity: float  # nats, KL of the posterior from the prior
    surprise: float  # nats, -ln of prior probability times evidence, less the scan's constant


def fuse(candidate: Candidate, mode: Array, slope: Array, curvature: Array) -> Fused:
    """Laplace: the scan's -ln p is a parabola, ``slope`` (3,) minus its gradient at ``mode``, ``curvature`` its own.

    Along a direction without curvature the parabola is a straight line, whose minimum with a vague prior may be
    kilometres away. The step is therefore limited to a trust region: `MAX_STEP` beyond ``mode``, where the parabola was
    expanded, and `FARTHEST` beyond what the candidate's covariance makes plausible.
    """
    information = np.linalg.inv(candidate.covariance)
    total = curvature + information
    off = mode - candidate.mean
    off[2] = se2.wrap(off[2])
    # Minus the gradient of the parabola at the candidate's mean.
    pull = slope + curvature @ off
    step = np.linalg.solve(total, pull)
    sound = curvature + 1e-9 * np.trace(curvature) * np.eye(3) + 1e-9 * np.eye(3)
    misfit = float(pull @ np.linalg.solve(sound, pull) - pull @ step)
    logdet = float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(information)[1])
    evidence = 0.5 * misfit + 0.5 * logdet - np.log(candidate.probability)
    plausible = PLAUSIBLE * np.sqrt(np.diag(candidate.covariance))
    step = limited(step, np.minimum(np.abs(off) + MAX_STEP, plausible + FARTHEST))
    posterior = np.linalg.inv(total)
    kl = 0.5 * (float(np.trace(information @ posterior)) - 3 + float(step @ information @ step) + logdet)
    mean = candidate.mean + step
    mean[2] = se2.wrap(mean[2])
    return Fused(candidate, mean, total, kl, float(evidence))
