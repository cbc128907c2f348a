"""Calibrates the density, the motion model and the covariance on real scans.

From posed scans that the field has not learned from: the reference poses' own error counts as the model's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.ranges import surfaces
from services.estimator.precise import obstruction
from services.estimator.precise.gauss_newton import View, difference, polish
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.precise.settings import Settings

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.generative_models import Expected, GenerativeModel

EM_STEPS = 30
SEEN_BEFORE = 10.0  # beams: as if so many of every kind had been seen besides
LEAST_SIGMA = 0.003  # m
MEDIAN = 2.366  # of chi squared of three degrees of freedom
NEAR = 0.3  # m: further off another place was found, which the covariance of one place does not speak of
PROBABILITIES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)


@dataclass(frozen=True)
class Calibration:
    """What held-out scans of a drive say; what the estimator is told by it: `settings`."""

    likelihood: Likelihood
    motion: MotionNoise
    scans: int  # held out
    usual: float  # share of a scan that is explained at the reference pose: median,
    unusual: float  # and what 95 of 100 scans exceed
    late: float  # share of a scan that ends behind what is expected there; 90 of 100 scans stay below
    dependence: float  # variance of a scan's log likelihood over that of independent beams
    spread: float  # nats, standard deviation of a scan's accuracy
    inflation: float  # of the covariance
    floor_position: float  # m, deviation in x and in y that remains: of the reference poses, and of the map
    floor_heading: float  # rad
    log_likelihood: float  # nats a beam
    nees_median: float  # of poses found from one scan, with the covariance as it is stated; honest: 2.37
    nees_mean: float  # honest: 3
    coverage: tuple[tuple[float, float], ...]  # probability stated of a range's interval, share of beams within

    def settings(self) -> Settings:
        """An estimator's; its thresholds relative to how scans of this place usually look."""
        plain = Settings()
        return Settings(
            satisfied=0.93 * self.usual, good=0.77 * self.usual, sure=0.77 * self.usual,
            doubtful=0.77 * self.usual,
            believable=plain.believable * self.usual,
            drop=max(plain.drop, self.usual - self.unusual), rise=max(plain.rise, 3 * self.spread),
            contradicted=max(plain.contradicted, self.late),
            evidence_error=max(plain.evidence_error, self.dependence), inflation=self.inflation,
            floor_position=self.floor_position, floor_heading=self.floor_heading, motion=self.motion,
        )  # fmt: skip


@dataclass(frozen=True)
class Drive:
    """Posed scans, in order."""

    stamps: Array  # (N,) s
    poses: Array  # (N, 3) base_link in map: the reference
    ranges: Array  # (N, B) m
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    odom: Array | None = None  # (N, 3)

    def part(self, which: npt.NDArray[np.integer | np.bool_]) -> Drive:
        """Some of the scans."""
        odom = None if self.odom is None else self.odom[which]
        return replace(
            self, stamps=self.stamps[which], poses=self.poses[which], ranges=self.ranges[which], odom=odom
        )  # fmt: skip


def calibrate(model: GenerativeModel, held: Drive, motion: MotionNoise, sigma: float) -> Calibration:
    """From scans that ``model`` has not learned from; ``sigma`` m, the scanner's noise."""
    lasers = se2.compose(held.poses, held.mount)
    expected = model.expect(lasers, held.angles)
    likelihood = learn_shares(held.ranges, expected, held.range_max, Likelihood(sigma))
    explained, accuracy, late, beams = [], [], [], []
    for k, scan in enumerate(held.ranges):
        view = View(model, likelihood, held.mount, held.angles, scan, held.range_max)
        one = expected.part(slice(k, k + 1))
        seen = likelihood.evaluate(scan, held.range_max, one)
        explained.append(float(seen.explained[0]))
        accuracy.append(float(seen.accuracy[0]))
        late.append(obstruction.contradicted(view, one))
        beams.append(_of_each(likelihood, scan, held.range_max, one))
    each = np.concatenate(beams)
    count = float(np.mean([len(b) for b in beams]))
    floor, inflation, nees = _pose_precision(model, likelihood, held)
    return Calibration(
        likelihood, motion, len(held.ranges), float(np.median(explained)), float(np.quantile(explained, 0.05)),
        float(np.quantile(late, 0.9)), float(np.var(accuracy) / max(count * np.var(each), 1e-9)),
        float(np.std(accuracy)), inflation, floor[0], floor[1], -float(each.mean()), float(np.median(nees)),
        float(np.mean(nees)), _coverage(likelihood, held.ranges, expected, held.range_max),
    )  # fmt: skip


def _of_each(likelihood: Likelihood, scan: Array, range_max: float, expected: Expected) -> Array:
    """(K,) nats, -ln p of each beam that is used."""
    used = np.flatnonzero(~np.isnan(scan) & (scan > -np.inf))
    alone = type(expected)(
        expected.ranges[0, used, None], expected.scale[0, used, None], expected.jacobian[0, used, None]
    )
    return np.array(
        [likelihood.evaluate(scan[b : b + 1], range_max, alone.part(slice(k, k + 1))).accuracy[0]
         for k, b in enumerate(used)]
    )  # fmt: skip


def _pose_precision(
    model: GenerativeModel, likelihood: Likelihood, held: Drive
) -> tuple[tuple[float, float], float, Array]:
    """What remains between poses found from one scan and the reference, beyond what the scan's covariance says.

    Floors by robust deviations, then the inflation with which the median of the squared errors is right: a few scans
    whose reference is far off must not decide.
    """
    offs, covariances = [], []
    for pose, scan in zip(held.poses, held.ranges, strict=True):
        view = View(model, likelihood, held.mount, held.angles, scan, held.range_max)
        found, evidence = polish(view, pose[None])
        off = difference(found, pose[None])[0]
        if np.hypot(off[0], off[1]) < NEAR:
            alone = np.linalg.inv(evidence.curvature[0] + np.eye(3))
            offs.append(off + alone @ evidence.xi[0])
            covariances.append(alone @ (evidence.of_noise[0] + evidence.of_model[0]) @ alone)
    off, stated = np.array(offs), np.array(covariances)

    def beyond(values: Array, variance: Array) -> float:
        return float(np.sqrt(max(0.0, (1.4826 * np.median(np.abs(values))) ** 2 - float(np.median(variance)))))

    position = beyond(off[:, :2].ravel(), stated[:, [0, 1], [0, 1]].ravel())
    heading = beyond(off[:, 2], stated[:, 2, 2])
    floor = np.diag([position**2, position**2, heading**2])

    def nees(inflation: float) -> Array:
        return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(inflation * stated + floor), off))

    low, high = 1.0, 1e4
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if np.median(nees(middle)) > MEDIAN else (low, middle)
    return (position, heading), high, nees(high)


def _coverage(
    likelihood: Likelihood, measured: Array, expected: Expected, range_max: float
) -> tuple[tuple[float, float], ...]:
    """How many ranges fall below the quantiles stated of them, where a surface is expected: the diagonal is honest."""
    use = np.isfinite(measured) & np.isfinite(expected.scale) & (expected.ranges < range_max)
    below = likelihood.cumulative(measured[use], expected.ranges[use], expected.scale[use], range_max)
    return tuple((p, float((below <= p).mean())) for p in PROBABILITIES)


def noise_of(ranges: Array, angles: Array) -> float:
    """M, the scanner's noise from its scans (N, B) alone, where at most a few beams in a hundred are outliers.

    Along a straight wall 1/r is a sinusoid of the angle, so u(a - d) + u(a + d) = 2 cos(d) u(a) for u = 1/r; what is
    left is noise. Median absolute deviation: at edges it is not so.
    """
    turn = 2 * np.cos(np.diff(angles).mean())
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.where(surfaces(ranges), ranges, np.nan)
        bend = (inverse[:, 2:] - turn * inverse[:, 1:-1] + inverse[:, :-2]) * ranges[:, 1:-1] ** 2
    return max(LEAST_SIGMA, float(1.4826 * np.nanmedian(np.abs(bend)) / np.sqrt(2 + turn**2)))


def learn_shares(measured: Array, expected: Expected, range_max: float, start: Likelihood) -> Likelihood:
    """The shares that make scans (N, B) most likely, by expectation maximisation; sigma stays ``start``'s."""
    surface = (expected.ranges < range_max) & np.isfinite(expected.scale) & (measured > -np.inf)  # NaN is not
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
