"""Registration of surface elements: finds the pose at which a scan fits a map.

Point-to-line iterative closest point (Censi, ICRA 2008) with a Gaussian prior. Corresponding elements are nearest in
position and direction together, so that a surface is never matched with its back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from common.geometry import se2
from common.geometry.information import subtract_spurious
from common.geometry.se2 import Array
from services.mapper.slam.elements import Elements

NORMAL_DIFFERENCE_M = 0.3  # a difference of 1 between two unit normals counts as this distance
CORRESPONDENCE_RADII_M = (0.6, 0.6, 0.5, 0.4, 0.3, 0.2, 0.2, 0.2)  # largest distance, iteration by iteration
RESIDUAL_M = 0.03  # standard deviation between corresponding elements, and scale of the Cauchy weights
PRIOR_SCALE = 2.0  # standard deviations, scale of the prior's Cauchy weight: wheels slip
# Factor on the standard deviations of the prior. `RESIDUAL_M` is larger than the real noise; without this factor, the
# prior would weigh too much.
PRIOR_INFLATION = 2.0
MATCHED_M = 0.15  # an element whose correspondence is nearer than this is matched
MIN_CORRESPONDENCES = 10  # between elements and target; with fewer there is no match
CORRELATED_ELEMENTS = 10.0  # number of elements that match or fail together, because they belong to one object


@dataclass
class Surface:
    """The target of a registration: surface elements and their search tree."""

    elements: Elements
    tree: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        self.elements = self.elements.divided()
        self.tree = cKDTree(_features(self.elements))

    def correspondence_distances(self, elements: Elements) -> Array:
        """Distance (K,) m of each element from its correspondence, with the direction's difference; inf: unmatched."""
        return np.asarray(self.tree.query(_features(elements), distance_upper_bound=MATCHED_M)[0])


@dataclass(frozen=True)
class PosePrior:
    """Prior of a pose, with the heavy tails of a Cauchy distribution, because wheels slip."""

    mean: Array  # (3,)
    information: Array  # (3, 3)

    def difference(self, pose: Array) -> tuple[Array, float]:
        """Difference (3,) of the mean from a pose, and its squared Mahalanobis distance."""
        difference = se2.difference(self.mean, pose)
        return difference, float(difference @ self.information @ difference)


NO_PRIOR = PosePrior(np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True)
class Registration:
    """Pose of a scan in the frame of a surface."""

    pose: Array  # (3,)
    information: Array  # (3, 3) of the scan alone, without the prior
    covariance: Array  # (3, 3) with the prior
    matched_fraction: float  # of the elements
    cost: float  # negative logarithm of the probability of elements and prior, up to a constant


def register(surface: Surface, elements: Elements, start: Array, prior: PosePrior = NO_PRIOR) -> Registration | None:
    """Registers elements, starting at the pose ``start`` (3,); returns None if too few match.

    Along directions that the surface does not show, as in a corridor, the pose is that of the prior.
    """
    pose = np.array(start, float)
    for radius in CORRESPONDENCE_RADII_M:
        placed = elements.transformed(pose)
        distance, nearest = surface.tree.query(_features(placed), distance_upper_bound=radius)
        paired = np.isfinite(distance)
        if paired.sum() < MIN_CORRESPONDENCES:
            return None
        nearest = nearest[paired]
        normal = surface.elements.normals[nearest]
        error = np.einsum("ni,ni->n", normal, placed.points[paired] - surface.elements.points[nearest])
        offset = placed.points[paired] - pose[:2]
        J = se2.displacement_jacobian(offset, normal)
        weight = 1 / (1 + (error / RESIDUAL_M) ** 2) / RESIDUAL_M**2
        H = (J.T * weight) @ J
        to_prior, squared = prior.difference(pose)
        information = prior.information / PRIOR_INFLATION**2 / (1 + squared / PRIOR_SCALE**2)
        to_best = -np.linalg.solve(H + 1e-6 * np.eye(3), (J.T * weight) @ error)
        before, pose = pose, _fuse(pose, H, to_best, information, to_prior)
    # A line that noise has tilted seems to show the place along itself (errors in variables).
    along = se2.displacement_jacobian(offset, se2.rotate(np.pi / 2, normal))
    shown = subtract_spurious(H, (along.T * weight * surface.elements.direction_variances[nearest]) @ along)
    pose = _fuse(before, shown, to_best, information, to_prior)
    matched = distance < MATCHED_M
    missed = np.where(matched, 0.0, MATCHED_M)
    missed[paired & matched] = error[matched[paired]]
    cost = np.log1p((missed / RESIDUAL_M) ** 2).sum() / 2 / CORRELATED_ELEMENTS
    cost += PRIOR_SCALE**2 * np.log1p(prior.difference(pose)[1] / PRIOR_SCALE**2) / 2
    covariance = np.asarray(np.linalg.inv(shown + information + 1e-6 * np.eye(3)), float)
    return Registration(pose, shown, covariance, float(matched.mean()), float(cost))


def _fuse(pose: Array, by_scan: Array, to_best: Array, by_prior: Array, to_prior: Array) -> Array:
    """The ``pose`` (3,) moved to the mean of scan and prior, weighted by their information matrices (3, 3)."""
    weighted = by_scan @ to_best + by_prior @ to_prior
    fused = pose + np.linalg.solve(by_scan + by_prior + 1e-6 * np.eye(3), weighted)
    fused[2] = se2.wrap(fused[2])
    return np.asarray(fused)


def _features(elements: Elements) -> Array:
    return np.concatenate([elements.points, NORMAL_DIFFERENCE_M * elements.normals], axis=-1)
