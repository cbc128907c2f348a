"""The local map: the last key scans, in the local frame.

Point-to-line scan matching (Censi, ICRA 2008), to several scans instead of one, so that the error does not grow with
every scan. It gives the motion where the map does not show the surroundings.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from common.geometry import se2
from common.geometry.se2 import Array
from services.estimator.precise.gauss_newton import View, position_information
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.scan_surfaces import MIN_BEAMS

MAX_SCANS = 12  # in the local map
MIN_DISTANCE_M, MIN_TURN_RAD = 0.25, 0.35  # a key scan is taken after a motion of either size
CELL_M = 0.05  # points within one cell are averaged
NEIGHBOURS, NEIGHBOUR_RADIUS_M = 10, 0.3  # points from which the normal of a surface is estimated
# Largest distance to a point's partner, iteration by iteration.
PARTNER_RADII_M = (0.6, 0.6, 0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1)
CAUCHY_SCALE_M = 0.02  # of the Cauchy weight of a point by its distance from the line
MATCHED_RADIUS_M = 0.08  # a point is matched if it is this near to one of the local map
# A point is on a surface seen before if it is this near to a point of the local map, since neighbouring beams are so
# far apart on a distant surface, ...
SEEN_RADIUS_M = 0.15
# ... and this near to the line through that point, if there are enough neighbours for a line. Three standard deviations
# of the noise are added in quadrature. A wider tolerance takes much of another room for this one.
SEEN_ACROSS_M = 0.05
MIN_POINTS = 20  # of a scan that must have a partner in the local map
MAX_SQUARED_DISTANCE = 4.0  # squared standard deviations of the result from the prior
CHANGE_MEMORY_S = 30.0  # after which a change of the surroundings counts by 1 / e (a guess)
PASSED_M = 0.3  # a beam that is longer by this than the distance to a surface has passed through it
MIN_MATCHED_FRACTION = 0.5  # of a scan's points, else there is no match
CLEAR_MATCHED_FRACTION = 0.8  # if fewer match, matching is repeated from `EXTRA_HEADINGS_RAD`
EXTRA_HEADINGS_RAD = np.array([-0.3, -0.15, 0.15, 0.3])
DRIFT_PER_SCAN = np.array([0.02, 0.02, 0.005])  # m, m, rad: standard deviation that each key scan contributes
MIN_MATCH_INFORMATION_RATIO = 0.02  # a direction is unobserved if its information, divided by that across it, is less


@dataclass(frozen=True)
class Match:
    """Pose of a scan in the local map."""

    pose: Array  # (3,) base_link in the local frame
    covariance: Array  # (3, 3) of x, y, yaw, relative to the key scans
    matched_fraction: float  # of the scan's points
    score: float  # mean weight of the scan's points, higher for closer matches
    degenerate: bool  # the points have almost no information along some direction


@dataclass(frozen=True)
class LocalScan:
    """A scan with its pose in the local frame."""

    pose: Array  # (3,) base_link in the local frame
    view: View

    @property
    def points(self) -> Array:
        """End points (K, 2) of the beams that returned, m in the local frame."""
        return se2.transform(se2.compose(self.pose, self.view.mount), self.view.points)


@dataclass(frozen=True)
class LocalMapScan(LocalScan):
    """A key scan of the local map."""

    # (B,) beams that are no evidence: they end at surfaces seen before, at ones that have just appeared (which count as
    # a change), or at ones with fewer than MIN_BEAMS beams
    ignored: npt.NDArray[np.bool_]
    mapped: npt.NDArray[np.bool_]  # (B,) beams that end at surfaces of the map
    log_change: float  # nats, log probability of what had changed since the scan before
    log_unknown: float  # nats, evidence before this scan that the robot is at none of the hypotheses


@dataclass
class ChangeRate:
    """Rate at which surfaces in view vanish or appear, learned while driving.

    The rate has a gamma distribution, so the number of changes in a given time has a negative binomial distribution.
    Its shape is Jeffreys' 0.5 plus the remembered changes, its rate parameter always `CHANGE_MEMORY_S`, as if there had
    been that long a time without a change before the first scan. Periods must be much shorter.
    """

    remembered: float = 0.0  # changes, forgotten exponentially
    _remembered_before: float = 0.0  # without the changes learned last

    def log_probability(self, changes: int, period: float) -> float:
        """Log probability in nats of a number of changes within ``period`` s."""
        shape, share = 0.5 + self.remembered, period / (CHANGE_MEMORY_S + period)
        combinations = math.lgamma(shape + changes) - math.lgamma(shape) - math.lgamma(changes + 1)
        return combinations + shape * math.log1p(-share) + changes * math.log(share)

    def learn(self, changes: int, period: float) -> None:
        """Learns from a number of changes within ``period`` s, and forgets earlier ones exponentially."""
        self._remembered_before = math.exp(-period / CHANGE_MEMORY_S) * self.remembered
        self.remembered = self._remembered_before + changes

    def forget_latest(self) -> None:
        """Forgets the changes learned last, because the robot was carried: nothing around it has changed."""
        self.remembered = self._remembered_before


@dataclass
class LocalMap:
    """The last key scans in a local frame. Localisation in the map moves this frame, and all scans with it."""

    scans: deque[LocalMapScan] = field(default_factory=lambda: deque(maxlen=MAX_SCANS))
    frame: Array = field(default_factory=lambda: np.zeros(3))  # (3,) local frame in map
    # (3, 3) of the pose in map at the last key scan, with the drift that this scan contributes
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    _tree: cKDTree | None = None
    _unmapped: cKDTree | None = None  # of the points that are not on surfaces of the map
    _points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    _normals: Array | None = None

    def clear(self) -> None:
        """Removes all scans."""
        self.scans.clear()
        self._tree = self._unmapped = None

    def to_local(self, pose: Array) -> Array:
        """A pose (3,) in map, in the local frame."""
        return se2.between(self.frame, pose)

    def place(self, local: Array, pose: Array) -> None:
        """Moves the local frame so that ``local`` (3,) is at ``pose`` (3,) in map."""
        self.frame = se2.compose(pose, se2.inverse(local))

    def is_key_scan_due(self, local: Array) -> bool:
        """Whether ``local`` (3,) is so far from the last key scan that the scan there becomes a key scan."""
        return not self.scans or is_key_pose(self.scans[-1].pose, local)

    def add(self, key: LocalMapScan, pose: Array, covariance: Array) -> None:
        """Adds a key scan, taken at ``pose`` (3,) in map with ``covariance`` (3, 3)."""
        self.scans.append(key)
        self.place(key.pose, pose)
        self.covariance = covariance + np.diag(DRIFT_PER_SCAN**2)
        self._tree = self._unmapped = None

    def find_seen_and_appeared(
        self, local: Array, view: View, mapped: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Masks (B,) of two kinds of beams of a scan at ``local`` (3,).

        - Seen before: they end at surfaces of the key scans. Beams without return also count as seen once there are key
          scans. A beam that does not end at a surface of the map (``mapped`` (B,) is false) only counts as seen near a
          point of a key scan that does not either.
        - Appeared: they end where a key scan saw free space, so the surface came since then, wherever the robot is.
        """
        seen, appeared = np.zeros(len(view.ranges), np.bool_), np.zeros(len(view.ranges), np.bool_)
        if not self.scans or not len(self._tree_of_points().data):
            return seen, appeared
        placed = LocalScan(local, view).points
        noise = view.likelihood.deviation(view.ranges[view.returned])
        near = self._is_on_surface(placed, np.hypot(SEEN_ACROSS_M, 3 * noise))
        free = np.zeros(len(near), np.bool_)
        free[~near] = self._in_free_space(placed[~near])
        appeared[view.returned] = free
        unmapped = near & ~mapped[view.returned]
        distance, _ = self._tree_of_unmapped_points().query(placed[unmapped], distance_upper_bound=SEEN_RADIUS_M)
        near[unmapped] = np.isfinite(distance)
        seen[:] = ~view.returned
        seen[view.returned] = near
        return seen, appeared

    def _is_on_surface(self, points: Array, tolerance: Array) -> npt.NDArray[np.bool_]:
        """Mask (K,) of local points (K, 2) m within ``tolerance`` (K,) m of the line through a point of a key scan."""
        normals = self._normals_of_points()
        distance, nearest = self._tree_of_points().query(points, distance_upper_bound=SEEN_RADIUS_M)
        near = np.isfinite(distance)
        off = points[near] - self._points[nearest[near]]
        across = np.full(len(points), np.inf)
        across[near] = np.abs(np.einsum("ni,ni->n", normals[nearest[near]], off))
        return np.asarray(across < tolerance)

    def _in_free_space(self, points: Array) -> npt.NDArray[np.bool_]:
        """Mask (K,) of local points (K, 2) in m that a beam of a key scan passed."""
        free = np.zeros(len(points), np.bool_)
        for key in self.scans if len(points) else ():
            free |= _passed(key, points, SEEN_RADIUS_M)
        return free

    def match(self, starts: Array, view: View, prior: MotionCandidate) -> Match | None:
        """Returns the pose at which a scan matches the key scans, or None if no pose matches.

        ``starts`` (N, 3) and ``prior`` are poses in the local frame.
        """
        if not self.scans or len(view.points) < MIN_POINTS:
            return None
        found = self._best_match(starts, view, prior)
        if found is None or found.matched_fraction < CLEAR_MATCHED_FRACTION:
            turned = np.repeat(starts[:1], len(EXTRA_HEADINGS_RAD), axis=0)
            turned[:, 2] = se2.wrap(turned[:, 2] + EXTRA_HEADINGS_RAD)
            again = self._best_match(turned, view, prior)
            if again is not None and (found is None or again.score > found.score):
                found = again
        return None if found is None or found.matched_fraction < MIN_MATCHED_FRACTION or found.degenerate else found

    def candidate(self, match: Match) -> MotionCandidate:
        """The pose in map that a match gives."""
        turn = se2.rotation(float(self.frame[2]))
        covariance = self.covariance + turn @ match.covariance @ turn.T
        return MotionCandidate(se2.compose(self.frame, match.pose), covariance, 1.0)

    def _best_match(self, starts: Array, view: View, prior: MotionCandidate) -> Match | None:
        information = np.asarray(np.linalg.inv(prior.covariance), float)
        found = [self._register(start, view, prior.mean, information) for start in starts]
        plausible = [
            each for each in found if each is not None and prior.squared_distance(each.pose) < MAX_SQUARED_DISTANCE
        ]
        return max(plausible, key=lambda each: each.score, default=None)

    def _tree_of_points(self) -> cKDTree:
        """Index of the points of all scans; kept until the scans change."""
        if self._tree is None:
            self._points = _average_in_cells(np.concatenate([each.points for each in self.scans]))
            self._normals = None
            self._tree = cKDTree(self._points)
        return self._tree

    def _tree_of_unmapped_points(self) -> cKDTree:
        """Index of the points of all scans that are not on surfaces of the map; kept until the scans change."""
        if self._unmapped is None:
            unmapped = [each.points[~each.mapped[each.view.returned]] for each in self.scans]
            self._unmapped = cKDTree(np.concatenate(unmapped))
        return self._unmapped

    def _normals_of_points(self) -> Array:
        """Normals (K, 2) of the surfaces at all points; 0 where there are too few neighbours."""
        if self._normals is None:
            _, neighbour = self._tree_of_points().query(
                self._points, NEIGHBOURS, distance_upper_bound=NEIGHBOUR_RADIUS_M
            )
            exists = neighbour < len(self._points)
            around = self._points[np.where(exists, neighbour, np.arange(len(neighbour))[:, None])]
            off = around - around.mean(axis=1, keepdims=True)
            _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
            self._normals = np.asarray(vectors[:, :, 0] * (exists.sum(axis=1) > 2)[:, None])
        return self._normals

    def _register(self, start: Array, view: View, mean: Array, information: Array) -> Match | None:
        """Registers a scan by iteratively reweighted Gauss-Newton, with a Gaussian prior.

        Returns None if too few points have a partner.
        """
        tree, normals = self._tree_of_points(), self._normals_of_points()
        pose = np.array(start)
        for radius in PARTNER_RADII_M:
            placed = LocalScan(pose, view).points
            distance, partner = tree.query(placed, distance_upper_bound=radius)
            paired = np.isfinite(distance)
            if paired.sum() < MIN_POINTS:
                return None
            normal, target = normals[partner[paired]], self._points[partner[paired]]
            error = np.einsum("ni,ni->n", normal, placed[paired] - target)
            arm = placed[paired] - pose[:2]
            J = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
            weight = 1 / (1 + (error / CAUCHY_SCALE_M) ** 2)
            H = (J.T * weight) @ J
            to_prior = se2.difference(mean, pose)
            step = np.linalg.solve(
                H + CAUCHY_SCALE_M**2 * information,
                CAUCHY_SCALE_M**2 * information @ to_prior - (J.T * weight) @ error,
            )
            pose = pose + step
            pose[2] = se2.wrap(pose[2])
        placed = LocalScan(pose, view).points
        distance, partner = tree.query(placed)
        error = np.einsum("ni,ni->n", normals[partner], placed - self._points[partner])
        score = ((distance < 2 * MATCHED_RADIUS_M) / (1 + (error / CAUCHY_SCALE_M) ** 2)).mean()
        covariance = np.asarray(CAUCHY_SCALE_M**2 * np.linalg.inv(H + 1e-6 * np.eye(3)), float)
        return Match(pose, covariance, float((distance < MATCHED_RADIUS_M).mean()), float(score), _is_degenerate(H))


def count_changes(last: LocalScan, now: LocalScan) -> int:
    """Number of surfaces of which most beams vanished or appeared between two scans."""
    return _count_passed(last, now) + _count_passed(now, last)


def _count_passed(seen: LocalScan, by: LocalScan) -> int:
    """Number of surfaces in the scan ``seen`` of which more than half of the points are passed by beams of ``by``."""
    passed = _passed(by, seen.points, PASSED_M)
    surface = np.cumsum(seen.view.surfaces.starts)[seen.view.returned]
    beams, passed_beams = np.bincount(surface), np.bincount(surface, passed)
    return int(((passed_beams >= MIN_BEAMS) & (passed_beams > 0.5 * beams)).sum())


def is_key_pose(last: Array, pose: Array) -> bool:
    """Whether ``pose`` (3,) is so far from that of the ``last`` (3,) key scan that a key scan is due there."""
    motion = se2.between(last, pose)
    return bool(np.hypot(motion[0], motion[1]) >= MIN_DISTANCE_M or abs(motion[2]) >= MIN_TURN_RAD)


def _average_in_cells(points: Array) -> Array:
    """Replaces points (K, 2) by their mean in every cell of `CELL_M`.

    The means are less noisy, and the neighbours used for a normal lie farther apart than the noise.
    """
    column, row = np.floor(points / CELL_M).astype(np.int64).T
    _, cell = np.unique(column * 2**32 + row, return_inverse=True)
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, points[:, k]) / count for k in (0, 1)], axis=-1)


def _is_degenerate(H: Array) -> bool:
    low, high = np.linalg.eigvalsh(position_information(H))
    return bool(low < MIN_MATCH_INFORMATION_RATIO * high)


def _passed(scan: LocalScan, points: Array, distance: float) -> npt.NDArray[np.bool_]:
    """Mask (K,) of the local points (K, 2) m that beams of the scan pass by more than ``distance`` m."""
    ranges, beam, inside = _beams_towards(scan.view, se2.compose(scan.pose, scan.view.mount), points)
    return np.asarray(inside & (scan.view.nearest_of_neighbours[beam] > ranges + distance))


def _beams_towards(
    view: View, laser: Array, points: Array
) -> tuple[Array, npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Distances (K,) in m of points (K, 2) from a laser pose, their beams (K,), and whether they are in its view."""
    local = se2.transform(se2.inverse(laser), points)
    order, angles = view.sorted_beams
    turned = angles[0] + (np.arctan2(local[:, 1], local[:, 0]) - angles[0]) % (2 * np.pi)
    place = np.searchsorted((angles[1:] + angles[:-1]) / 2, turned)
    inside = (place > 0) & (place < len(angles) - 1)
    return np.hypot(*local.T), np.where(inside, order[place], 0), inside
