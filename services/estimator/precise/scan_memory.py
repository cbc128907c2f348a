"""Matches a scan against the last few scans.

Scan matching by the distance of points to lines (Censi, ICRA 2008), over the points of several scans rather than of
one, so that its errors do not add up with every scan. It holds the belief where the model knows nothing of what is
seen: a room that was never learned, a door that was shut, furniture that was moved.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from common.geometry import se2
from common.geometry.se2 import Array
from services.estimator.precise.gauss_newton import difference, of_position
from services.estimator.precise.motion_model import Candidate

KEPT = 8  # scans in the map
APART, TURNED = 0.25, 0.35  # m, rad: a scan from so far off is one more to keep
CELL = 0.05  # m
NEIGHBOURS, AROUND = 10, 0.3  # cells within that many metres that say how a surface runs
REACHES = (0.6, 0.6, 0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1)  # m to a point's partner, iteration by iteration
SCALE = 0.02  # m, of the Cauchy weights
MET = 0.08  # m, within which a point has been seen before
LEAST_POINTS = 20
FAR = 4.0  # squared standard deviations from where the robot may have gone: its speed is one
BLIND = 0.02  # of the information across, along a direction that is not seen


@dataclass(frozen=True)
class Match:
    """Where a scan lies among those before it."""

    pose: Array  # (3,) base_link in map
    covariance: Array  # (3, 3) of x, y, yaw, relative to the scans kept
    share: float  # of the scan's points that were seen before
    score: float  # how closely
    blind: bool  # along some direction it says next to nothing


@dataclass
class RecentScans:
    """The last scans at the poses believed then."""

    mount: Array  # (3,) laser in base_link
    _scans: deque[tuple[Array, Array]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _tree: cKDTree | None = None
    _points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    _normals: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def empty(self) -> bool:
        """Whether nothing is kept."""
        return not self._scans

    def forget(self) -> None:
        """Begin anew."""
        self._scans.clear()
        self._tree = None

    def keep(self, pose: Array, points: Array) -> bool:
        """One more scan, points (K, 2) m in the laser, seen from ``pose`` (3,), where it tells more than those kept."""
        if len(points) < LEAST_POINTS:
            return False
        if self._scans:
            off = se2.between(self._scans[-1][0], pose)
            if np.hypot(off[0], off[1]) < APART and abs(off[2]) < TURNED:
                return False
        self._scans.append((np.array(pose), points))
        self._tree = None
        return True

    def match(self, starts: Array, points: Array, prior: Candidate) -> Match | None:
        """The best of the descents from base_link poses (N, 3); None where too little is to compare."""
        if not self._scans or len(points) < LEAST_POINTS:
            return None
        information = np.asarray(np.linalg.inv(prior.covariance), float)
        found = [self._descend(start, points, prior.mean, information) for start in starts]
        within = [each for each in found if each is not None and prior.squared_distance(each.pose) < FAR]
        return max(within, key=lambda each: each.score, default=None)

    def _built(self) -> cKDTree:
        if self._tree is not None:
            return self._tree
        self._points = _thinned(
            np.concatenate([se2.transform(se2.compose(pose, self.mount), points) for pose, points in self._scans])
        )
        self._tree = cKDTree(self._points)
        _, near = self._tree.query(self._points, NEIGHBOURS, distance_upper_bound=AROUND)
        there = near < len(self._points)
        around = self._points[np.where(there, near, np.arange(len(near))[:, None])]
        off = around - around.mean(axis=1, keepdims=True)
        _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
        self._normals = vectors[:, :, 0] * (there.sum(axis=1) > 2)[:, None]
        return self._tree

    def _descend(self, start: Array, points: Array, mean: Array, information: Array) -> Match | None:
        tree = self._built()
        pose, H = np.array(start), np.eye(3)
        for reach in REACHES:
            laser = se2.compose(pose, self.mount)
            seen = se2.transform(laser, points)
            off, partner = tree.query(seen, distance_upper_bound=reach)
            met = np.isfinite(off)
            if met.sum() < LEAST_POINTS:
                return None
            normal, target = self._normals[partner[met]], self._points[partner[met]]
            error = np.einsum("ni,ni->n", normal, seen[met] - target)
            arm = seen[met] - pose[:2]
            J = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
            weight = 1 / (1 + (error / SCALE) ** 2)
            H = (J.T * weight) @ J
            back = difference(mean[None], pose[None])[0]
            step = np.linalg.solve(H + SCALE**2 * information, SCALE**2 * information @ back - (J.T * weight) @ error)
            pose = pose + step
            pose[2] = se2.wrap(pose[2])
        seen = se2.transform(se2.compose(pose, self.mount), points)
        off, partner = tree.query(seen)
        error = np.einsum("ni,ni->n", self._normals[partner], seen - self._points[partner])
        score = ((off < 2 * MET) / (1 + (error / SCALE) ** 2)).mean()
        covariance = np.asarray(SCALE**2 * np.linalg.inv(H + 1e-6 * np.eye(3)), float)
        return Match(pose, covariance, float((off < MET).mean()), float(score), _blind(H))


def _thinned(points: Array) -> Array:
    """The mean of points (K, 2) in every cell of `CELL` m: less noise, and neighbours that reach further than it."""
    _, cell = np.unique(np.floor(points / CELL).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, points[:, k]) / count for k in (0, 1)], axis=-1)


def _blind(H: Array) -> bool:
    low, high = np.linalg.eigvalsh(of_position(H))
    return bool(low < BLIND * high)
