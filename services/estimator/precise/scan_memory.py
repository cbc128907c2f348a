"""Matches a scan against the last few scans.

Scan matching by the distance of points to lines (Censi, ICRA 2008), with the points of several scans instead of one, so
that the error does not grow with every scan. It holds the belief where the model does not know the surroundings: in a
room that was never learned, behind a door that was shut, among furniture that was moved.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from common.geometry import se2
from common.geometry.se2 import Array
from services.estimator.precise.gauss_newton import difference, position_information
from services.estimator.precise.motion_model import Candidate

MAX_SCANS = 8  # in the local map
MIN_DISTANCE_M, MIN_TURN_RAD = 0.25, 0.35  # from the last scan of the local map, before another one is added
CELL_M = 0.05
NEIGHBOURS, NEIGHBOUR_RADIUS_M = 10, 0.3  # points from which the normal of a surface is estimated
# Largest distance to a point's partner, iteration by iteration.
PARTNER_RADII_M = (0.6, 0.6, 0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1)
CAUCHY_SCALE_M = 0.02
SEEN_RADIUS_M = 0.08  # a point with a neighbour within this distance was seen before
MIN_POINTS = 20
MAX_SQUARED_DISTANCE = 4.0  # squared standard deviations of the result from the prior
MIN_INFORMATION_RATIO = 0.02  # a direction with less information, as a share of that across it, is unobserved


@dataclass(frozen=True)
class Match:
    """Pose of a scan relative to the scans before it."""

    pose: Array  # (3,) base_link, in the frame of the stored scans
    covariance: Array  # (3, 3) of x, y, yaw, relative to the stored scans
    share: float  # of the scan's points that were seen before
    score: float  # mean weight of the scan's points, higher for closer matches
    degenerate: bool  # the points have almost no information along some direction


@dataclass
class RecentScans:
    """A local map: the points of the last scans at the poses believed then."""

    mount: Array  # (3,) laser in base_link
    _scans: deque[tuple[Array, Array]] = field(default_factory=lambda: deque(maxlen=MAX_SCANS))
    _tree: cKDTree | None = None
    _points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    _normals: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def empty(self) -> bool:
        """Whether no scan is stored."""
        return not self._scans

    def clear(self) -> None:
        """Removes all scans."""
        self._scans.clear()
        self._tree = None

    def add(self, pose: Array, points: Array) -> bool:
        """Adds a scan, points (K, 2) m in the laser frame, taken at ``pose`` (3,).

        Returns False, and does nothing, if it has too few points or was taken too near the last one.
        """
        if len(points) < MIN_POINTS:
            return False
        if self._scans:
            off = se2.between(self._scans[-1][0], pose)
            if np.hypot(off[0], off[1]) < MIN_DISTANCE_M and abs(off[2]) < MIN_TURN_RAD:
                return False
        self._scans.append((np.array(pose), points))
        self._tree = None
        return True

    def match(self, starts: Array, points: Array, prior: Candidate) -> Match | None:
        """Returns the best match from base_link poses (N, 3); None if there are too few points to compare."""
        if not self._scans or len(points) < MIN_POINTS:
            return None
        information = np.asarray(np.linalg.inv(prior.covariance), float)
        found = [self._descend(start, points, prior.mean, information) for start in starts]
        plausible = [
            each for each in found if each is not None and prior.squared_distance(each.pose) < MAX_SQUARED_DISTANCE
        ]
        return max(plausible, key=lambda each: each.score, default=None)

    def _build_tree(self) -> cKDTree:
        """Indexes the points of all scans and estimates their normals; kept until the scans change."""
        if self._tree is not None:
            return self._tree
        self._points = _average_in_cells(
            np.concatenate([se2.transform(se2.compose(pose, self.mount), points) for pose, points in self._scans])
        )
        self._tree = cKDTree(self._points)
        _, neighbour = self._tree.query(self._points, NEIGHBOURS, distance_upper_bound=NEIGHBOUR_RADIUS_M)
        exists = neighbour < len(self._points)
        around = self._points[np.where(exists, neighbour, np.arange(len(neighbour))[:, None])]
        off = around - around.mean(axis=1, keepdims=True)
        _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
        self._normals = vectors[:, :, 0] * (exists.sum(axis=1) > 2)[:, None]
        return self._tree

    def _descend(self, start: Array, points: Array, mean: Array, information: Array) -> Match | None:
        tree = self._build_tree()
        pose, H = np.array(start), np.eye(3)
        for radius in PARTNER_RADII_M:
            placed = se2.transform(se2.compose(pose, self.mount), points)
            distance, partner = tree.query(placed, distance_upper_bound=radius)
            paired = np.isfinite(distance)
            if paired.sum() < MIN_POINTS:
                return None
            normal, target = self._normals[partner[paired]], self._points[partner[paired]]
            error = np.einsum("ni,ni->n", normal, placed[paired] - target)
            arm = placed[paired] - pose[:2]
            J = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
            weight = 1 / (1 + (error / CAUCHY_SCALE_M) ** 2)
            H = (J.T * weight) @ J
            to_prior = difference(mean[None], pose[None])[0]
            step = np.linalg.solve(
                H + CAUCHY_SCALE_M**2 * information,
                CAUCHY_SCALE_M**2 * information @ to_prior - (J.T * weight) @ error,
            )
            pose = pose + step
            pose[2] = se2.wrap(pose[2])
        placed = se2.transform(se2.compose(pose, self.mount), points)
        distance, partner = tree.query(placed)
        error = np.einsum("ni,ni->n", self._normals[partner], placed - self._points[partner])
        score = ((distance < 2 * SEEN_RADIUS_M) / (1 + (error / CAUCHY_SCALE_M) ** 2)).mean()
        covariance = np.asarray(CAUCHY_SCALE_M**2 * np.linalg.inv(H + 1e-6 * np.eye(3)), float)
        return Match(pose, covariance, float((distance < SEEN_RADIUS_M).mean()), float(score), _is_degenerate(H))


def _average_in_cells(points: Array) -> Array:
    """Replaces points (K, 2) by their mean in every cell of `CELL_M`.

    The means are less noisy, and the neighbours used for a normal lie farther apart than the noise.
    """
    _, cell = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, points[:, k]) / count for k in (0, 1)], axis=-1)


def _is_degenerate(H: Array) -> bool:
    low, high = np.linalg.eigvalsh(position_information(H))
    return bool(low < MIN_INFORMATION_RATIO * high)
