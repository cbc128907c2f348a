"""Clusters of particles, as nav2's pf_kdtree_cluster forms them."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.particle_filter.resampling import BIN_OFFSET, HEADING_BINS, bins
from services.estimator.shared.interface import Hypothesis

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

NEGLIGIBLE_WEIGHT = 1e-3  # the lightest particles, with this share of the total weight, are left out
MAX_CLUSTERS = 8  # reported
# m, m, rad, squared: a cloud that collapsed onto one particle has no spread, but its pose is not known exactly.
MIN_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3]) ** 2
# Half of the 26 neighbours in x, y, heading, (13, 3, 1), so that each pair occurs once.
NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)])[..., None]


def labels(poses: Array) -> npt.NDArray[np.int64]:
    """Cluster index (N,) of each pose (N, 3).

    Poses in bins that touch, also at corners or with headings across pi, are in one cluster.
    """
    occupied, of_pose = np.unique(bins(poses), return_inverse=True)
    xy, yaw = np.divmod(occupied, HEADING_BINS)
    beside = (xy + NEIGHBOURS[:, 0] * 2 * BIN_OFFSET + NEIGHBOURS[:, 1]) * HEADING_BINS
    beside = beside + (yaw + NEIGHBOURS[:, 2]) % HEADING_BINS
    index = np.minimum(np.searchsorted(occupied, beside), len(occupied) - 1)
    offset, a = np.nonzero(occupied[index] == beside)
    b = index[offset, a]
    # Every bin takes the smallest label among its neighbours, and then the label of that bin, until none changes.
    label = np.arange(len(occupied))
    while True:
        before = label.copy()
        np.minimum.at(label, a, before[b])
        np.minimum.at(label, b, before[a])
        label = label[label]
        if np.array_equal(label, before):
            return np.asarray(label[of_pose], np.int64)


def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of poses (N, 3) with weights (N,); headings are averaged on the circle."""
    w = weights / weights.sum()
    yaw = np.arctan2(w @ np.sin(poses[:, 2]), w @ np.cos(poses[:, 2]))
    mean = np.array([w @ poses[:, 0], w @ poses[:, 1], yaw])
    off = se2.difference(poses, mean)
    return mean, np.asarray((off * w[:, None]).T @ off)


def cluster_hypotheses(poses: Array, weights: Array) -> tuple[Hypothesis, ...]:
    """The heaviest clusters of weighted poses, at most `MAX_CLUSTERS`, heaviest first; their weights sum to 1."""
    order = np.argsort(weights, kind="stable")
    kept = order[np.searchsorted(np.cumsum(weights[order]), NEGLIGIBLE_WEIGHT * weights.sum()) :]
    poses, weights = poses[kept], weights[kept]
    names, of_pose = np.unique(labels(poses), return_inverse=True)
    mass = np.bincount(of_pose, weights, len(names))
    heaviest = np.argsort(-mass, kind="stable")[:MAX_CLUSTERS]
    total = float(mass[heaviest].sum())
    found = []
    for name in heaviest:
        mean, covariance = moments(poses[of_pose == name], weights[of_pose == name])
        found.append(Hypothesis(mean, covariance + MIN_COVARIANCE, float(mass[name]) / total))
    return tuple(found)
