"""Points on the surfaces of several scans, to which another scan is matched.

Point-to-line scan matching (Censi, ICRA 2008). Tilted lines add spurious information (errors in variables), which is
subtracted. Surfaces that the map lacks may have moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from common.geometry import se2
from common.geometry.information import subtract_spurious
from common.geometry.se2 import Array
from services.estimator.precise.gauss_newton import position_information
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.scan_likelihood import ScanLikelihood

CELL_M = 0.05  # points within one cell are averaged
NEIGHBOURS, NEIGHBOUR_RADIUS_M = 10, 0.3  # points through which the line along a surface is fitted
# Largest distance to the corresponding point, iteration by iteration.
CORRESPONDENCE_RADII_M = (0.6, 0.6, 0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1)
CAUCHY_SCALE_M = 0.02  # standard deviation of a point's distance from its line, and scale of its Cauchy weight
MATCHED_RADIUS_M = 0.08  # a point is matched if it is this near to one of another scan
MIN_POINTS = 20  # of a scan that must have a corresponding point
MIN_INFORMATION_RATIO = 0.02  # a direction is unobserved if its information, divided by that across it, is less
# Weight of all points in the choice of the weakest direction, which they decide if there are no fixed points
TIE_BREAK = 1e-3


@dataclass(frozen=True)
class Match:
    """Pose of a scan among the points, and the information about it, by m and rad."""

    pose: Array  # (3,) base_link in the frame of the points
    information: Array  # (3, 3)
    matched_fraction: float  # of the scan's points
    score: float  # mean weight of the scan's points, higher for closer matches
    degenerate: bool  # the points have almost no information along some direction
    # From the points on surfaces of the map, without the spurious information of tilted lines:
    fixed_information: Array  # (3, 3)
    fixed_step: Array  # (3,) towards the pose that fits them best, of one Gauss-Newton iteration
    movable_surfaces: int  # those that the map lacks, and that show the direction which the fixed points show worst

    def moved_probability(self, moves: float, motion_cost: float) -> float:
        """Probability that all movable surfaces have moved, instead of none; 1 if there are none.

        Each moves with probability ``moves``. If none has, the robot has moved as the match shows, which is
        ``motion_cost`` nats less probable than how it has moved otherwise.
        """
        return float(expit(logit(moves**self.movable_surfaces) + motion_cost))

    def covariance(self, if_moved: Array, moved_probability: float) -> Array:
        """Covariance (3, 3) of the pose.

        It is that of a mixture: all movable surfaces have moved, with ``moved_probability``, or none. If they have, or
        there are none, it follows from the fixed points and from ``if_moved`` (3, 3), the mean squared error of the
        pose without a match.
        """
        covariance = np.linalg.inv(self.information + 1e-6 / CAUCHY_SCALE_M**2 * np.eye(3))
        by_fixed = np.linalg.inv(self.fixed_information + np.linalg.inv(if_moved))
        squared_error = by_fixed + np.outer(self.fixed_step, self.fixed_step)
        return np.asarray((1 - moved_probability) * covariance + moved_probability * squared_error)


@dataclass(frozen=True)
class SurfacePoints:
    """The points of several scans, averaged in cells."""

    points: Array  # (K, 2) m
    mapped: npt.NDArray[np.bool_]  # (K,) whether the surface is in the map
    normals: Array  # (K, 2) of the line through the neighbours of a point; 0 where there are too few
    # (K,) rad², variance of the direction of that line: the neighbours' variance across it, divided by that along it.
    # Their number does not matter, because near a corner they lie off the line systematically.
    direction_variances: Array
    tree: cKDTree

    @classmethod
    def of(cls, points: Array, mapped: npt.NDArray[np.bool_]) -> SurfacePoints:
        """Averages the points (N, 2) m, ``mapped`` (N,) of which are on surfaces of the map."""
        means = _average_in_cells(np.column_stack([points, mapped]))
        points, mapped = means[:, :2], means[:, 2] > 0.5
        tree = cKDTree(points)
        _, neighbour = tree.query(points, NEIGHBOURS, distance_upper_bound=NEIGHBOUR_RADIUS_M)
        exists = neighbour < len(points)
        around = points[np.where(exists, neighbour, np.arange(len(neighbour))[:, None])]
        off = around - around.mean(axis=1, keepdims=True)
        squares, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
        line = exists.sum(axis=1) > 2
        variances = np.zeros(len(points))
        variances[line] = squares[line, 0] / squares[line, 1]
        return cls(points, mapped, np.asarray(vectors[:, :, 0] * line[:, None]), variances, tree)

    def match(self, start: Array, scan: ScanLikelihood, prior: MotionCandidate) -> Match | None:
        """Matches a scan by iteratively reweighted Gauss-Newton from the pose ``start`` (3,).

        Returns None if too few points have a corresponding one.
        """
        prior_information = CAUCHY_SCALE_M**2 * np.linalg.inv(prior.covariance)
        pose = np.array(start)
        for radius in CORRESPONDENCE_RADII_M:
            placed = place_points(scan, pose)
            distance, nearest = self.tree.query(placed, distance_upper_bound=radius)
            paired = np.isfinite(distance)
            if paired.sum() < MIN_POINTS:
                return None
            index = nearest[paired]
            error = self._distance_from_line(placed[paired], index)
            offset = placed[paired] - pose[:2]
            J = se2.displacement_jacobian(offset, self.normals[index])
            weight = 1 / (1 + (error / CAUCHY_SCALE_M) ** 2)
            H = (J.T * weight) @ J
            pull = prior_information @ se2.difference(prior.mean, pose) - (J.T * weight) @ error
            step = np.linalg.solve(H + prior_information, pull)
            pose = pose + step
            pose[2] = se2.wrap(pose[2])
        placed = place_points(scan, pose)
        distance, nearest = self.tree.query(placed)
        error = self._distance_from_line(placed, nearest)
        score = ((distance < 2 * MATCHED_RADIUS_M) / (1 + (error / CAUCHY_SCALE_M) ** 2)).mean()
        matched_fraction = float((distance < MATCHED_RADIUS_M).mean())
        low, high = np.linalg.eigvalsh(position_information(H))
        fixed = self.mapped[index]
        of_fixed = (J[fixed].T * weight[fixed]) @ J[fixed]
        pull = -J[fixed].T @ (weight * self._distance_from_line(placed[paired], index))[fixed]
        # A tilted line adds information along itself.
        along = se2.displacement_jacobian(offset, se2.rotate(np.pi / 2, self.normals[index]))
        spurious = weight * self.direction_variances[index]
        shown_by_fixed = subtract_spurious(of_fixed, (along[fixed].T * spurious[fixed]) @ along[fixed])
        weakest = np.linalg.eigh(position_information(shown_by_fixed + TIE_BREAK * H))[1][:, 0]
        shown = weight * (J[:, :2] @ weakest) ** 2 - spurious * (along[:, :2] @ weakest) ** 2
        surface = np.cumsum(scan.surfaces.starts)[scan.returned][paired]
        movable = np.bincount(surface[~fixed], shown[~fixed]) > MIN_INFORMATION_RATIO * high
        return Match(
            pose,
            H / CAUCHY_SCALE_M**2,
            matched_fraction,
            float(score),
            bool(low <= MIN_INFORMATION_RATIO * high),
            shown_by_fixed / CAUCHY_SCALE_M**2,
            np.linalg.solve(of_fixed + prior_information, pull),
            int(movable.sum()),
        )

    def find_near(self, points: Array, radius: float, tolerance: Array) -> npt.NDArray[np.bool_]:
        """Mask (N,) of points (N, 2) m near one of these, and within ``tolerance`` (N,) m of the line through it."""
        distance, nearest = self.tree.query(points, distance_upper_bound=radius)
        near = np.isfinite(distance)
        across = np.full(len(points), np.inf)
        across[near] = np.abs(self._distance_from_line(points[near], nearest[near]))
        return np.asarray(across < tolerance)

    def _distance_from_line(self, points: Array, index: npt.NDArray[np.intp]) -> Array:
        """Signed distance (N,) m of points (N, 2) from the lines through the points with these indices (N,)."""
        return np.asarray(np.einsum("ni,ni->n", self.normals[index], points - self.points[index]))


def place_points(scan: ScanLikelihood, pose: Array) -> Array:
    """End points (K, 2) m of the beams of a scan that returned, with base_link at ``pose`` (3,)."""
    return se2.transform(se2.compose(pose, scan.mount), scan.points)


def _average_in_cells(points: Array) -> Array:
    """Replaces points (K, N), of which x and y come first, by their mean in every cell of `CELL_M`.

    The means are less noisy, and the neighbours used for a line lie farther apart than the noise.
    """
    column, row = np.floor(points[:, :2] / CELL_M).astype(np.int64).T
    _, cell = np.unique(column * 2**32 + row, return_inverse=True)
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, values) / count for values in points.T], axis=-1)
