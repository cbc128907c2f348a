"""Covariance and protection level of the pose, allowing for one mistaken surface.

The inverse of the curvature presumes that every surface was recognised. But each may be another one than the map shows
there, such as a cabinet before a wall, and then it has moved the estimate. As in satellite navigation, the pose is
therefore estimated again without each surface, and the error is a mixture of Gaussians about these estimates. From it
follow the covariance and the protection level (solution separation: Blanch et al. 2015, "Baseline advanced RAIM user
algorithm and possible improvements", IEEE Transactions on Aerospace and Electronic Systems 51(1), 713-732).
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
    from services.estimator.precise.gauss_newton import View
    from services.estimator.precise.likelihood import Evidence

EXCEEDED_SHARE = 1e-4  # probability that the error exceeds the protection level
MISTAKEN_SURFACE = 0.01  # share of a scan's surfaces that are taken for a surface of the map and are another one
BISECTIONS = 20  # of an interval of some metres, to micrometres


@dataclass(frozen=True)
class EstimateError:
    """The error of an estimate: a Gaussian, or, if a surface was mistaken, one about the estimate without it."""

    covariance: Array  # (3, 3) of x, y, yaw in base_link, if no surface was mistaken
    offsets: Array  # (N, 3) of the estimate without each of the N surfaces, m along and across base_link, and rad
    widening: Array  # (N, 3) factors by which the deviations of those estimates are larger
    mistaken: float  # probability of each surface being mistaken

    @classmethod
    def of(cls, view: View, pose: Array, covariance: Array, explained: float) -> EstimateError:
        """The error of ``pose`` (3,), at which the map explains a share ``explained`` of the scan ``view``.

        ``covariance`` (3, 3) in map presumes that all surfaces were recognised. A share `MISTAKEN_SURFACE` of all
        surfaces is among those that the map explains, so the fewer these are, the less each is to be trusted.
        """
        to_base = se2.rotation(-float(pose[2]))
        offsets, widening = _estimate_without_each_surface(view.evidence_of_each_surface(pose), to_base)
        mistaken = MISTAKEN_SURFACE / max(explained, MISTAKEN_SURFACE)
        return cls(to_base @ covariance @ to_base.T, offsets, widening, mistaken)

    def total_covariance(self, yaw: float) -> Array:
        """Covariance (3, 3) in map of the mixture, at the heading ``yaw``."""
        to_map = se2.rotation(yaw)
        return np.asarray(to_map @ (self.covariance + self.mistaken * self.offsets.T @ self.offsets) @ to_map.T)

    def protection_level(self, elsewhere: float) -> Array | None:
        """Errors (3,) m along and m across base_link, and rad, that are exceeded with probability `EXCEEDED_SHARE`.

        ``elsewhere`` is the probability that the robot is at another hypothesis. Returns None if that alone is larger.
        """
        if elsewhere >= EXCEEDED_SHARE:
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
            above = exceeded(middle) > EXCEEDED_SHARE - elsewhere
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        return np.asarray(high)


def _estimate_without_each_surface(evidence: Evidence, to_base: Array) -> tuple[Array, Array]:
    """Estimates the pose again without each of the N surfaces of a scan.

    Returns the offsets (N, 3) of these poses in base_link, and the factors (N, 3) by which their deviations are larger.
    ``to_base`` (3, 3) turns a pose's derivative from map to base_link.
    """
    xi, information = evidence.xi.sum(axis=0), evidence.curvature.sum(axis=0) + WEAK_PRIOR
    covariance = np.linalg.inv(information)
    covariances = np.linalg.inv(information - evidence.curvature)
    poses = (covariances @ (xi - evidence.xi)[..., None])[..., 0]
    offsets = (poses - covariance @ xi) @ to_base.T
    before, after = (np.diagonal(to_base @ each @ to_base.T, axis1=-2, axis2=-1) for each in (covariance, covariances))
    return offsets, np.sqrt(after / before)
