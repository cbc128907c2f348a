"""Learns while driving how precise the scanner and the map are.

Precision is the inverse variance of the prediction error. It is learned from the errors themselves, as in predictive
coding (Friston 2009), instead of being trusted as configured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.gauss_newton import CORRELATION_LENGTH_M
from services.estimator.precise.noise import NORMAL_MAD, estimate_noise

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.precise.likelihood import Likelihood

MIN_UPDATE_WEIGHT = 0.1  # of the newest scan, or key scan, in an average
MIN_CHANGED_FRACTION, MAX_CHANGED_FRACTION = 0.02, 0.5  # guesses
# If the measured noise differs from the configured one by more than this factor (a guess), the scan shows no smooth
# walls, from which noise could be measured.
MAX_NOISE_FACTOR = 4.0
# The covariance of the errors on one segment of a surface is taken for the variance of the map's errors, so a segment
# must be short enough that these are nearly equal along it. `CORRELATION_LENGTH_M` is longer: it says how far along a
# surface errors still add up instead of averaging out.
SEGMENT_LENGTH_M = 0.5
# Larger errors, with three standard deviations of the noise added in quadrature, are not the map's, but changes of the
# surroundings.
MAX_MAP_ERROR_M = 0.1
MIN_LEARNING_BEAMS, MIN_LEARNING_FRACTION = 30, 0.3  # of a scan's beams; nothing is learned from fewer
DAMPING = 1e-9  # in m; keeps the inverse finite where a direction is not observed
ROOM_KEY_SCANS = 20  # in a room (a guess); in the next room, surfaces may have another mean place in their cells


@dataclass
class Precision:
    """Precision learned so far."""

    noise_factor: float = 1.0  # standard deviation of the scanner's noise, relative to the configured one
    changed_fraction: float = 0.25  # fraction of the beams that hit no surface of the map
    cell: float = 0.0  # m, edge of the cells if the map is a grid
    offset: float = 0.0  # m, mean distance of the real surfaces behind the front of the cells, where the robot is
    offset_variance: float = 0.0  # m²
    covariance: float = 0.0  # m², of the map's errors at two beams on the same segment of a surface
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
        return cls(cell=cell, offset=cell / 2, offset_variance=cell**2 / 12, covariance=cell**2 / 6)

    @property
    def map_error(self) -> float:
        """Standard deviation in m of the map's error beyond what the model states."""
        return float(np.sqrt(max(0.0, self.covariance - self.model_variance)))

    @property
    def map_error_elsewhere(self) -> float:
        """The same in another room, where surfaces may have another mean place in their cells."""
        return float(np.hypot(self.map_error, self.cell / np.sqrt(12)))

    @property
    def correlated_fraction(self) -> float:
        """Fraction of the variance of the map's error that is alike for beams on the same segment."""
        total = max(self.covariance, self.model_variance)
        return max(0.0, self.covariance) / total if total > 0 else 0.0

    def update_noise(self, configured: Likelihood, ranges: Array, angles: Array) -> Likelihood:
        """Updates the noise by one more scan, (B,) m along (B,) rad.

        Returns the ``configured`` likelihood with the noise learned so far.
        """
        if not configured.relative and len(ranges) >= MIN_LEARNING_BEAMS:
            factor = estimate_noise(ranges[None], angles) / configured.sigma
            if 1 / MAX_NOISE_FACTOR < factor < MAX_NOISE_FACTOR:
                self.noise_scans += 1
                self.noise_factor += _update_weight(self.noise_scans) * (factor - self.noise_factor)
        return replace(configured, sigma=self.noise_factor * configured.sigma)

    def forget_cells(self) -> None:
        """Forgets the grid, when the model is replaced by one that has learned where surfaces are in its cells."""
        self.cell = self.offset = self.offset_variance = 0.0

    def learn_changes(self, view: View, pose: Array) -> None:
        """Learns the fraction of beams that hit no surface of the map from a key scan at ``pose`` (3,)."""
        explained = float(view.surface_evidence(pose[None]).explained[0])
        self.changed_fraction += MIN_UPDATE_WEIGHT * (1 - explained - self.changed_fraction)
        self.changed_fraction = float(np.clip(self.changed_fraction, MIN_CHANGED_FRACTION, MAX_CHANGED_FRACTION))

    def learn_map_error(self, view: View, pose: Array) -> None:
        """Learns the map's errors from those of the prediction of a key scan at ``pose`` (3,).

        The map's errors are alike for beams on the same segment of a surface, but the scanner's noise is independent.
        So the covariance of the errors of two such beams is the variance of the map's errors, however large the noise.
        Scans at one place show the same errors, so only key scans are used.
        """
        expected = view.expected(pose)
        surface, scale, slope = expected.ranges[0], expected.scale[0], expected.slope[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            errors, noise = (view.ranges - surface) / slope, view.likelihood.deviation(surface) / slope
            used = (np.abs(errors) < np.hypot(MAX_MAP_ERROR_M, 3 * noise)) & np.isfinite(scale)
        if used.sum() < max(MIN_LEARNING_BEAMS, MIN_LEARNING_FRACTION * len(view.ranges)):
            return
        errors, noise, surface, slope = errors[used], noise[used], surface[used], slope[used]
        model_variance, spacing = (scale[used] / slope) ** 2, surface * view.spacing
        segments = _segment_ids(np.cumsum(view.surfaces.starts)[used], spacing)
        robust = _robust_covariance(errors, segments) - float(np.median(model_variance))
        if robust > view.map_error**2:  # with too small an error, no surface would be explained
            view = replace(view, map_error=float(np.sqrt(robust)))
        # Weighted by length of surface instead of by beam, because near surfaces have more beams.
        lengths = view.surface_evidence(pose[None]).weights[0, used] * spacing
        if not lengths.any():
            return
        if self.cell:
            jacobian = expected.jacobian[0, used] / slope[:, None]
            errors = self._learn_offset(view.map_offset, errors, model_variance + noise**2, jacobian, lengths)
        self.scans += 1
        weight = _update_weight(self.scans)
        self.covariance += weight * (error_covariance(errors, segments, lengths) - self.covariance)
        self.model_variance += weight * (float(np.average(model_variance, weights=lengths)) - self.model_variance)

    def _learn_offset(
        self, assumed: float, errors: Array, expected_variance: Array, jacobian: Array, lengths: Array
    ) -> Array:
        """Learns the offset from the errors (K,) in m across surfaces that were predicted with an ``assumed`` offset.

        ``expected_variance`` (K,) m² is that of the scanner's noise plus the map error that the model states. The pose
        was fitted to the same beams with the assumed offset, so both are estimated together: with ``jacobian`` (K, 3),
        the derivative of the errors by the pose. Beams are weighted by their ``lengths`` (K,) of surface in m. Returns
        the errors that remain.
        """
        design = np.column_stack([jacobian, np.ones(len(errors))])
        inverse = np.linalg.inv(design.T @ (lengths[:, None] * design) + DAMPING * np.eye(4))
        fitted = inverse @ (design.T @ (lengths * errors))
        remaining = np.asarray(errors - design @ fitted)
        excess = max(0.0, float(np.average(remaining**2 - expected_variance, weights=lengths)))
        # Both in m³: a variance times the length of surface over which errors are alike, which for independent ones is
        # the length that one beam covers.
        correlated_part = excess * CORRELATION_LENGTH_M
        independent_part = float(np.average(expected_variance, weights=lengths) * lengths.mean())
        variance = (correlated_part + independent_part) * float(inverse[3, 3])
        self.offset_variance += (self.cell**2 / 12 - self.offset_variance) / ROOM_KEY_SCANS
        gain = self.offset_variance / (self.offset_variance + variance)
        self.offset += gain * (assumed + fitted[3] - self.offset)
        self.offset = float(np.clip(self.offset, 0.0, self.cell))
        self.offset_variance *= 1 - gain
        return remaining


def _update_weight(scans: int) -> float:
    """Weight of the newest of ``scans`` scans in an average, in which the initial value counts as one more scan."""
    return max(MIN_UPDATE_WEIGHT, 1 / (scans + 1))


def _segment_ids(surface_ids: npt.NDArray[np.intp], lengths: Array) -> npt.NDArray[np.intp]:
    """Cuts surfaces into segments of `SEGMENT_LENGTH_M`.

    Returns the segment (K,) on which each beam ends, from its surface (K,) and the ``lengths`` (K,) in m that beams
    cover, in the order of the scan.
    """
    along = np.floor(np.cumsum(lengths) / SEGMENT_LENGTH_M)
    return np.cumsum((np.diff(surface_ids, prepend=surface_ids[:1]) != 0) | (np.diff(along, prepend=along[:1]) != 0))


def error_covariance(errors: Array, segments: npt.NDArray[np.intp], weights: Array) -> float:
    """Weighted covariance in m² of the errors (K,) of two different beams on the same segment; 0 if there are none."""
    sums = np.bincount(segments, weights * errors) ** 2 - np.bincount(segments, (weights * errors) ** 2)
    pairs = np.bincount(segments, weights) ** 2 - np.bincount(segments, weights**2)
    return float(sums.sum() / pairs.sum()) if pairs.sum() > 0 else 0.0


def _robust_covariance(errors: Array, segments: npt.NDArray[np.intp]) -> float:
    """Robust covariance in m² of the errors (K,) of consecutive beams on the same segment; outliers hardly matter.

    Gnanadesikan and Kettenring 1972. Returns 0 if there are no such beams.
    """
    first = np.flatnonzero(np.diff(segments) == 0)
    if not len(first):
        return 0.0
    a, b = errors[first], errors[first + 1]
    deviation_of_sum, deviation_of_difference = (NORMAL_MAD * float(np.median(np.abs(each))) for each in (a + b, a - b))
    return (deviation_of_sum**2 - deviation_of_difference**2) / 4
