"""The front end: the motion between scans, from each scan's registration to the last key scans.

A scan that contradicts the last key scans is not used: something hides the surroundings, or the robot was carried off.
If the next scans do so as well, another piece of the drive begins, of which no place in the former pieces is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.motion_distortion import beam_times, correct_beams, evenly_spaced
from common.robot.scan_geometry import Sweep
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.elements import Elements, elements_of_scan, joined
from services.mapper.slam.pose_graph import Link
from services.mapper.slam.registration import MIN_PARTNERS, PRIOR_SCALE, Prior, Registration, Surface, register
from services.mapper.slam.search import search
from services.mapper.slam.segments import Segment, Views, agreement

KEY_DISTANCE_M, KEY_TURN_RAD = 0.4, 0.5  # from the last key scan, before another one is taken
KEY_SHARE = 0.1  # of the median range, if that is a larger distance
SEARCH_WINDOW, SEARCH_RANGE_M = np.array([0.3, 0.3, 0.4]), 10.0  # around the prior; of the elements that take part
LOCAL_SCANS = 12  # key scans in the local map
MIN_SHARE = 0.2  # of a scan's elements that must match the local map
# Share of agreeing elements, among those that agree with or contradict the local map, at a pose that may be right;
# and the number that is taken to agree anyway, so that a few elements alone are no evidence.
MIN_AGREEMENT, AGREEING = 0.78, 10
LOST_SCANS = 10  # successive ones that do not match, before another piece begins
NEAR = np.array([0.1, 0.1, 0.1])  # m, m, rad from the expected pose, where a match is no chance while the robot is lost
NO_PIECE = -1
# A scan of which less matches sees something new; it becomes a key scan earlier, after this share of the way.
FAMILIAR_SHARE, EARLY = 0.7, 0.25
# Standard deviations of the motion. With odometry: of its error, as a share of the motion. Without: of the change of
# the velocity in one second, m/s and rad/s, and of the velocity itself where the last one is unknown.
ODOMETRY_PATH, ODOMETRY_TURN_BY_PATH, ODOMETRY_TURN = 0.4, 0.5, 1.0  # m/m, rad/m, rad/rad
# Scans over which these deviations are learned, and the largest error that counts, in deviations.
LEARNED_SCANS, MAX_SURPRISE = 100, 10.0
STANDING = np.array([0.002, 0.002, 0.002])  # m, m, rad
ACCELERATION = np.array([1.0, 1.0, 3.0])
MAX_VELOCITY = np.array([1.0, 1.0, 1.5])
MAX_MOTION = 3 * MAX_VELOCITY  # in one second; a robot that seems to move faster was carried off
# Errors of a registration that do not average out, for each key scan: moving things, the surfaces' roughness.
REGISTRATION = np.array([0.005, 0.005, 0.002])


@dataclass(frozen=True)
class KeyScans:
    """Key scans as the front end sees them: their places are exact over some metres, and drift beyond."""

    poses: Array  # (K, 3)
    elements: list[Elements]
    ranges: list[Array]  # (B,) m
    links: list[Link]  # between successive ones of one piece, by their numbers
    pieces: npt.NDArray[np.int_]  # (K,) piece of the drive to which each belongs


@dataclass(frozen=True)
class Track:
    """A whole drive as the front end sees it."""

    poses: Array  # (N, 3) of all scans
    pieces: npt.NDArray[np.int_]  # (N,) of the drive, or `NO_PIECE`
    keys: list[int]  # scans that are key scans
    key_scans: KeyScans
    lost: int  # scans that did not match


@dataclass(frozen=True)
class Place:
    """The place of one scan in the frame of the first."""

    pose: Array  # (3,)
    covariance: Array  # (3, 3) relative to the last key scans
    matched: bool  # otherwise only the motion model tells the pose
    piece: int = 0  # of the drive, or `NO_PIECE` if the surroundings contradict the pose


class FrontEnd:
    """Registers scan after scan, and keeps the key scans."""

    def __init__(self, laser: Laser) -> None:
        self.laser = laser
        self.stamps: list[float] = []  # s, of all scans
        self.poses: list[Array] = []  # (3,) of all scans
        self.pieces: list[int] = []  # of all scans
        self.keys: list[int] = []  # scans that are key scans
        self.lost = 0  # scans that did not match
        self._sweep = Sweep.of_angles(laser.angles)
        self._elements: list[Elements] = []  # of the key scans
        self._ranges: list[Array] = []  # of the key scans
        self._links: list[Link] = []
        self._key_pieces: list[int] = []  # of the key scans
        self._surface: Surface  # of the local map
        self._local: Segment  # the local map with what its scans saw through
        self._lost_scans = 0  # since one matched, if one of them contradicted the local map
        self._odom: Array | None = None  # of the last scan
        self._velocity: Array | None = None  # (3,) base_link
        self._scale = np.ones(3)  # of the deviations of the motion, learned
        self._since_key = np.zeros((3, 3))  # covariance of the motion since the last key scan, by the motion model

    def add(self, stamp: float, ranges: Array, odom: Array | None = None) -> Place:
        """Registers a scan ``ranges`` (B,) m at ``stamp`` s, later than the one before, with or without odometry."""
        laser, first = self.laser, not self.stamps
        period = 0.0 if first else stamp - self.stamps[-1]
        motion, deviation = (np.zeros(3), np.zeros(3)) if first else self._motion(period, odom)
        ranges, angles = self._corrected(ranges, motion, period)
        elements = elements_of_scan(ranges, angles, laser.mount, laser.range_max)
        used_odometry, self._odom = self._odom is not None and odom is not None, odom
        self.stamps.append(stamp)
        if first:
            return self._begin_piece(np.zeros(3), elements, ranges, angles)
        last = self.poses[-1]
        _, by_step = se2.compose_jacobians(last, motion)
        covariance = (by_step * (self._scale * deviation) ** 2) @ by_step.T
        prior = Prior(se2.compose(last, motion), np.asarray(np.linalg.inv(covariance), float))
        coasting = last if self._velocity is None else se2.compose(last, self._velocity * period)
        found = _best_registration(self._surface, elements, prior, coasting)
        if found is not None and found.share < MIN_SHARE:
            found = None
        self._since_key = self._since_key + PRIOR_SCALE**2 * covariance
        familiar = found is not None and found.share > FAMILIAR_SHARE
        pose = prior.mean if found is None else found.pose
        jumps = bool((np.abs(se2.between(last, pose)) > MAX_MOTION * period).any())
        off = np.abs(se2.between(prior.mean, pose))
        lost = bool(self._lost_scans) and (found is None or bool((off > NEAR).any()))
        if jumps or (not familiar and (lost or self._is_contradicted(pose, elements, ranges, angles))):
            found, self._lost_scans = None, max(1, self._lost_scans)
        if found is None:
            self.lost += 1
            self._velocity = None if used_odometry else self._velocity
            if self._lost_scans:
                return self._add_lost(prior.mean, elements, ranges, angles)
            place, information = Place(prior.mean, self._since_key, False, self._key_pieces[-1]), np.zeros((3, 3))
        else:
            self._lost_scans = 0
            self._velocity = se2.between(last, found.pose) / period
            if familiar:
                self._scale = _learned(self._scale, self._scale * deviation, prior.mean, found)
            place = Place(found.pose, found.covariance + np.diag(REGISTRATION**2), True, self._key_pieces[-1])
            information = found.information
        self._append(place)
        if self._is_key(place.pose, elements, familiar=found is None or familiar):
            key = self.poses[self.keys[-1]]
            self._links.append(_link(len(self.keys) - 1, key, place.pose, information, self._since_key))
            self._add_key(elements, ranges, angles)
        return place

    def key_scans(self) -> KeyScans:
        """The key scans so far."""
        poses = np.array([self.poses[key] for key in self.keys])
        pieces = np.array(self._key_pieces)
        return KeyScans(poses, self._elements.copy(), self._ranges.copy(), self._links.copy(), pieces)

    def track(self) -> Track:
        """The drive so far."""
        return Track(np.array(self.poses), np.array(self.pieces), self.keys.copy(), self.key_scans(), self.lost)

    def _motion(self, period: float, odom: Array | None) -> tuple[Array, Array]:
        """Motion (3,) in base_link in the ``period`` since the scan before, and its standard deviations (3,)."""
        velocity = self._velocity
        if odom is not None and self._odom is not None:
            motion = se2.between(self._odom, odom)
            # A robot that seems to stop suddenly may go on: odometry lags behind the scans, or pauses.
            either = np.abs([motion, np.zeros(3) if velocity is None else velocity * period])
            moved, turned = np.hypot(either[:, 0], either[:, 1]).max(), either[:, 2].max()
            path, turn = ODOMETRY_PATH * moved, ODOMETRY_TURN_BY_PATH * moved + ODOMETRY_TURN * turned
            return motion, STANDING + np.array([path, path, turn])
        if velocity is None:
            return np.zeros(3), STANDING + MAX_VELOCITY * period
        return velocity * period, STANDING + np.minimum(ACCELERATION * period, MAX_VELOCITY) * period

    def _corrected(self, ranges: Array, motion: Array, period: float) -> tuple[Array, Array]:
        """Ranges (B,) and angles (B,) as if measured at the stamp; ``motion`` (3,) since the scan before."""
        laser = self.laser
        if not laser.time_increment or not period:
            return ranges, laser.angles
        times = beam_times(len(laser.angles), laser.time_increment)
        return correct_beams(ranges, laser.angles, times[:, None] * (motion / period), laser.mount)

    def _is_contradicted(self, pose: Array, elements: Elements, ranges: Array, angles: Array) -> bool:
        """Whether a scan at a pose contradicts the local map more than moving things would make it."""
        mount = self.laser.mount
        scan = Segment(0, 0, elements, Views(mount[None], self._even(ranges, angles)[None], self.laser.angles))
        _, both, against = agreement(self._local, self._surface, scan, pose)
        return both + AGREEING < MIN_AGREEMENT * (both + AGREEING + against)

    def _add_lost(self, pose: Array, elements: Elements, ranges: Array, angles: Array) -> Place:
        """Adds a scan of unknown pose; after some of them, another piece begins."""
        self._lost_scans += 1
        if self._lost_scans > LOST_SCANS and len(elements) >= MIN_PARTNERS:
            return self._begin_piece(pose, elements, ranges, angles)
        place = Place(pose, self._since_key, matched=False, piece=NO_PIECE)
        self._append(place)
        return place

    def _begin_piece(self, pose: Array, elements: Elements, ranges: Array, angles: Array) -> Place:
        """Begins a piece with a scan, whose pose (3,) may be any."""
        self._velocity, self._lost_scans = None, 0
        place = Place(pose, np.diag(REGISTRATION**2), matched=True, piece=max(self._key_pieces, default=-1) + 1)
        self._append(place)
        self._add_key(elements, ranges, angles)
        return place

    def _append(self, place: Place) -> None:
        self.poses.append(place.pose)
        self.pieces.append(place.piece)

    def _is_key(self, pose: Array, elements: Elements, *, familiar: bool) -> bool:
        off = se2.between(self.poses[self.keys[-1]], pose)
        far = max(KEY_DISTANCE_M, KEY_SHARE * _median_range(elements))
        way = max(np.hypot(off[0], off[1]) / far, abs(off[2]) / KEY_TURN_RAD)
        return bool(way >= (1.0 if familiar else EARLY))

    def _add_key(self, elements: Elements, ranges: Array, angles: Array) -> None:
        """Makes the last scan a key scan."""
        self.keys.append(len(self.poses) - 1)
        self._elements.append(elements)
        self._ranges.append(self._even(ranges, angles))
        self._key_pieces.append(self.pieces[-1])
        recent = [k for k in range(-min(LOCAL_SCANS, len(self.keys)), 0) if self._key_pieces[k] == self.pieces[-1]]
        poses = np.array([self.poses[self.keys[k]] for k in recent])
        local = joined([self._elements[k].moved(pose) for k, pose in zip(recent, poses, strict=True)])
        self._surface = Surface(local)
        seen = np.array([self._ranges[k] for k in recent])
        views = Views(se2.compose(poses, self.laser.mount), seen, self.laser.angles)
        self._local = Segment(0, 0, local, views)
        self._since_key = np.zeros((3, 3))

    def _even(self, ranges: Array, angles: Array) -> Array:
        """Ranges (B,) at the laser's own angles."""
        return evenly_spaced(ranges, angles, self._sweep, -np.inf) if self.laser.time_increment else ranges


def track(drive: RawDrive, report: Callable[[float], None] = lambda _done: None) -> Track:
    """Tracks the scans of a drive."""
    front_end = FrontEnd(drive.laser)
    for k, (stamp, ranges) in enumerate(zip(drive.stamps, drive.ranges, strict=True)):
        front_end.add(float(stamp), ranges, None if drive.odom is None else drive.odom[k])
        report(k / len(drive.ranges))
    return front_end.track()


def _best_registration(surface: Surface, elements: Elements, prior: Prior, coasting: Array) -> Registration | None:
    """Registers a scan from the prior's mean.

    If much of it does not match, also from ``coasting`` (3,), the pose at the velocity so far, and from the results of
    a search.
    """
    found = register(surface, elements, prior.mean, prior)
    if found is not None and found.share > FAMILIAR_SHARE:
        return found
    near = elements.part(np.hypot(*elements.points.T) < SEARCH_RANGE_M)
    starts = [coasting]
    if len(near):
        starts += list(search(surface.elements, near, prior.mean, SEARCH_WINDOW))
    others = [register(surface, elements, start, prior) for start in starts]
    matches = [each for each in (found, *others) if each is not None]
    return min(matches, key=lambda each: each.cost, default=None)


def _median_range(elements: Elements) -> float:
    return float(np.median(np.hypot(*elements.points.T))) if len(elements) else 0.0


def _learned(scale: Array, deviation: Array, expected: Array, found: Registration) -> Array:
    """The factor (3,) of the motion's deviations after one more scan, by expectation maximisation.

    Odometries differ tenfold.
    """
    turn = np.eye(3)
    turn[:2, :2] = se2.rotate(float(expected[2]), np.eye(2))
    variance = np.diag(turn @ found.covariance @ turn.T)
    squared = (se2.between(expected, found.pose) ** 2 + variance) / deviation**2
    return np.asarray(scale * np.sqrt(1 + (np.minimum(squared, MAX_SURPRISE**2) - 1) / LEARNED_SCANS))


def _link(number: int, first: Array, second: Array, information: Array, motion: Array) -> Link:
    """The link between two successive key scans; ``information`` and ``motion`` are in the frame of the track."""
    turn = np.eye(3)
    turn[:2, :2] = se2.rotate(float(first[2]), np.eye(2))
    seen = np.linalg.inv(np.linalg.inv(turn @ information @ turn.T + 1e-6 * np.eye(3)) + np.diag(REGISTRATION**2))
    return Link(number, number + 1, se2.between(first, second), seen + np.linalg.inv(turn @ motion @ turn.T))
