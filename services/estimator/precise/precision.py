"""Learns while driving how precise the scanner and the map are.

Precision is the inverse variance of the prediction error. It is learned from the errors themselves, as in predictive
coding (Friston 2009), instead of being trusted as stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from services.estimator.precise.noise import estimate_noise

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.precise.likelihood import Likelihood

UPDATE_SHARE = 0.1  # weight of the present scan, or key scan, in the averages, at least
MIN_CHANGED, MAX_CHANGED = 0.02, 0.5
MAX_NOISE_FACTOR = 4.0  # the noise is never taken for more than this times the stated one, or less than its inverse
MAX_MAP_ERROR_M = 0.1  # larger errors are not the map's, but changes of the surroundings
NORMAL_MAD = 1.4826  # standard deviation of a Gaussian, in median absolute deviations
MIN_LEARNING_BEAMS = 30


@dataclass
class Precision:
    """Precision learned so far."""

    noise_factor: float = 1.0  # of the scanner's noise, relative to what is stated
    changed: float = 0.25  # share of surfaces that the map does not show as they are
    cell: float = 0.0  # m, edge of the cells if the map is a grid
    offset: float = 0.0  # m, mean distance of the real surfaces behind the front of the cells
    excess: float = 0.0  # m², variance of the errors beyond the scanner's noise and what the model states
    scans: int = 0  # key scans from which the map's errors were learned

    @classmethod
    def of_map(cls, cell: float) -> Precision:
        """What is known before the first scan of a map, a grid with cells of ``cell`` m or, if that is 0, another one.

        A surface is anywhere in its cell (variance cell² / 12), and errors of mapping add as much again.
        """
        return cls(cell=cell, offset=cell / 2, excess=cell**2 / 6)

    @property
    def map_error(self) -> float:
        """Standard deviation in m of the map's error beyond what the model states."""
        return float(np.sqrt(max(0.0, self.excess)))

    def likelihood(self, stated: Likelihood, ranges: Array, angles: Array) -> Likelihood:
        """The likelihood with the noise learned from the scans so far and from this one, (B,) m along (B,) rad."""
        if not stated.relative and len(ranges) >= MIN_LEARNING_BEAMS:
            factor = estimate_noise(ranges[None], angles) / stated.sigma
            factor = float(np.clip(factor, 1 / MAX_NOISE_FACTOR, MAX_NOISE_FACTOR))
            self.noise_factor += UPDATE_SHARE * (factor - self.noise_factor)
        return replace(stated, sigma=self.noise_factor * stated.sigma)

    def forget_cells(self) -> None:
        """The model is replaced by one that has learned where the surfaces are in the cells of the grid."""
        self.cell = self.offset = 0.0

    def learn_changes(self, view: View, pose: Array) -> None:
        """Learns from a key scan at ``pose`` (3,) how much of the surroundings is as the map shows it."""
        explained = float(view.surface_evidence(pose[None]).explained[0])
        self.changed += UPDATE_SHARE * (1 - explained - self.changed)
        self.changed = float(np.clip(self.changed, MIN_CHANGED, MAX_CHANGED))

    def learn(self, view: View, pose: Array) -> None:
        """Learns the map's errors from those of the prediction of a key scan at ``pose`` (3,).

        Scans at one place show the same errors, so only key scans are used. Two estimates of their variance are too
        small in different cases, so the larger one counts: the median of all errors if they differ between surfaces,
        and the mean square over the surfaces that the map explains if it explains too few.
        """
        expected = view.expected(pose)
        surface, scale = expected.ranges[0], expected.scale[0]
        noise = view.likelihood.deviation(surface)
        slope = np.hypot(*expected.jacobian[0, :, :2].T)  # of the range by the distance to the surface
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = (view.ranges - surface) / slope
            used = (np.abs(errors) < MAX_MAP_ERROR_M) & np.isfinite(scale)
        if used.sum() < max(MIN_LEARNING_BEAMS, 0.3 * len(view.ranges)):
            return
        median = float(np.median(np.abs(view.ranges - surface)[used]))
        robust = (NORMAL_MAD * median) ** 2 - float(np.median((noise**2 + scale**2)[used]))
        if robust > view.map_error**2:  # with too small an error, no surface would be explained
            view = replace(view, map_error=float(np.sqrt(robust)))
        # By length of surface instead of by beam, because near surfaces have more beams.
        weights = view.surface_evidence(pose[None]).weights[0][used] * surface[used]
        if not weights.any():
            return
        errors, stated = errors[used], (noise**2 + scale**2)[used] / slope[used] ** 2
        mean = float(np.average(errors, weights=weights)) if self.cell else 0.0
        excess = max(robust, float(np.average((errors - mean) ** 2 - stated, weights=weights)))
        self.scans += 1
        share = max(UPDATE_SHARE, 1 / (self.scans + 1))  # what was known before counts as one more scan
        self.offset = float(np.clip(self.offset + share * mean, 0.0, self.cell))
        self.excess += share * (excess - self.excess)
