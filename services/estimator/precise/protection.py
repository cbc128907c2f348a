"""Protection levels: errors of the pose that are exceeded once in 10⁴ scans.

A covariance presumes that every surface was recognised. But each may be another one than the map shows there, such as a
cabinet before a wall, and then it has moved the estimate. As in satellite navigation, the pose is therefore estimated
again without each surface, and the level allows for any one of them being wrong (solution separation: Blanch et al.
2015, "Baseline advanced RAIM user algorithm and possible improvements", IEEE Transactions on Aerospace and Electronic
Systems 51(1), 713-732).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from common.geometry import se2
from services.estimator.precise.hypotheses import WEAK_PRIOR

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.precise.likelihood import Evidence

EXCEEDED_SHARE = 1e-4  # of the scans, whose error may exceed the protection level
MISTAKEN_SURFACE = 0.01  # probability that what is taken for a surface of the map is another one
BISECTIONS = 30  # of an interval of some metres, to well below a micrometre


def protection_level(view: View, pose: Array, covariance: Array, elsewhere: float) -> Array | None:
    """Errors (3,) m along and m across base_link, and rad, that are exceeded with probability `EXCEEDED_SHARE`.

    The scan ``view`` was matched at ``pose`` (3,), estimated with ``covariance`` (3, 3). ``elsewhere`` is the
    probability that the robot is at another hypothesis. Returns None if that alone is larger.
    """
    if elsewhere >= EXCEEDED_SHARE:
        return None
    to_base = se2.rotation(-float(pose[2]))
    offsets, widening = _without_each_surface(view.evidence_by_surface(pose), to_base)
    deviation = np.sqrt(np.diagonal(to_base @ covariance @ to_base.T))
    return _level(deviation, offsets, deviation * widening, EXCEEDED_SHARE - elsewhere)


def _without_each_surface(evidence: Evidence, to_base: Array) -> tuple[Array, Array]:
    """What the pose would be without each of the N surfaces of a scan.

    Returns the offsets (N, 3) of that pose in base_link, and the factors (N, 3) by which its deviation would be larger.
    ``to_base`` (3, 3) turns a pose's derivative from map to base_link.
    """
    xi, information = evidence.xi.sum(axis=0), evidence.curvature.sum(axis=0) + WEAK_PRIOR
    covariance = np.linalg.inv(information)
    covariances = np.linalg.inv(information - evidence.curvature)
    poses = (covariances @ (xi - evidence.xi)[..., None])[..., 0]
    offsets = (poses - covariance @ xi) @ to_base.T
    before, after = (np.diagonal(to_base @ each @ to_base.T, axis1=-2, axis2=-1) for each in (covariance, covariances))
    return np.abs(offsets), np.sqrt(after / before)


def _level(deviation: Array, offsets: Array, deviations: Array, allowed: float) -> Array:
    """The errors (3,) that are exceeded with the probability ``allowed``.

    An error is Gaussian with ``deviation`` (3,), or, with `MISTAKEN_SURFACE` for each of N surfaces, with the mean
    ``offsets`` (N, 3) and with ``deviations`` (N, 3).
    """

    def exceeded(level: Array) -> Array:
        mistaken = ndtr((offsets - level) / deviations) + ndtr((-offsets - level) / deviations)
        return np.asarray(2 * ndtr(-level / deviation) + MISTAKEN_SURFACE * mistaken.sum(axis=0))

    low = np.zeros(3)
    high = 10 * np.maximum(deviation, (offsets + deviations).max(axis=0, initial=0.0))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        above = exceeded(middle) > allowed
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray(high)
