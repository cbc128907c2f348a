"""The local map: the last key scans, in the local frame.

A scan is matched to several scans instead of one, so that the error does not grow with every scan. This gives the
motion where the map does not show the surroundings.
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
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.scan_surfaces import MIN_BEAMS
from services.estimator.precise.surface_points import MIN_POINTS, Match, SurfacePoints, place_points

MAX_SCANS = 12  # in the local map
KEY_DISTANCE_M, KEY_TURN_RAD = 0.25, 0.35  # a key scan is taken after a motion of either size
# A point was seen before if a point of the local map is within this radius (on a distant surface, neighbouring beams
# are so far apart), and if its distance from the surface there is below the second limit. Three standard deviations of
# the noise are added to that limit in quadrature. Without enough neighbours for a line, only the radius counts. With
# larger limits, much of another room would pass for this one.
SEEN_RADIUS_M, SEEN_ACROSS_M = 0.15, 0.05
MAX_SQUARED_MAHALANOBIS = 4.0  # of the result of a match from the prior
CHANGE_MEMORY_S = 30.0  # time constant with which changes of the surroundings are forgotten (a guess)
PRIOR_MOVED, PRIOR_STAYED = 1.0, 4.0  # pseudo-counts of surfaces that the map lacks (a guess)
COUNT_PERIOD_S = 1.0  # a surface that moved or stayed counts once in this time between two scans, else in proportion
# A beam that ends farther than this behind a surface has passed through it. Three standard deviations of the noise are
# added in quadrature.
PASSED_M = 0.1
MIN_MATCHED_FRACTION = 0.5  # of a scan's points, else there is no match
CLEAR_MATCHED_FRACTION = 0.8  # if fewer match, matching is repeated from `EXTRA_HEADINGS_RAD`
EXTRA_HEADINGS_RAD = np.array([-0.3, -0.15, 0.15, 0.3])
KEY_SCAN_DEVIATION = np.array([0.02, 0.02, 0.005])  # m, m, rad: standard deviation that a key scan adds to the pose


@dataclass(frozen=True)
class LocalScan:
    """A scan with its pose in the local frame."""

    pose: Array  # (3,) base_link in the local frame
    scan: ScanLikelihood

    @property
    def points(self) -> Array:
        """End points (K, 2) of the beams that returned, m in the local frame."""
        return place_points(self.scan, self.pose)


@dataclass(frozen=True)
class LocalMapScan(LocalScan):
    """A key scan of the local map."""

    # (B,) beams that are no evidence: they end at surfaces seen before, at ones that have just appeared (which count as
    # a change), or at ones with fewer than MIN_BEAMS beams
    ignored: npt.NDArray[np.bool_]
    mapped: npt.NDArray[np.bool_]  # (B,) beams that end at surfaces of the map, according to the best hypothesis
    tracked: bool  # whether the state was `tracking`
    log_change: float  # nats, log probability of what had changed since the scan before
    log_unknown: float  # nats, evidence, without this scan, that the robot is at none of the hypotheses
    # nats, evidence for a hypothesis that is found later: from this scan on, the robot is at this place of the map, but
    # until now it was at none of the hypotheses
    log_arrival: float

    @property
    def unmapped_points(self) -> Array:
        """End points (K, 2), m in the local frame, of the beams not known to end at surfaces of the map."""
        return self.points[~self.mapped[self.scan.returned]] if self.tracked else self.points


@dataclass
class ChangeRate:
    """Rate at which surfaces in view vanish or appear, learned while driving.

    The rate has a gamma distribution, so the number of changes in a given time has a negative binomial distribution.
    The gamma distribution's shape is 0.5 (Jeffreys' prior) plus the remembered changes. Its rate parameter is always
    `CHANGE_MEMORY_S`, as if that long a time without a change had come before the first scan. Valid for periods much
    shorter than that.
    """

    remembered: float = 0.0  # changes, forgotten exponentially

    def log_probability(self, changes: int, period: float) -> float:
        """Log probability in nats of a number of changes within ``period`` s."""
        shape, success = 0.5 + self.remembered, period / (CHANGE_MEMORY_S + period)
        combinations = math.lgamma(shape + changes) - math.lgamma(shape) - math.lgamma(changes + 1)
        return combinations + shape * math.log1p(-success) + changes * math.log(success)

    def learn(self, changes: int, period: float) -> None:
        """Learns from a number of changes within ``period`` s, and forgets earlier ones exponentially."""
        self.remembered = math.exp(-period / CHANGE_MEMORY_S) * self.remembered + changes


@dataclass
class MovedFraction:
    """Fraction of moving surfaces, such as people, among those that are not in the map; learned while driving.

    It has a beta distribution, whose parameters are counts of surfaces that return to the pseudo-counts of the prior
    with time. A surface is seen again and again, so it counts in proportion to the time between two scans: once if
    that is `COUNT_PERIOD_S` or more.
    """

    moved: float = PRIOR_MOVED
    stayed: float = PRIOR_STAYED

    @property
    def probability(self) -> float:
        """Probability that such a surface has moved since the last key scan."""
        return self.moved / (self.moved + self.stayed)

    def learn(self, moved: int, stayed: int, period: float) -> None:
        """Learns from the surfaces of a scan, ``period`` s after the last one, and forgets earlier ones."""
        kept = math.exp(-period / CHANGE_MEMORY_S)
        weight = min(1.0, period / COUNT_PERIOD_S)
        self.moved = kept * self.moved + (1 - kept) * PRIOR_MOVED + moved * weight
        self.stayed = kept * self.stayed + (1 - kept) * PRIOR_STAYED + stayed * weight


@dataclass
class LocalMap:
    """The last key scans in a local frame. Localisation in the map moves this frame, and all scans with it."""

    scans: deque[LocalMapScan] = field(default_factory=lambda: deque(maxlen=MAX_SCANS))
    frame: Array = field(default_factory=lambda: np.zeros(3))  # (3,) local frame in map
    # (3, 3) of the pose in map at the last key scan, with the deviation that this scan adds
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    _points: SurfacePoints | None = None
    _unmapped: cKDTree | None = None  # of the unmapped points of all scans

    def clear(self) -> None:
        """Removes all scans."""
        self.scans.clear()
        self._points = self._unmapped = None

    def to_local(self, pose: Array) -> Array:
        """Transforms a pose (3,) from map to the local frame."""
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
        self.covariance = covariance + np.diag(KEY_SCAN_DEVIATION**2)
        self._points = self._unmapped = None

    def find_seen_and_appeared(
        self, local: Array, scan: ScanLikelihood, mapped: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Two masks (B,) of the beams of a scan at ``local`` (3,).

        - Seen before: the beam ends near a point of a key scan, so it is no new evidence. If the map does not explain
          the beam (``mapped`` (B,) is false), it must not explain that point either; otherwise something else stands
          now in front of a known surface. Of key scans that were not `tracking`, no point counts as explained, because
          the best hypothesis may change with each search, and the same surfaces would count again. Beams without return
          count as seen as soon as a key scan has points.
        - Appeared: the beam ends where a key scan saw free space. The surface is new, wherever the robot is.
        """
        seen, appeared = np.zeros(len(scan.ranges), np.bool_), np.zeros(len(scan.ranges), np.bool_)
        if not any(len(each.scan.points) for each in self.scans):
            return seen, appeared
        placed = LocalScan(local, scan).points
        noise = scan.likelihood.deviation(scan.ranges[scan.returned])
        near = self._surface_points().find_near(placed, SEEN_RADIUS_M, np.hypot(SEEN_ACROSS_M, 3 * noise))
        free = np.zeros(len(near), np.bool_)
        free[~near] = self._in_free_space(placed[~near])
        appeared[scan.returned] = free
        unobserved = np.zeros(len(scan.ranges), np.bool_)  # where the key scans saw neither a surface nor free space
        unobserved[scan.returned] = ~near & ~free
        known = near.copy()
        unmapped = near & ~mapped[scan.returned]
        distance, _ = self._tree_of_unmapped_points().query(placed[unmapped], distance_upper_bound=SEEN_RADIUS_M)
        known[unmapped] = np.isfinite(distance)
        seen[:] = ~scan.returned
        seen[scan.returned] = known
        # The first beam on a surface is the evidence for its place. If another part of it was seen before, more of a
        # known wall has come into view, which would count again with each such beam.
        starts, surface = scan.surfaces.starts, np.cumsum(scan.surfaces.starts)
        seen |= starts & unobserved & (np.bincount(surface, seen)[surface] > 0)
        return seen, appeared

    def _in_free_space(self, points: Array) -> npt.NDArray[np.bool_]:
        """Mask (K,) of local points (K, 2) in m that a beam of a key scan passed."""
        free = np.zeros(len(points), np.bool_)
        for key in self.scans:
            free |= _passed(key, points, SEEN_RADIUS_M)
        return free

    def match(self, starts: Array, scan: ScanLikelihood, prior: MotionCandidate) -> Match | None:
        """Returns the match of a scan with the key scans; ``starts`` (N, 3) and ``prior`` are in the local frame.

        Returns None if there are no key scans, if the scan has too few points, or fewer than half of them match, if the
        result contradicts ``prior``, or if the points have almost no information along some direction.
        """
        if not self.scans or len(scan.points) < MIN_POINTS:
            return None
        found = self._best_match(starts, scan, prior)
        if found is None or found.matched_fraction < CLEAR_MATCHED_FRACTION:
            turned = np.repeat(starts[:1], len(EXTRA_HEADINGS_RAD), axis=0)
            turned[:, 2] = se2.wrap(turned[:, 2] + EXTRA_HEADINGS_RAD)
            again = self._best_match(turned, scan, prior)
            if again is not None and (found is None or again.score > found.score):
                found = again
        return None if found is None or found.matched_fraction < MIN_MATCHED_FRACTION or found.degenerate else found

    def candidate(self, match: Match, prior_covariance: Array, moved_probability: float) -> MotionCandidate:
        """The pose in map that a match gives. ``prior_covariance`` (3, 3) is that of the pose in map before the match.

        ``moved_probability`` is the probability that all movable surfaces have moved; otherwise none has.
        """
        turn = se2.rotation(float(self.frame[2]))
        # If the surfaces have moved and the robot has not, all of its motion since the last key scan is an error.
        motion = se2.difference(match.pose, self.scans[-1].pose)
        covariance = match.covariance(turn.T @ prior_covariance @ turn + np.outer(motion, motion), moved_probability)
        return MotionCandidate(se2.compose(self.frame, match.pose), self.covariance + turn @ covariance @ turn.T, 1.0)

    def _best_match(self, starts: Array, scan: ScanLikelihood, prior: MotionCandidate) -> Match | None:
        points = self._surface_points()
        found = [points.match(start, scan, prior) for start in starts]
        plausible = [
            each for each in found if each is not None and prior.squared_distance(each.pose) < MAX_SQUARED_MAHALANOBIS
        ]
        return max(plausible, key=lambda each: each.score, default=None)

    def _surface_points(self) -> SurfacePoints:
        """The points of all scans; kept until the scans change."""
        if self._points is None:
            points = np.concatenate([each.points for each in self.scans])
            self._points = SurfacePoints.of(
                points, np.concatenate([each.mapped[each.scan.returned] for each in self.scans])
            )
        return self._points

    def _tree_of_unmapped_points(self) -> cKDTree:
        """Index of the unmapped points of all scans; kept until the scans change."""
        if self._unmapped is None:
            self._unmapped = cKDTree(np.concatenate([each.unmapped_points for each in self.scans]))
        return self._unmapped


def count_changes(last: LocalScan, now: LocalScan) -> int:
    """Number of surfaces of which most beams vanished or appeared between two scans."""
    return _count_passed(last, now) + _count_passed(now, last)


def _count_passed(seen: LocalScan, by: LocalScan) -> int:
    """Number of surfaces in the scan ``seen`` of which more than half of the points are passed by beams of ``by``."""
    passed = _passed(by, seen.points, PASSED_M)
    surface = np.cumsum(seen.scan.surfaces.starts)[seen.scan.returned]
    beams, passed_beams = np.bincount(surface), np.bincount(surface, passed)
    return int(((passed_beams >= MIN_BEAMS) & (passed_beams > 0.5 * beams)).sum())


def is_key_pose(last: Array, pose: Array) -> bool:
    """Whether ``pose`` (3,) is so far from that of the ``last`` (3,) key scan that a key scan is due there."""
    motion = se2.between(last, pose)
    return bool(np.hypot(motion[0], motion[1]) >= KEY_DISTANCE_M or abs(motion[2]) >= KEY_TURN_RAD)


def _passed(by: LocalScan, points: Array, distance: float) -> npt.NDArray[np.bool_]:
    """Mask (K,) of the local points (K, 2) m that beams of the scan ``by`` passed by more than ``distance`` m.

    Three standard deviations of the noise are added in quadrature.
    """
    ranges, beam, inside = _beams_towards(by.scan, se2.compose(by.pose, by.scan.mount), points)
    margin = np.hypot(distance, 3 * by.scan.likelihood.deviation(ranges))
    return np.asarray(inside & (by.scan.nearest_of_neighbours[beam] > ranges + margin))


def _beams_towards(
    scan: ScanLikelihood, laser: Array, points: Array
) -> tuple[Array, npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Distances (K,) in m of points (K, 2) from a laser pose, their beams (K,), and whether they are in its view."""
    local = se2.transform(se2.inverse(laser), points)
    order, angles = scan.sorted_beams
    turned = angles[0] + (np.arctan2(local[:, 1], local[:, 0]) - angles[0]) % (2 * np.pi)
    place = np.searchsorted((angles[1:] + angles[:-1]) / 2, turned)
    inside = (place > 0) & (place < len(angles) - 1)
    return np.hypot(*local.T), np.where(inside, order[place], 0), inside
