"""Registration of surface elements: the pose at which a scan continues a map.

Point-to-line iterative closest point (Censi, ICRA 2008) with a Gaussian prior. Partners are nearest in position and
direction together, so that a surface is never matched with its back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from common.geometry import se2
from common.geometry.se2 import Array
from presage.mapping.elements import Elements

TURN_M = 0.3  # distance that a difference of 1 between two unit normals counts as
PARTNER_RADII_M = (0.6, 0.6, 0.5, 0.4, 0.3, 0.2, 0.2, 0.2)  # largest distance of partners, iteration by iteration
SCALE_M = 0.03  # standard deviation of the distance between partners, and scale of the Cauchy weights
PRIOR_SCALE = 2.0  # standard deviations, of the prior's Cauchy weight: wheels slip
MATCHED_M = 0.15  # an element whose partner is nearer than this is matched
MIN_PARTNERS = 10


@dataclass
class Surface:
    """Elements that others are registered to."""

    elements: Elements
    tree: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        self.tree = cKDTree(_features(self.elements))

    def distances(self, elements: Elements, most: float = MATCHED_M) -> Array:
        """Distance (K,) in m of each element from its partner, with differences of direction; inf beyond ``most``."""
        return np.asarray(self.tree.query(_features(elements), distance_upper_bound=most)[0])


@dataclass(frozen=True)
class Registration:
    """Pose of a scan in the frame of a surface."""

    pose: Array  # (3,)
    information: Array  # (3, 3) of the scan alone, without the prior
    share: float  # of the elements that are matched


def register(
    surface: Surface,
    elements: Elements,
    start: Array,
    information: Array | None = None,
    radii: tuple[float, ...] = PARTNER_RADII_M,
) -> Registration | None:
    """Registers elements from ``start`` (3,), the mean of a prior; None if too few match."""
    pose, prior = np.array(start, float), np.zeros((3, 3)) if information is None else information
    for radius in radii:
        placed = elements.moved(pose)
        distance, partner = surface.tree.query(_features(placed), distance_upper_bound=radius)
        paired = np.isfinite(distance)
        if paired.sum() < MIN_PARTNERS:
            return None
        partner = partner[paired]
        normal = surface.elements.normals[partner]
        error = np.einsum("ni,ni->n", normal, placed.points[paired] - surface.elements.points[partner])
        arm = placed.points[paired] - pose[:2]
        J = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
        weight = 1 / (1 + (error / SCALE_M) ** 2) / SCALE_M**2
        H = (J.T * weight) @ J
        off = start - pose
        off[2] = se2.wrap(off[2])
        held = prior / (1 + off @ prior @ off / PRIOR_SCALE**2)
        step = np.linalg.solve(H + held + 1e-6 * np.eye(3), held @ off - (J.T * weight) @ error)
        pose = pose + step
        pose[2] = se2.wrap(pose[2])
    return Registration(pose, H, float((distance < MATCHED_M).mean()))


def _features(elements: Elements) -> Array:
    return np.concatenate([elements.points, TURN_M * elements.normals], axis=-1)
