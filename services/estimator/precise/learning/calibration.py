"""Calibrates the density, the motion model and the covariance on real scans.

The scans have reference poses, and the field has not learned from them. The error of the reference poses counts as
error of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict

from common.errors import UserError
from common.geometry import se2
from services.estimator.precise.gauss_newton import polish
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.precise.noise import robust_excess
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.settings import PreciseSettings

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.shared.generative_models import Expected, GenerativeModel

EM_STEPS = 30  # of expectation maximisation
PRIOR_BEAMS = 10.0  # pseudo-count of each kind of beam
CHI2_MEDIAN = 2.366  # median of chi squared with three degrees of freedom
MAX_POSITION_ERROR_M = 0.3  # larger errors mean that another place was found; the covariance does not describe them
# Minimum fraction of explained beams, relative to the usual one; if 97 % are usual, this is the default.
MIN_EXPLAINED_RATIO = 0.77
# Probabilities at which the calibration curve is evaluated.
PROBABILITIES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)


@dataclass(frozen=True)
class Calibration:
    """Results from the held-out scans of a drive; `settings` derives the estimator's parameters from them."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="ignore")  # older model cards have more fields

    likelihood: Likelihood
    motion: MotionNoise
    scans: int  # held out
    usual: float  # fraction of a scan's beams that end at surfaces of the map: median over the scans
    inflation: float  # factor on the covariance
    floor_position: float  # m, remaining deviation in x and in y: error of the reference poses and of the map
    floor_heading: float  # rad
    log_likelihood: float  # nats per beam
    nees_median: float  # of poses found from one scan, with the covariance as published; ideal: 2.37
    nees_mean: float  # ideal: 3
    # pairs of a range's cumulative probability and the fraction of beams below
    coverage: tuple[tuple[float, float], ...]

    def settings(self) -> PreciseSettings:
        """Parameters of the estimator; the threshold of explained beams is relative to the usual fraction."""
        return PreciseSettings(
            min_explained_fraction=MIN_EXPLAINED_RATIO * self.usual,
            inflation=self.inflation,
            floor_position=self.floor_position,
            floor_heading=self.floor_heading,
            motion=self.motion,
        )


@dataclass(frozen=True)
class ReferenceDrive:
    """Scans with reference poses, in order of time."""

    stamps: Array  # (N,) s
    poses: Array  # (N, 3) base_link in map: the reference
    ranges: Array  # (N, B) m
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    odom: Array | None = None  # (N, 3)

    def part(self, which: npt.NDArray[np.integer | np.bool_]) -> ReferenceDrive:
        """Returns some of the scans."""
        return replace(
            self,
            stamps=self.stamps[which],
            poses=self.poses[which],
            ranges=self.ranges[which],
            odom=None if self.odom is None else self.odom[which],
        )


def calibrate(model: GenerativeModel, held_out: ReferenceDrive, motion: MotionNoise, sigma: float) -> Calibration:
    """Calibrates on scans from which ``model`` has not learned; ``sigma`` m is the scanner's noise."""
    lasers = se2.compose(held_out.poses, held_out.mount)
    expected = model.expect(lasers, held_out.angles)
    likelihood = learn_outlier_fractions(held_out.ranges, expected, held_out.range_max, Likelihood(sigma))
    likelihoods = [
        ScanLikelihood(model, likelihood, held_out.mount, held_out.angles, ranges, held_out.range_max)
        for ranges in held_out.ranges
    ]
    fitted = [polish(scan, pose[None]) for scan, pose in zip(likelihoods, held_out.poses, strict=True)]
    explained = [
        float(scan.surface_evidence(pose).explained[0]) for scan, (pose, _) in zip(likelihoods, fitted, strict=True)
    ]
    energy = sum(scan.evidence(pose[None]).accuracy[0] for scan, pose in zip(likelihoods, held_out.poses, strict=True))
    floor, inflation, nees = _pose_precision(fitted, held_out.poses)
    return Calibration(
        likelihood=likelihood,
        motion=motion,
        scans=len(held_out.ranges),
        usual=float(np.median(explained)),
        inflation=inflation,
        floor_position=floor[0],
        floor_heading=floor[1],
        log_likelihood=-float(energy) / max(1, int((held_out.ranges > -np.inf).sum())),
        nees_median=float(np.median(nees)),
        nees_mean=float(np.mean(nees)),
        coverage=_coverage(likelihood, held_out.ranges, expected, held_out.range_max),
    )


def _pose_precision(
    fitted: list[tuple[Array, Evidence]], references: Array
) -> tuple[tuple[float, float], float, Array]:
    """Returns the floors of position (m) and heading (rad), the inflation, and the NEES (N,) with both.

    Compares poses (1, 3) found from one scan each, and the evidence there, with the reference poses (N, 3). The floors
    come from robust deviations. The inflation is the one with which the median of the squared errors is right, so that
    a few poor reference poses do not decide. Raises UserError if the scans do not show the pose.
    """
    errors, covariances = [], []
    for reference, (found, evidence) in zip(references, fitted, strict=True):
        error = se2.difference(found[0], reference)
        if np.hypot(error[0], error[1]) < MAX_POSITION_ERROR_M:
            inverse = np.linalg.inv(evidence.curvature[0] + np.eye(3))
            errors.append(error + inverse @ evidence.xi[0])
            covariances.append(inverse @ (evidence.xi_noise_covariance[0] + evidence.xi_model_covariance[0]) @ inverse)
    if not errors:
        raise UserError(
            f"none of the {len(fitted)} held-out scans fits the model within {MAX_POSITION_ERROR_M:g} m of its "
            "reference pose: check the reference poses and the mount of the laser, and drive where walls are in range"
        )
    error, stated = np.array(errors), np.array(covariances)

    def excess_deviation(values: Array, variance: Array) -> float:
        return float(np.sqrt(max(0.0, robust_excess(values, variance))))

    position = excess_deviation(error[:, :2].ravel(), stated[:, [0, 1], [0, 1]].ravel())
    heading = excess_deviation(error[:, 2], stated[:, 2, 2])
    floor = np.diag([position**2, position**2, heading**2])

    def nees(inflation: float) -> Array:
        return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(inflation * stated + floor), error))

    low, high = 1.0, 1e4  # bisection for the inflation
    try:
        for _ in range(40):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if np.median(nees(middle)) > CHI2_MEDIAN else (low, middle)
        return (position, heading), high, nees(high)
    except np.linalg.LinAlgError:
        raise UserError(
            "some held-out scans show too few surfaces to find the pose: leave out the part of the drive where the "
            "scanner sees no walls, or drive nearer to walls in different directions"
        ) from None


def _coverage(
    likelihood: Likelihood, measured: Array, expected: Expected, range_max: float
) -> tuple[tuple[float, float], ...]:
    """Fraction of ranges below each quantile of the density, where a surface is expected; ideally the probability."""
    use = np.isfinite(measured) & np.isfinite(expected.scale) & (expected.ranges < range_max)
    below = likelihood.cumulative(measured[use], expected.ranges[use], expected.scale[use], range_max)
    return tuple((p, float((below <= p).mean())) for p in PROBABILITIES)


def learn_outlier_fractions(measured: Array, expected: Expected, range_max: float, start: Likelihood) -> Likelihood:
    """Fits the fractions of the density to scans (N, B) by expectation maximisation; sigma stays that of ``start``."""
    surface = (expected.ranges < range_max) & np.isfinite(expected.scale) & (measured > -np.inf)  # excludes NaN
    hit = surface & np.isfinite(measured)
    o, g, m = measured[hit], np.maximum(expected.ranges[hit], 1e-3), expected.scale[hit]
    variance = start.sigma**2 + m**2
    core = np.exp(-0.5 * (o - g) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
    early, flat = (o < g) / g, np.full(len(o), 1 / range_max)
    short, random = start.short, start.random
    for _ in range(EM_STEPS):
        parts = np.stack([(1 - short - random) * core, short * early, random * flat])
        counts = (parts / parts.sum(axis=0)).sum(axis=1) + PRIOR_BEAMS
        short, random = (float(x) for x in counts[1:] / counts.sum())
    none = float((np.isposinf(measured) & surface).sum())
    unseen = (none + PRIOR_BEAMS) / (float(surface.sum()) + 2 * PRIOR_BEAMS)
    return replace(start, short=short, random=random, unseen=unseen)


def learn_motion(stamps: Array, poses: Array, odom: Array | None) -> MotionNoise:
    """Fits the motion model to reference poses (N, 3) of consecutive scans at ``stamps`` (N,) s.

    ``odom`` (N, 3) are the odometry poses of the same scans, if there are any; NaN where unknown.
    """
    period = np.diff(stamps)
    steps = se2.between(poses[:-1], poses[1:])
    regular = (period > 0) & (period < 3 * np.median(period))
    usual_period = float(np.median(period[regular]))
    both_regular = regular[1:] & regular[:-1]
    velocity = steps / np.maximum(period, 1e-6)[:, None]
    change = steps[1:] - velocity[:-1] * period[1:, None]
    change[:, 2] = se2.wrap(change[:, 2])
    change = np.abs(change[both_regular]) / usual_period**2
    speed = np.hypot(velocity[regular, 0], velocity[regular, 1])

    def deviation(values: Array) -> float:
        return float(np.quantile(values, 0.9) / 1.645)  # 90 % of a Gaussian are within 1.645 standard deviations

    learned = MotionNoise(
        period=usual_period,
        acceleration=deviation(change[:, :2].max(axis=1)),
        turn_acceleration=deviation(change[:, 2]),
        speed=float(np.quantile(speed, 0.99)),
        turn=float(np.quantile(np.abs(velocity[regular, 2]), 0.99)),
    )
    if odom is None:
        return learned
    odom_steps = se2.between(odom[:-1], odom[1:])
    used = regular & np.isfinite(odom_steps).all(axis=1)
    return _learn_odometry(learned, steps[used], odom_steps[used]) if used.any() else learned


def _learn_odometry(noise: MotionNoise, steps: Array, odom_steps: Array) -> MotionNoise:
    """Fits the variances per metre and per radian by least squares of the squared errors, each clipped at 99 %."""
    error = se2.between(odom_steps, steps)
    by = np.column_stack([np.hypot(odom_steps[:, 0], odom_steps[:, 1]), np.abs(odom_steps[:, 2])])
    position = np.mean(error[:, :2] ** 2, axis=1)
    heading = error[:, 2] ** 2
    (path_by_path, path_by_turn), (turn_by_path, turn_by_turn) = (
        _non_negative_least_squares(by, np.minimum(square, np.quantile(square, 0.99))) for square in (position, heading)
    )
    return replace(
        noise,
        path_by_path=path_by_path,
        path_by_turn=path_by_turn,
        turn_by_path=turn_by_path,
        turn_by_turn=turn_by_turn,
    )


def _non_negative_least_squares(by: Array, square: Array) -> tuple[float, float]:
    found, *_ = np.linalg.lstsq(by, square, rcond=None)
    if found.min() < 0:  # fit only the other of the two
        k = int(found.argmax())
        found = np.zeros(2)
        found[k] = max(0.0, float(by[:, k] @ square / (by[:, k] @ by[:, k])))
    return float(found[0]) + 1e-6, float(found[1]) + 1e-6  # no motion is known exactly
