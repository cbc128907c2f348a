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

UPDATE_SHARE = 0.1  # weight of the present scan in the averages, at least
CHANGE_UPDATE_SHARE = 0.1  # the same for key scans
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
    excess: float = 0.0  # m², variance of the errors beyond the scanner's noise and what the model states
    scans: int = 0  # from which the excess was learned

    @classmethod
    def of_map(cls, error: float) -> Precision:
        """What is known before the first scan; ``error`` m is that stated for the map, 0 if none is.

        A stated one counts as much as many scans.
        """
        return cls(excess=error**2, scans=round(1 / UPDATE_SHARE) if error else 0)

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

    def learn_changes(self, view: View, pose: Array) -> None:
        """Learns from a key scan at ``pose`` (3,) how much of the surroundings is as the map shows it."""
        explained = float(view.surface_evidence(pose[None]).explained[0])
        self.changed += CHANGE_UPDATE_SHARE * (1 - explained - self.changed)
        self.changed = float(np.clip(self.changed, MIN_CHANGED, MAX_CHANGED))

    def learn(self, view: View, pose: Array) -> None:
        """Learns the map's error from the errors of the scan's prediction at ``pose`` (3,)."""
        expected = view.expected(pose)
        surface, scale = expected.ranges[0], expected.scale[0]
        with np.errstate(invalid="ignore"):
            errors = np.abs(view.ranges - surface)
            used = (errors < MAX_MAP_ERROR_M) & np.isfinite(scale)
        if used.sum() < max(MIN_LEARNING_BEAMS, 0.3 * len(view.ranges)):
            return
        variance = (NORMAL_MAD * float(np.median(errors[used]))) ** 2
        excess = variance - view.likelihood.sigma**2 - float(np.median(scale[used])) ** 2
        self.scans += 1
        # Before the first scan, the map was taken for exact; that counts as one more scan.
        self.excess += max(UPDATE_SHARE, 1 / (self.scans + 1)) * (excess - self.excess)
