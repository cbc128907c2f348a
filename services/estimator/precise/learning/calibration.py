"""Calibrates the density, the motion model and the covariance on real scans.

The scans have reference poses, and the field has not learned from them. The error of the reference poses counts as
error of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.ranges import is_surface
from services.estimator.precise import obstruction
from services.estimator.precise.gauss_newton import View, difference, polish
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.precise.settings import Settings

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.generative_models import Expected, GenerativeModel

EM_STEPS = 30
PRIOR_BEAMS = 10.0  # pseudo-count of each kind of beam
MIN_SIGMA_M = 0.003
CHI2_MEDIAN = 2.366  # median of chi squared with three degrees of freedom
MAX_POSITION_ERROR_M = 0.3  # larger errors mean that another place was found; the covariance does not describe them
PROBABILITIES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)


@dataclass(frozen=True)
class Calibration:
    """Results from the held-out scans of a drive; `settings` derives the estimator's parameters from them."""

    likelihood: Likelihood
    motion: MotionNoise
    scans: int  # held out
    usual: float  # inlier ratio at the reference pose: median over the scans
    unusual: float  # inlier ratio that 95 of 100 scans exceed
    late: float  # share of a scan's beams that end behind the expected surface; 90 of 100 scans stay below
    dependence: float  # variance of a scan's log likelihood, relative to that of independent beams
    spread: float  # nats, standard deviation of a scan's accuracy
    inflation: float  # factor on the covariance
    floor_position: float  # m, remaining deviation in x and in y: error of the reference poses and of the map
    floor_heading: float  # rad
    log_likelihood: float  # nats per beam
    nees_median: float  # of poses found from one scan, with the covariance as published; ideal: 2.37
    nees_mean: float  # ideal: 3
    coverage: tuple[tuple[float, float], ...]  # pairs of a range's cumulative probability and the share of beams below

    def settings(self) -> Settings:
        """Parameters of the estimator, with thresholds relative to the inlier ratio that is usual in this place."""
        default = Settings()
        return Settings(
            conclusive_inlier_ratio=0.93 * self.usual,
            good_inlier_ratio=0.77 * self.usual,
            tracking_inlier_ratio=0.77 * self.usual,
            doubtful_inlier_ratio=0.77 * self.usual,
            min_inlier_ratio=default.min_inlier_ratio * self.usual,
            inlier_ratio_drop=max(default.inlier_ratio_drop, self.usual - self.unusual),
            energy_jump_nats=max(default.energy_jump_nats, 3 * self.spread),
            max_contradicting_ratio=max(default.max_contradicting_ratio, self.late),
            evidence_error_nats=max(default.evidence_error_nats, self.dependence),
            inflation=self.inflation,
            floor_position=self.floor_position,
            floor_heading=self.floor_heading,
            motion=self.motion,
        )


@dataclass(frozen=True)
class Drive:
    """Scans with reference poses, in order of time."""

    stamps: Array  # (N,) s
    poses: Array  # (N, 3) base_link in map: the reference
    ranges: Array  # (N, B) m
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    odom: Array | None = None  # (N, 3)

    def part(self, which: npt.NDArray[np.integer | np.bool_]) -> Drive:
        """Returns some of the scans."""
        return replace(
            self,
            stamps=self.stamps[which],
            poses=self.poses[which],
            ranges=self.ranges[which],
            odom=None if self.odom is None else self.odom[which],
        )


def calibrate(model: GenerativeModel, held_out: Drive, motion: MotionNoise, sigma: float) -> Calibration:
    """Calibrates on scans from which ``model`` has not learned; ``sigma`` m is the scanner's noise."""
    lasers = se2.compose(held_out.poses, held_out.mount)
    expected = model.expect(lasers, held_out.angles)
    likelihood = learn_shares(held_out.ranges, expected, held_out.range_max, Likelihood(sigma))
    inlier_ratios, accuracies, late, beams = [], [], [], []
    for k, scan in enumerate(held_out.ranges):
        view = View(model, likelihood, held_out.mount, held_out.angles, scan, held_out.range_max)
        one = expected.part(slice(k, k + 1))
        evidence = likelihood.evaluate(scan, held_out.range_max, one)
        inlier_ratios.append(float(evidence.inlier_ratio[0]))
        accuracies.append(float(evidence.accuracy[0]))
        late.append(obstruction.contradicting_ratio(view, one))
        beams.append(_energy_of_beams(likelihood, scan, held_out.range_max, one))
    each = np.concatenate(beams)
    count = float(np.mean([len(b) for b in beams]))
    floor, inflation, nees = _pose_precision(model, likelihood, held_out)
    return Calibration(
        likelihood=likelihood,
        motion=motion,
        scans=len(held_out.ranges),
        usual=float(np.median(inlier_ratios)),
        unusual=float(np.quantile(inlier_ratios, 0.05)),
        late=float(np.quantile(late, 0.9)),
        dependence=float(np.var(accuracies) / max(count * np.var(each), 1e-9)),
        spread=float(np.std(accuracies)),
        inflation=inflation,
        floor_position=floor[0],
        floor_heading=floor[1],
        log_likelihood=-float(each.mean()),
        nees_median=float(np.median(nees)),
        nees_mean=float(np.mean(nees)),
        coverage=_coverage(likelihood, held_out.ranges, expected, held_out.range_max),
    )


def _energy_of_beams(likelihood: Likelihood, scan: Array, range_max: float, expected: Expected) -> Array:
    """Accuracy -ln p (K,) in nats of each beam that is used."""
    used = np.flatnonzero(~np.isnan(scan) & (scan > -np.inf))
    single = type(expected)(
        expected.ranges[0, used, None], expected.scale[0, used, None], expected.jacobian[0, used, None]
    )
    return np.array(
        [
            likelihood.evaluate(scan[b : b + 1], range_max, single.part(slice(k, k + 1))).accuracy[0]
            for k, b in enumerate(used)
        ]
    )


def _pose_precision(
    model: GenerativeModel, likelihood: Likelihood, held_out: Drive
) -> tuple[tuple[float, float], float, Array]:
    """Returns the floors of position (m) and heading (rad), the inflation, and the NEES (N,) with both.

    Compares poses found from one scan with the reference. The floors come from robust deviations. The inflation is the
    one with which the median of the squared errors is right, so that a few poor reference poses do not decide.
    """
    errors, covariances = [], []
    for pose, scan in zip(held_out.poses, held_out.ranges, strict=True):
        view = View(model, likelihood, held_out.mount, held_out.angles, scan, held_out.range_max)
        found, evidence = polish(view, pose[None])
        error = difference(found, pose[None])[0]
        if np.hypot(error[0], error[1]) < MAX_POSITION_ERROR_M:
            inverse = np.linalg.inv(evidence.curvature[0] + np.eye(3))
            errors.append(error + inverse @ evidence.xi[0])
            covariances.append(inverse @ (evidence.xi_noise_covariance[0] + evidence.xi_model_covariance[0]) @ inverse)
    off, stated = np.array(errors), np.array(covariances)

    def excess_deviation(values: Array, variance: Array) -> float:
        return float(np.sqrt(max(0.0, (1.4826 * np.median(np.abs(values))) ** 2 - float(np.median(variance)))))

    position = excess_deviation(off[:, :2].ravel(), stated[:, [0, 1], [0, 1]].ravel())
    heading = excess_deviation(off[:, 2], stated[:, 2, 2])
    floor = np.diag([position**2, position**2, heading**2])

    def nees(inflation: float) -> Array:
        return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(inflation * stated + floor), off))

    low, high = 1.0, 1e4
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if np.median(nees(middle)) > CHI2_MEDIAN else (low, middle)
    return (position, heading), high, nees(high)


def _coverage(
    likelihood: Likelihood, measured: Array, expected: Expected, range_max: float
) -> tuple[tuple[float, float], ...]:
    """Share of ranges below each quantile of the density, where a surface is expected; ideally the quantile itself."""
    use = np.isfinite(measured) & np.isfinite(expected.scale) & (expected.ranges < range_max)
    below = likelihood.cumulative(measured[use], expected.ranges[use], expected.scale[use], range_max)
    return tuple((p, float((below <= p).mean())) for p in PROBABILITIES)


def estimate_noise(ranges: Array, angles: Array) -> float:
    """The scanner's noise in m, from its scans (N, B) alone.

    Along a straight wall 1/r is a sinusoid of the angle, so u(a - d) + u(a + d) = 2 cos(d) u(a) for u = 1/r; the rest
    is noise. The median absolute deviation is used because the relation does not hold at edges.
    """
    turn = 2 * np.cos(np.diff(angles).mean())
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.where(is_surface(ranges), ranges, np.nan)
        bend = (inverse[:, 2:] - turn * inverse[:, 1:-1] + inverse[:, :-2]) * ranges[:, 1:-1] ** 2
    return max(MIN_SIGMA_M, float(1.4826 * np.nanmedian(np.abs(bend)) / np.sqrt(2 + turn**2)))


def learn_shares(measured: Array, expected: Expected, range_max: float, start: Likelihood) -> Likelihood:
    """Fits the shares of the density to scans (N, B) by expectation maximisation; sigma remains that of ``start``."""
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

    ``odom`` (N, 3) are the odometry poses of the same scans, if there are any.
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
        return float(np.quantile(values, 0.9) / 1.645)

    learned = MotionNoise(
        period=usual_period,
        acceleration=deviation(change[:, :2].max(axis=1)),
        turn_acceleration=deviation(change[:, 2]),
        speed=float(np.quantile(speed, 0.99)),
        turn=float(np.quantile(np.abs(velocity[regular, 2]), 0.99)),
    )
    if odom is None:
        return learned
    return _learn_odometry(learned, steps[regular], se2.between(odom[:-1], odom[1:])[regular])


def _learn_odometry(noise: MotionNoise, steps: Array, odom_steps: Array) -> MotionNoise:
    """Fits the variances per metre and per radian by least squares of the squared errors, each clipped at 99 %."""
    off = se2.between(odom_steps, steps)
    by = np.column_stack([np.hypot(odom_steps[:, 0], odom_steps[:, 1]), np.abs(odom_steps[:, 2])])
    position = np.mean(off[:, :2] ** 2, axis=1)
    heading = off[:, 2] ** 2
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
    return float(found[0]) + 1e-6, float(found[1]) + 1e-6
