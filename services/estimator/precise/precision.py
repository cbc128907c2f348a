"""Learns while driving how precise the scanner and the map are.

Precision is the inverse variance of the prediction error. It is learned from the errors themselves, as in predictive
coding (Friston 2009), instead of being trusted as stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.gauss_newton import CORRELATED_M
from services.estimator.precise.noise import NORMAL_MAD, estimate_noise

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.precise.likelihood import Likelihood

UPDATE_SHARE = 0.1  # weight of the present scan, or key scan, in the averages, at least
MIN_CHANGED, MAX_CHANGED = 0.02, 0.5  # limits of the share of changed surfaces
# Scans with more than this times the stated noise, or less than its inverse, show no smooth walls.
MAX_NOISE_FACTOR = 4.0
PIECE_M = 0.5  # surfaces are cut to this length, on which the errors of a map are much alike
MAX_MAP_ERROR_M = 0.1  # larger errors are not the map's, but changes of the surroundings
MIN_LEARNING_BEAMS, MIN_LEARNING_SHARE = 30, 0.3  # of a scan; nothing is learned from fewer
DAMPING = 1e-9  # in m; keeps the inverse finite where a direction is not observed


@dataclass
class Precision:
    """Precision learned so far."""

    noise_factor: float = 1.0  # of the scanner's noise, relative to what is stated
    changed: float = 0.25  # share of surfaces that the map does not show as they are
    cell: float = 0.0  # m, edge of the cells if the map is a grid
    offset: float = 0.0  # m, mean distance of the real surfaces behind the front of the cells
    offset_variance: float = 0.0  # m²
    covariance: float = 0.0  # m², of the errors that the map shows at neighbouring beams
    stated: float = 0.0  # m², mean variance of the map's errors as the model states it
    scans: int = 0  # key scans from which the map's errors were learned
    noise_scans: int = 0  # scans from which the noise was learned

    @classmethod
    def of_map(cls, cell: float) -> Precision:
        """What is known before the first scan of a map, a grid with cells of ``cell`` m or, if that is 0, another one.

        A surface is anywhere in its cell (variance cell² / 12), and errors of mapping add as much again. But a map may
        be drawn so that all surfaces are alike in their cells.
        """
        return cls(cell=cell, offset=cell / 2, offset_variance=cell**2 / 12, covariance=cell**2 / 6)

    @property
    def map_error(self) -> float:
        """Standard deviation in m of the map's error beyond what the model states."""
        return float(np.sqrt(max(0.0, self.covariance - self.stated)))

    @property
    def shared_error(self) -> float:
        """Share of the variance of the map's error that is alike for neighbouring beams."""
        total = max(self.covariance, self.stated)
        return max(0.0, self.covariance) / total if total > 0 else 0.0

    def likelihood(self, stated: Likelihood, ranges: Array, angles: Array) -> Likelihood:
        """The likelihood with the noise learned from the scans so far and from this one, (B,) m along (B,) rad."""
        if not stated.relative and len(ranges) >= MIN_LEARNING_BEAMS:
            factor = estimate_noise(ranges[None], angles) / stated.sigma
            if 1 / MAX_NOISE_FACTOR < factor < MAX_NOISE_FACTOR:
                self.noise_scans += 1
                self.noise_factor += _share(self.noise_scans) * (factor - self.noise_factor)
        return replace(stated, sigma=self.noise_factor * stated.sigma)

    def forget_cells(self) -> None:
        """The model is replaced by one that has learned where the surfaces are in the cells of the grid."""
        self.cell = self.offset = self.offset_variance = 0.0

    def learn_changes(self, view: View, pose: Array) -> None:
        """Learns from a key scan at ``pose`` (3,) how much of the surroundings is as the map shows it."""
        explained = float(view.surface_evidence(pose[None]).explained[0])
        self.changed += UPDATE_SHARE * (1 - explained - self.changed)
        self.changed = float(np.clip(self.changed, MIN_CHANGED, MAX_CHANGED))

    def learn_map_error(self, view: View, pose: Array) -> None:
        """Learns the map's errors from those of the prediction of a key scan at ``pose`` (3,).

        The map's errors are alike for neighbouring beams, but the scanner's noise is not. So the covariance of the
        errors of beams that hit the same piece of a surface is the variance of the map's errors, however large the
        noise. Scans at one place show the same errors, so only key scans are used.
        """
        expected = view.expected(pose)
        surface, scale, slope = expected.ranges[0], expected.scale[0], expected.slope[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = (view.ranges - surface) / slope
            used = (np.abs(errors) < MAX_MAP_ERROR_M) & np.isfinite(scale)
        if used.sum() < max(MIN_LEARNING_BEAMS, MIN_LEARNING_SHARE * len(view.ranges)):
            return
        errors, surface, slope = errors[used], surface[used], slope[used]
        stated, spacing = (scale[used] / slope) ** 2, surface * view.spacing
        pieces = _pieces(np.cumsum(view.surfaces.starts)[used], spacing)
        robust = _robust_covariance(errors, pieces) - float(np.median(stated))
        if robust > view.map_error**2:  # with too small an error, no surface would be explained
            view = replace(view, map_error=float(np.sqrt(robust)))
        # By length of surface instead of by beam, because near surfaces have more beams.
        lengths = view.surface_evidence(pose[None]).weights[0, used] * spacing
        if not lengths.any():
            return
        if self.cell:
            noise = view.likelihood.deviation(surface) / slope
            jacobian = expected.jacobian[0, used] / slope[:, None]
            errors = self._learn_offset(errors, stated + noise**2, jacobian, lengths)
        self.scans += 1
        share = _share(self.scans)
        self.covariance += share * (error_covariance(errors, pieces, lengths) - self.covariance)
        self.stated += share * (float(np.average(stated, weights=lengths)) - self.stated)

    def _learn_offset(self, errors: Array, stated: Array, jacobian: Array, lengths: Array) -> Array:
        """Learns the offset from the errors (K,) in m across surfaces, of variance ``stated`` (K,) without the map's.

        The pose was fitted to the same beams with the offset so far, so both are estimated together: with ``jacobian``
        (K, 3), the derivative of the errors by the pose. Beams count by their ``lengths`` (K,) of surface in m. Returns
        the errors that remain.
        """
        design = np.column_stack([jacobian, np.ones(len(errors))])
        inverse = np.linalg.inv(design.T @ (lengths[:, None] * design) + DAMPING * np.eye(4))
        fitted = inverse @ (design.T @ (lengths * errors))
        remaining = np.asarray(errors - design @ fitted)
        excess = max(0.0, float(np.average(remaining**2 - stated, weights=lengths)))
        noise = float(np.average(stated, weights=lengths) * lengths.mean())  # the same for every beam
        variance = (excess * CORRELATED_M + noise) * float(inverse[3, 3])
        gain = self.offset_variance / (self.offset_variance + variance)
        self.offset = float(np.clip(self.offset + gain * fitted[3], 0.0, self.cell))
        self.offset_variance *= 1 - gain
        return remaining


def _share(scans: int) -> float:
    """Weight of the newest of ``scans`` scans in an average, in which the value before them counts as one more."""
    return max(UPDATE_SHARE, 1 / (scans + 1))


def _pieces(surfaces: npt.NDArray[np.intp], lengths: Array) -> npt.NDArray[np.intp]:
    """Numbers (K,) of the pieces of surfaces that beams hit, in their order, from the numbers (K,) of the surfaces.

    A beam stands for ``lengths`` (K,) m of its surface.
    """
    along = np.floor(np.cumsum(lengths) / PIECE_M)
    return np.cumsum((np.diff(surfaces, prepend=surfaces[:1]) != 0) | (np.diff(along, prepend=along[:1]) != 0))


def error_covariance(errors: Array, pieces: npt.NDArray[np.intp], weights: Array) -> float:
    """Weighted covariance in m² of the errors (K,) of two different beams on the same piece; 0 if there are none."""
    sums = np.bincount(pieces, weights * errors) ** 2 - np.bincount(pieces, (weights * errors) ** 2)
    pairs = np.bincount(pieces, weights) ** 2 - np.bincount(pieces, weights**2)
    return float(sums.sum() / pairs.sum()) if pairs.sum() > 0 else 0.0


def _robust_covariance(errors: Array, pieces: npt.NDArray[np.intp]) -> float:
    """Covariance in m² of the errors (K,) of neighbouring beams on the same piece, however large some of them are.

    Gnanadesikan and Kettenring 1972. Returns 0 if there are no such beams.
    """
    first = np.flatnonzero(np.diff(pieces) == 0)
    if not len(first):
        return 0.0
    a, b = errors[first], errors[first + 1]
    of_sum, of_difference = (NORMAL_MAD * float(np.median(np.abs(each))) for each in (a + b, a - b))
    return (of_sum**2 - of_difference**2) / 4
