"""Predicts the motion since the last scan, and fuses it with the scan.

The prior is a mixture of motions, here called candidates:

- With odometry: dead reckoning with its noise.
- Without odometry, and with a small probability also with it, as wheels spin or are blocked: the robot stands still, or
  it keeps its velocity (or follows the velocity command), but for its acceleration.
- Always, with a small probability: any motion, with that at full speed as its standard deviation. If nothing tells
  whether the robot moves, standing and moving are equally probable.

The evidence of the scan selects the candidate. So the scans of a standing robot are averaged, and the belief of a
moving robot does not lag.

Slipping wheels lose a fraction of every motion, on each axis, so the errors of odometry are alike from scan to scan:
their deviations add, not their variances. These scale errors of odometry are therefore part of the filter's state. They
are not estimated, but their covariance with the pose is kept (Schmidt-Kalman filter). Scans that observe the pose
reduce it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.gauss_newton import MAX_STEP, limit_steps

if TYPE_CHECKING:
    from common.geometry.se2 import Array


SMOOTHING_TIME_S = 1 / 15  # the velocity is averaged over at least this time, however high the scan rate is
MAX_MOTION_SIGMAS = 3.0  # standard deviations (a common bound): motion beyond is hardly attributed to the robot
MAX_EXTRA_STEP = 5 * MAX_STEP  # m, m, rad beyond `MAX_MOTION_SIGMAS`: the reach of the last steps of a descent


@dataclass(frozen=True)
class MotionNoise:
    """Noise of the motion model for each axis of base_link; standard deviations unless stated otherwise."""

    period: float = 1 / 15  # s between scans, used if they have no stamps
    acceleration: float = 1.0  # m/s²
    turn_acceleration: float = 3.0  # rad/s²
    speed: float = 1.0  # m/s, the full speed
    turn: float = 2.0  # rad/s, the full turn rate
    turn_by_turn: float = 1e-3  # variance of odometry, rad² per radian turned (Thrun et al. 2005, table 5.6)
    turn_by_path: float = 5e-4  # rad² per metre travelled
    path_by_path: float = 1e-3  # m² per metre travelled
    path_by_turn: float = 1e-4  # m² per radian turned
    slip: float = 0.05  # scale error of odometry on each axis, the same for all motions (a guess)
    command_share: float = 0.2  # error of the commanded velocity, as a fraction of it
    standing: float = 1e-4  # m and rad per scan: motion of a robot that stands still
    unexpected: float = 0.02  # probability (a guess) that odometry is wrong, and of a motion that nothing foretells

    @property
    def full_speed(self) -> Array:
        """Full speed (3,) on each axis: m/s, m/s, rad/s."""
        return np.array([self.speed, self.speed, self.turn])

    @classmethod
    def of_robot(cls, speed: float, turn: float, acceleration: float, turn_acceleration: float) -> MotionNoise:
        """The noise for a robot with these limits.

        For lower limits it is the default, because the robot may also be pushed, or driven by another program.
        """
        return cls(
            acceleration=max(cls.acceleration, acceleration),
            turn_acceleration=max(cls.turn_acceleration, turn_acceleration),
            speed=max(cls.speed, speed),
            turn=max(cls.turn, turn),
        )


@dataclass(frozen=True)
class MotionCandidate:
    """One way the robot may have moved, as a Gaussian over its present pose."""

    mean: Array  # (3,)
    covariance: Array  # (3, 3) in map
    probability: float
    # (3, 3) of the pose with the scale errors of odometry, which are in units of their standard deviation
    pose_slip_cross_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def squared_distance(self, pose: Array) -> float:
        """Squared Mahalanobis distance of ``pose`` (3,) from the mean."""
        off = se2.difference(pose, self.mean)
        return float(off @ np.linalg.solve(self.covariance, off))

    def is_near(self, pose: Array) -> bool:
        """Whether ``pose`` (3,) is within `MAX_MOTION_SIGMAS` of the mean."""
        return self.squared_distance(pose) <= MAX_MOTION_SIGMAS**2

    def is_expected(self, noise: MotionNoise) -> bool:
        """Whether it is more probable than a motion that nothing foretells."""
        return self.probability > noise.unexpected


def predict_motion(
    noise: MotionNoise,
    pose: Array,
    covariance: Array,
    period: float,
    odom: Array | None = None,
    command: Array | None = None,
    velocity: Array | None = None,
    pose_slip_cross_covariance: Array | None = None,
) -> list[MotionCandidate]:
    """Returns the candidates after ``period`` s, from the last posterior (3,), (3, 3); the last one is the widest.

    ``pose_slip_cross_covariance`` (3, 3) is that of the posterior, 0 by default. ``odom`` (3,) is the motion since then
    in base_link. ``command`` and ``velocity`` (3,) are in m/s, m/s, rad/s in base_link; a command takes precedence over
    the velocity.
    """
    full_speed = noise.full_speed * period
    before = MotionCandidate(
        pose, covariance, 1.0, np.zeros((3, 3)) if pose_slip_cross_covariance is None else pose_slip_cross_covariance
    )
    likely = 1 - noise.unexpected
    # Of each motion that odometry does not give
    probability_of_others = likely if odom is None else likely * noise.unexpected
    any_motion = noise.unexpected
    if command is not None or velocity is not None:
        probability_of_others /= 2
    elif odom is None:
        probability_of_others = any_motion = 0.5  # nothing tells whether the robot stands
    candidates = [_propagate(before, np.zeros(3), np.full(3, noise.standing), probability_of_others)]  # standing still
    acceleration = np.array([noise.acceleration, noise.acceleration, noise.turn_acceleration])
    change = acceleration * period * max(period, SMOOTHING_TIME_S)
    if command is not None:
        change = change + noise.command_share * np.abs(command) * period
        candidates.append(_propagate(before, command * period, change, probability_of_others))
    elif velocity is not None:
        motion = limit_steps(velocity * period, MAX_MOTION_SIGMAS * full_speed)
        deviation = np.sqrt(change**2 + _velocity_variance(pose, covariance, period))
        candidates.append(_propagate(before, motion, deviation, probability_of_others))
    if odom is not None:
        moved, turned = float(np.hypot(odom[0], odom[1])), abs(float(odom[2]))
        position = np.sqrt(noise.path_by_path * moved + noise.path_by_turn * turned) + noise.standing
        heading = np.sqrt(noise.turn_by_turn * turned + noise.turn_by_path * moved) + noise.standing
        without_slip = _propagate(before, odom, np.array([position, position, heading]), likely**2)
        candidates.append(_add_slip(without_slip, noise.slip * odom, float(pose[2])))
    centre = np.zeros(3) if odom is None else odom
    candidates.append(_propagate(before, centre, full_speed + np.abs(centre), any_motion))  # any motion
    return candidates


def expected_motion(candidates: list[MotionCandidate]) -> MotionCandidate:
    """The most specific of the candidates: by odometry, else the command, else the last velocity, else standing still.

    It comes last but one, before any possible motion. A match with the local map is the only candidate.
    """
    return candidates[-2] if len(candidates) > 1 else candidates[0]


def motion_cost(noise: MotionNoise, candidates: list[MotionCandidate], pose: Array, covariance: Array) -> float:
    """How much less probable a motion to ``pose`` (3,), known with ``covariance`` (3, 3), is than expected, in nats.

    It is 0 within `MAX_MOTION_SIGMAS` of an expected motion. Elsewhere, it is the smallest cost of a candidate: by how
    much its largest log density is below that of an expected motion, plus (z² - `MAX_MOTION_SIGMAS`²) / 2, if that is
    positive, with the Mahalanobis distance z of the pose from its mean.
    """
    peaks, excess = _peaks_and_excess(candidates, pose, covariance)
    expected = min(peak for peak, each in zip(peaks, candidates, strict=True) if each.is_expected(noise))
    return float((np.maximum(0.0, expected - peaks) + excess).min())


def motion_complexity(candidates: list[MotionCandidate], pose: Array, covariance: Array) -> float:
    """How much more certain ``pose`` (3,), with ``covariance`` (3, 3), is than its prediction, in nats.

    It is minus the logarithm of the probability that the candidate which fits best gave to this pose and those that its
    covariance leaves, plus the excess of `motion_cost` for a pose that is too far from it.
    """
    peaks, excess = _peaks_and_excess(candidates, pose, covariance)
    return float((excess - peaks).min() - 0.5 * np.linalg.slogdet(covariance)[1])


def _peaks_and_excess(candidates: list[MotionCandidate], pose: Array, covariance: Array) -> tuple[Array, Array]:
    """For each candidate, with ``covariance`` (3, 3) added to its own, two numbers in nats.

    The logarithm of its peak, with its probability but without the constant of the normal distribution; and
    (z² - `MAX_MOTION_SIGMAS`²) / 2, if that is positive, with the Mahalanobis distance z of ``pose`` from its mean.
    """
    widened = [replace(each, covariance=each.covariance + covariance) for each in candidates]
    peaks = [np.log(each.probability) - 0.5 * np.linalg.slogdet(each.covariance)[1] for each in widened]
    squares = np.array([each.squared_distance(pose) for each in widened])
    return np.array(peaks), 0.5 * np.maximum(0.0, squares - MAX_MOTION_SIGMAS**2)


def smooth_velocity(previous: Array | None, current: Array, period: float) -> Array:
    """Averages the velocity (3,) exponentially over at least `SMOOTHING_TIME_S`.

    ``current`` is the velocity between the last two poses, ``period`` s apart, ``previous`` the average before.
    """
    weight = period / SMOOTHING_TIME_S
    return current if previous is None or weight >= 1 else previous + weight * (current - previous)


def _velocity_variance(pose: Array, covariance: Array, period: float) -> Array:
    """Variances (3,) in base_link of the predicted motion, because the velocity was derived from uncertain poses.

    With p the pose, q the one before and g the weight of p - q in the velocity, p + g (p - q) has (1 + 2 g + 2 g²)
    times the variance of p. With a slow scanner this is little compared with the possible acceleration.
    """
    weight = min(1.0, period / SMOOTHING_TIME_S)
    turn = se2.rotation(-float(pose[2]))
    return np.asarray(2 * weight * (1 + weight) * np.diagonal(turn @ covariance @ turn.T))


def _propagate(before: MotionCandidate, step: Array, deviation: Array, probability: float) -> MotionCandidate:
    pose_jacobian, step_jacobian = se2.compose_jacobians(before.mean, step)
    covariance = pose_jacobian @ before.covariance @ pose_jacobian.T + (step_jacobian * deviation**2) @ step_jacobian.T
    return MotionCandidate(
        se2.compose(before.mean, step), covariance, probability, pose_jacobian @ before.pose_slip_cross_covariance
    )


def _add_slip(candidate: MotionCandidate, lost: Array, yaw: float) -> MotionCandidate:
    """Adds the motion (3,) in base_link that slipping may have ``lost``, one standard deviation, at heading ``yaw``."""
    growth = se2.rotation(yaw) * lost
    cross = growth @ candidate.pose_slip_cross_covariance.T
    covariance = candidate.covariance + cross + cross.T + growth @ growth.T
    return replace(
        candidate, covariance=covariance, pose_slip_cross_covariance=candidate.pose_slip_cross_covariance + growth
    )


def widen_unobserved(
    noise: MotionNoise, candidate: MotionCandidate, directions: Array, scans: int, period: float
) -> MotionCandidate:
    """Adds the motion at full speed along ``directions`` (K, 3), which the last ``scans`` scans did not observe.

    The directions are unit vectors of x, y, yaw. The standard deviation grows in proportion to the number n of scans:
    (n + 1)² - n² = 2 n + 1.
    """
    motion = directions.T @ directions * noise.full_speed * period
    return replace(candidate, covariance=candidate.covariance + (2 * scans + 1) * motion @ motion.T)


def decouple(candidate: MotionCandidate, directions: Array) -> MotionCandidate:
    """Removes the correlation of the position along ``directions`` (K, 3) with the rest of the pose.

    Errors of the map tilt these unobserved unit vectors, differently in each scan. With the correlation, the difference
    between two tilts would pass for information along them.
    """
    along = directions.T @ directions
    across = np.eye(3) - along
    return replace(candidate, covariance=along @ candidate.covariance @ along + across @ candidate.covariance @ across)


def limit_covariance(candidate: MotionCandidate, unknown: Array) -> MotionCandidate:
    """Limits the variances to those of a completely unknown pose, ``unknown`` (3, 3)."""
    excess = np.sqrt(np.diag(candidate.covariance) / np.diag(unknown))
    if (excess <= 1).all():
        return candidate
    scale = 1 / np.maximum(excess, 1.0)
    covariance = candidate.covariance * np.outer(scale, scale)
    return replace(
        candidate,
        covariance=covariance,
        pose_slip_cross_covariance=candidate.pose_slip_cross_covariance * scale[:, None],
    )


def reachable_poses(noise: MotionNoise, pose: Array, period: float, basin: float) -> Array:
    """Further starts (K, 3) of a descent without odometry: at 0, half and full speed forwards, with five turn rates.

    There are none if the robot cannot leave the basin of attraction of one descent, ``basin`` m or rad.
    """
    if noise.speed * period < basin and noise.turn * period < basin:
        return np.zeros((0, 3))
    ahead, turned = np.meshgrid(np.array([0.0, 0.5, 1.0]) * noise.speed, np.linspace(-1, 1, 5) * noise.turn)
    steps = np.stack([ahead.ravel(), np.zeros(ahead.size), turned.ravel()], axis=-1) * period
    return se2.compose(pose, steps)


@dataclass(frozen=True)
class FusedMotion:
    """A candidate updated by a scan."""

    candidate: MotionCandidate
    mean: Array  # (3,)
    information: Array  # (3, 3) H + P^-1
    complexity: float  # nats, Kullback-Leibler divergence of the posterior from the prior
    negative_log_evidence: float  # nats, with that of the candidate's prior probability; without the scan's constant


def fuse(candidate: MotionCandidate, pose: Array, xi: Array, curvature: Array) -> FusedMotion:
    """Updates a candidate by Laplace's approximation of the scan's likelihood.

    The scan's -ln p is expanded to second order at ``pose`` (3,): ``xi`` (3,), per m and rad, is minus its gradient
    there, and ``curvature`` (3, 3) its Hessian.

    Along a direction without curvature this is a straight line, and with a wide prior the minimum may be kilometres
    away. The step is therefore limited to a trust region: `MAX_STEP` beyond ``pose``, and `MAX_EXTRA_STEP` beyond what
    the candidate's covariance makes plausible.
    """
    information = np.linalg.inv(candidate.covariance)
    total = curvature + information
    off = se2.difference(pose, candidate.mean)
    pull = xi + curvature @ off  # minus the gradient at the candidate's mean
    step = np.linalg.solve(total, pull)
    regularised = curvature + 1e-9 * np.trace(curvature) * np.eye(3) + 1e-9 * np.eye(3)
    misfit = float(pull @ np.linalg.solve(regularised, pull) - pull @ step)
    logdet = float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(information)[1])
    negative_log_evidence = 0.5 * misfit + 0.5 * logdet - np.log(candidate.probability)
    plausible = MAX_MOTION_SIGMAS * np.sqrt(np.diag(candidate.covariance))
    step = limit_steps(step, np.minimum(np.abs(off) + MAX_STEP, plausible + MAX_EXTRA_STEP))
    posterior = np.linalg.inv(total)
    kl = 0.5 * (float(np.trace(information @ posterior)) - 3 + float(step @ information @ step) + logdet)
    mean = candidate.mean + step
    mean[2] = se2.wrap(mean[2])
    return FusedMotion(candidate, mean, total, kl, float(negative_log_evidence))
