"""Learns while driving how precise the scanner and the map are.

Precision is the inverse variance of the prediction error. It is learned from the errors themselves, as in predictive
coding (Friston 2009), instead of being trusted as configured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from common.robot.ranges import is_surface
from services.estimator.precise.noise import estimate_noise
from services.estimator.precise.residuals import (
    LeastSquares,
    error_covariance,
    robust_covariance,
    segment_ids,
    sum_over_pairs,
    variance_by_noise,
)
from services.estimator.precise.scan_likelihood import CORRELATION_LENGTH_M

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Likelihood
    from services.estimator.precise.scan_likelihood import ScanLikelihood

MIN_UPDATE_WEIGHT = 0.1  # of the newest scan, or key scan, in an average; the older ones fade accordingly
MIN_CHANGED_FRACTION, MAX_CHANGED_FRACTION = 0.02, 0.5  # guesses
# If the measured noise differs from the configured one by more than this factor (a guess), the scan shows no smooth
# walls, from which noise could be measured.
MAX_NOISE_FACTOR = 4.0
# The covariance of the errors on one segment of a surface is taken for the variance of the map's errors, so a segment
# must be short enough that these are nearly equal along it. Its length is measured across the beams: the sum of their
# ranges times their spacing, so a segment of a surface that they graze is longer. `CORRELATION_LENGTH_M` is longer: it
# says how far along a surface errors still add up instead of averaging out.
SEGMENT_LENGTH_M = 0.5
# Larger errors, with three standard deviations of the noise added in quadrature, are not the map's, but changes of the
# surroundings.
MAX_MAP_ERROR_M = 0.1
SIGNIFICANT_DEVIATIONS = 2.0  # by which a covariance may be too large by chance
MIN_LEARNING_BEAMS, MIN_LEARNING_FRACTION = 30, 0.3  # of a scan's beams; nothing is learned from fewer
MIN_EXPECTED_SUM = 1e-3  # limits the division by it
ROOM_KEY_SCANS = 20  # in a room (a guess); in the next room, surfaces may have another mean place in their cells


@dataclass
class Precision:
    """Precision learned so far."""

    noise_factor: float = 1.0  # standard deviation of the scanner's noise, relative to the configured one
    changed_fraction: float = 0.25  # fraction of the beams that do not end at the map's first surface
    cell: float = 0.0  # m, edge of the cells if the map is a grid
    offset: float = 0.0  # m, mean distance of the real surfaces behind the front of the cells, where the robot is
    offset_variance: float = 0.0  # m²
    # Sums over key scans, of which the older ones fade. The pose was fitted to each scan, so part of the map's errors
    # does not show in the residuals.
    covariance_sum: float = 0.0  # m², covariances of the residuals at two beams on the same segment of a surface
    covariance_sum_variance: float = 0.0  # m⁴, its variance due to the scanner's noise
    expected_sum: float = 0.0  # the covariances that are expected for errors of the map with variance 1
    model_variance: float = 0.0  # m², mean variance of the map's errors as the model states it
    scans: int = 0  # key scans from which the map's errors were learned
    noise_scans: int = 0  # scans from which the noise was learned

    @classmethod
    def before_first_scan(cls, cell: float) -> Precision:
        """The prior for a map; ``cell`` is the edge in m of its cells, or 0 if it is not a grid.

        A surface is anywhere in its cell (variance cell² / 12), and errors of mapping add as much again (a guess).
        Together, the standard deviation is 0.41 cells. In some maps all surfaces have the same place in their cells,
        so the offset common to all surfaces is uncertain, too.
        """
        return cls(cell=cell, offset=cell / 2, offset_variance=cell**2 / 12)

    @property
    def _error_variance(self) -> float:
        """Variance in m² of the map's errors; the prior counts as one key scan whose pose is known, and does not fade.

        Where a map is exact, the covariance is as often positive as negative, so what may be due to chance is left out.
        Until a second key scan, an error is assumed nevertheless.
        """
        by_chance = SIGNIFICANT_DEVIATIONS * float(np.sqrt(self.covariance_sum_variance)) if self.scans > 1 else 0.0
        significant = self.covariance_sum - min(by_chance, max(0.0, self.covariance_sum))
        return max(0.0, self.cell**2 / 6 + significant) / (1 + self.expected_sum)

    @property
    def map_error(self) -> float:
        """Standard deviation in m of the map's error beyond what the model states."""
        return float(np.sqrt(max(0.0, self._error_variance - self.model_variance)))

    @property
    def map_error_elsewhere(self) -> float:
        """The same in another room, where surfaces may have another mean place in their cells."""
        return float(np.hypot(self.map_error, self.cell / np.sqrt(12)))

    @property
    def correlated_fraction(self) -> float:
        """Fraction of the variance of the map's error that is alike along a surface, for `CORRELATION_LENGTH_M`."""
        total = max(self._error_variance, self.model_variance)
        return self._error_variance / total if total > 0 else 0.0

    def update_noise(self, configured: Likelihood, ranges: Array, angles: Array) -> Likelihood:
        """Updates the noise by one more scan, (B,) m along (B,) rad.

        Returns the ``configured`` likelihood with the noise learned so far.
        """
        if not configured.relative and np.count_nonzero(is_surface(ranges)) >= MIN_LEARNING_BEAMS:
            factor = estimate_noise(ranges[None], angles) / configured.sigma
            if 1 / MAX_NOISE_FACTOR < factor < MAX_NOISE_FACTOR:
                self.noise_scans += 1
                self.noise_factor += _update_weight(self.noise_scans) * (factor - self.noise_factor)
        return replace(configured, sigma=self.noise_factor * configured.sigma)

    def forget_map(self) -> None:
        """Forgets the map's errors, when the model is replaced by one that has learned where the surfaces are."""
        self.cell = self.offset = self.offset_variance = 0.0
        self.covariance_sum = self.covariance_sum_variance = self.expected_sum = self.model_variance = 0.0
        self.scans = 0

    def learn_changes(self, scan: ScanLikelihood, pose: Array) -> None:
        """Learns the fraction of beams that do not end at the map's first surface, from a key scan at ``pose`` (3,)."""
        used = scan.ranges > -np.inf  # not NaN either
        mapped = float(scan.surface_evidence(pose[None]).weights.sum()) / max(1, int(used.sum()))
        self.changed_fraction += MIN_UPDATE_WEIGHT * (1 - mapped - self.changed_fraction)
        self.changed_fraction = float(np.clip(self.changed_fraction, MIN_CHANGED_FRACTION, MAX_CHANGED_FRACTION))

    def learn_map_error(self, scan: ScanLikelihood, pose: Array) -> None:
        """Learns the map's errors from those of the prediction of a key scan at ``pose`` (3,).

        The map's errors are alike for beams on the same segment of a surface, but the scanner's noise is independent.
        So the covariance of the errors of two such beams is the variance of the map's errors. What the fit of the pose
        changes about this is known (`LeastSquares.expected_covariance`). Scans at one place show the same errors, so
        only key scans are used.
        """
        expected = scan.expected(pose)
        surface, scale, slope = expected.ranges[0], expected.scale[0], expected.slope[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            errors, noise = (scan.ranges - surface) / slope, scan.likelihood.deviation(surface) / slope
            used = (np.abs(errors) < np.hypot(MAX_MAP_ERROR_M, 3 * noise)) & np.isfinite(scale)
        if used.sum() < max(MIN_LEARNING_BEAMS, MIN_LEARNING_FRACTION * len(scan.ranges)):
            return
        errors, noise, surface, slope = errors[used], noise[used], surface[used], slope[used]
        model_variance, spacing = (scale[used] / slope) ** 2, surface * scan.spacing
        surfaces = np.cumsum(scan.surfaces.starts)[used]
        segments = segment_ids(surfaces, spacing, SEGMENT_LENGTH_M)
        robust = robust_covariance(errors, segments) - float(np.median(model_variance))
        if robust > scan.map_error**2:  # with too small an assumed error, all surfaces would look changed
            scan = replace(scan, map_error=float(np.sqrt(robust)))
        # Weighted by the length that each covers across the beams, because near surfaces have more beams.
        lengths = scan.surface_evidence(pose[None]).weights[0, used] * spacing
        if sum_over_pairs(segments, lengths) <= 0:
            return
        design = np.column_stack([expected.jacobian[0, used] / slope[:, None], np.ones(len(errors))])
        fit = LeastSquares.of(design if self.cell else design[:, :3], lengths)  # the pose, and in a grid the offset
        long_segments = segment_ids(surfaces, spacing, CORRELATION_LENGTH_M)
        of_map_errors, by_noise = fit.expected_covariance(segments, long_segments, noise**2)
        fading = 1 - MIN_UPDATE_WEIGHT
        self.scans += 1
        self.covariance_sum *= fading
        self.covariance_sum += error_covariance(fit.residuals(errors), segments, lengths) - by_noise
        self.covariance_sum_variance *= fading**2
        self.covariance_sum_variance += variance_by_noise(segments, lengths, noise**2)
        self.expected_sum = fading * self.expected_sum + of_map_errors
        weight = _update_weight(self.scans)
        self.model_variance += weight * (float(np.average(model_variance, weights=lengths)) - self.model_variance)
        if self.cell:
            # Both in m³: a variance times the length over which errors are alike, which for independent ones is the
            # length that one beam covers. The former is as measured, without the prior, by which the offset of a
            # grid drawn exactly along its cells would remain uncertain for long.
            correlated_part = (
                max(0.0, self.covariance_sum) / max(self.expected_sum, MIN_EXPECTED_SUM) * CORRELATION_LENGTH_M
            )
            independent_part = float(np.average(model_variance + noise**2, weights=lengths) * lengths.mean())
            variance = (correlated_part + independent_part) * float(fit.inverse[3, 3])
            self._learn_offset(scan.map_offset + float(fit.gain[3] @ errors), variance)

    def _learn_offset(self, measured: float, variance: float) -> None:
        """Learns the offset from a key scan, where it was ``measured`` in m with the ``variance`` in m²."""
        self.offset_variance += (self.cell**2 / 12 - self.offset_variance) / ROOM_KEY_SCANS
        gain = self.offset_variance / (self.offset_variance + variance)
        self.offset = float(np.clip(self.offset + gain * (measured - self.offset), 0.0, self.cell))
        self.offset_variance *= 1 - gain


def _update_weight(scans: int) -> float:
    """Weight of the newest of ``scans`` scans in an average, in which the initial value counts as one more scan."""
    return max(MIN_UPDATE_WEIGHT, 1 / (scans + 1))
