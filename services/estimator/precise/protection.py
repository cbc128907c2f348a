"""Covariance and protection level of the pose, allowing for one mistaken surface.

The inverse of the curvature is the covariance if every surface was matched to the right surface of the map. But a
surface may be mistaken for one of the map, such as a cabinet in front of a wall, and then the estimate is wrong. As in
satellite navigation, the pose is therefore estimated again without each surface, and the error is a mixture of
Gaussians about these estimates. The covariance and the protection level are those of this mixture (solution separation:
Blanch et al. 2015, "Baseline advanced RAIM user algorithm and possible improvements", IEEE Transactions on Aerospace
and Electronic Systems 51(1), 713-732).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from common.geometry import se2
from services.estimator.precise.hypotheses import WEAK_PRIOR

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.scan_likelihood import ScanLikelihood

EXCEEDANCE_PROBABILITY = 1e-4  # that the error exceeds the protection level, by design
MISTAKEN_FRACTION = 0.01  # of a scan's surfaces, matched to a wrong surface of the map (a guess)
BISECTIONS = 20  # of an interval of some metres, to micrometres


@dataclass(frozen=True)
class EstimateError:
    """The error of an estimate: a Gaussian, or, if a surface was mistaken, one about the estimate without it."""

    covariance: Array  # (3, 3) of x, y, yaw in base_link, if no surface was mistaken
    offsets: Array  # (N, 3) m along and across base_link, and rad: by which the estimate moves without each surface
    widening: Array  # (N, 3) factors by which the standard deviations are larger without each surface
    mistaken: float  # probability that a surface is mistaken, the same for each

    @classmethod
    def from_scan(cls, scan: ScanLikelihood, pose: Array, covariance: Array, explained: float) -> EstimateError:
        """The error of ``pose`` (3,), at which the map explains the fraction ``explained`` of the scan's beams.

        ``covariance`` (3, 3) in map is that if no surface was mistaken. The number of mistaken surfaces does not depend
        on how many the map explains, so the fewer it explains, the more probably each of these is mistaken.
        """
        to_base = se2.rotation(-float(pose[2]))
        offsets, widening = _estimate_without_each_surface(scan.evidence_of_each_surface(pose), to_base)
        mistaken = MISTAKEN_FRACTION / max(explained, MISTAKEN_FRACTION)
        return cls(to_base @ covariance @ to_base.T, offsets, widening, mistaken)

    def total_covariance(self, yaw: float) -> Array:
        """Covariance (3, 3) in map of the mixture, for the heading ``yaw``."""
        to_map = se2.rotation(yaw)
        return np.asarray(to_map @ (self.covariance + self.mistaken * self.offsets.T @ self.offsets) @ to_map.T)

    def protection_level(self, elsewhere: float) -> Array | None:
        """Errors (3,) in m along and m across base_link, and rad, exceeded with `EXCEEDANCE_PROBABILITY`.

        ``elsewhere`` is the probability that the robot is at another place. Returns None if that alone is larger.
        """
        if elsewhere >= EXCEEDANCE_PROBABILITY:
            return None
        deviation, offsets = np.sqrt(np.diagonal(self.covariance)), np.abs(self.offsets)
        deviations = deviation * self.widening

        def exceeded(level: Array) -> Array:
            beyond = ndtr((offsets - level) / deviations) + ndtr((-offsets - level) / deviations)
            return np.asarray(2 * ndtr(-level / deviation) + self.mistaken * beyond.sum(axis=0))

        low = np.zeros(3)
        high = 10 * np.maximum(deviation, (offsets + deviations).max(axis=0, initial=0.0))
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            above = exceeded(middle) > EXCEEDANCE_PROBABILITY - elsewhere
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        return np.asarray(high)


def _estimate_without_each_surface(evidence: Evidence, to_base: Array) -> tuple[Array, Array]:
    """Estimates the pose again without each of the N surfaces of a scan, one at a time.

    Returns ``offsets`` and ``widening`` of `EstimateError`.
    ``to_base`` (3, 3) turns a pose's derivative from map to base_link.
    """
    xi, information = evidence.xi.sum(axis=0), evidence.curvature.sum(axis=0) + WEAK_PRIOR
    covariance = np.linalg.inv(information)
    covariances = np.linalg.inv(information - evidence.curvature)
    poses = (covariances @ (xi - evidence.xi)[..., None])[..., 0]
    offsets = (poses - covariance @ xi) @ to_base.T
    before, after = (np.diagonal(to_base @ each @ to_base.T, axis1=-2, axis2=-1) for each in (covariance, covariances))
    return offsets, np.sqrt(after / before)
