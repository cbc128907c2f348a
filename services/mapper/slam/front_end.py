"""The front end: tracks the robot's motion by registering each scan to the last key scans.

A drive consists of pieces; within a piece, tracking was never interrupted.

A scan that contradicts the last key scans is suspect: something hides the surroundings, or the robot was kidnapped.
Its pose is unknown. After `MAX_SUSPECT_SCANS` in a row a new piece begins, whose pose relative to the former pieces is
unknown, unless odometry and the local map agree on it.

A scan that matches, but far from where the motion model expects it, or with more contradictions than usual, also begins
a piece: the wheels may have slipped, a door may have moved, or the robot was carried to a place that looks alike. So
does one of which only a part matches after scans that did not match, because that may be accidental, and one that
matches first after the stamps have stepped back or jumped ahead, because the robot may have been moved meanwhile.
This piece is linked to the former one, but the link may turn out to be wrong.
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
from services.mapper.slam.correlative_search import correlative_search
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.elements import Elements, concatenate, elements_of_scan
from services.mapper.slam.pose_graph import PoseLink
from services.mapper.slam.registration import (
    MIN_CORRESPONDENCES,
    PRIOR_INFLATION,
    PosePrior,
    Registration,
    Surface,
    register,
)
from services.mapper.slam.submaps import PosedScans, Submap, compare_submaps

KEY_DISTANCE_M, KEY_TURN_RAD = 0.4, 0.5  # a key scan is taken after a motion of either size since the last one
KEY_RANGE_SHARE = 0.1  # in large rooms, the distance is this share of the median range instead
# Between key scans, scans this far apart are kept for the grid: key scans alone leave gaps in walls that are far away.
GRID_SCAN_DISTANCE_M, GRID_SCAN_TURN_RAD = 0.1, 0.1
# A scan of which a smaller fraction matches sees something new. It becomes a key scan after this part of the distance.
FAMILIAR_FRACTION, EARLY_KEY_PROGRESS = 0.7, 0.25
# m, m, rad to either side of the prior's mean: so many of its standard deviations, within these limits.
SEARCH_SIGMAS = 3.0
# The largest takes about 50 ms for each scan.
MIN_SEARCH_WINDOW, MAX_SEARCH_WINDOW = np.array([0.3, 0.3, 0.4]), np.array([4.0, 4.0, np.pi])
MAX_RIVAL_NATS = 3.0  # a match elsewhere that is at least 0.05 times as probable as the best makes the place ambiguous
MAX_SEARCHED_M = 10.0  # farther elements take no part in the search
LOCAL_SCANS = 12  # key scans in the local map
MIN_MATCHED_FRACTION = 0.2  # of a scan's elements that must match the local map
# Largest share of contradicting elements, among those that agree with or contradict the local map, at a pose that may
# be right. This many agreeing elements are added as a pseudo-count, so that a few contradictions prove nothing.
MAX_CONTRADICTION, PRIOR_AGREEMENT = 0.22, 10
# A scan begins a piece if its share of contradictions exceeds the first limit, and the recent maximum by the ratio. The
# recent maximum decays with a time constant of this many scans.
UNUSUAL_CONTRADICTION, UNUSUAL_RATIO, FADING_SCANS = 0.05, 1.5, 50
MAX_SUSPECT_SCANS = 10  # after this many suspect scans in a row, the last of them begins another piece
# Standard deviations of motion and registration; a scan that matches farther from the prior begins a piece.
MAX_SLIP = 6.0
SAME_PLACE = np.array([0.1, 0.1, 0.1])  # m, m, rad: poses that differ by more are different places
NO_PIECE = -1  # of a suspect scan, instead of the number of a piece
# Standard deviations of the motion. With odometry: of its error, per unit of motion. Without: of the change of the
# velocity in one second, m/s and rad/s, or of the velocity if the last one is unknown.
ODOMETRY_PATH, ODOMETRY_TURN_BY_PATH, ODOMETRY_TURN = 0.4, 0.5, 1.0  # m/m, rad/m, rad/rad
VELOCITY_CHANGE_DEVIATION = np.array([1.0, 1.0, 3.0])
VELOCITY_DEVIATION = np.array([1.0, 1.0, 1.5])
STANDING_DEVIATION = np.array([0.002, 0.002, 0.002])  # m, m, rad: in addition to both
MAX_VELOCITY = 3 * VELOCITY_DEVIATION  # a robot that seems to move faster was kidnapped
# Without odometry, a swept scan is corrected again for the motion that its registration found, so many times. If it
# were corrected only for the last velocity, an error of one pose would cause an opposite, larger one of the next.
SWEEP_CORRECTIONS = 2
# The velocity is unknown after a period that exceeds both this time and this multiple of the period before.
MAX_PERIOD_S, MAX_PERIOD_RATIO = 2.0, 5.0
# A factor on the deviations of the motion is learned over this many scans, from errors of at most so many deviations.
LEARNING_SCANS, MAX_LEARNED_SIGMAS = 100, 10.0
# Errors of a registration that do not average out, for each key scan: moving things, the surfaces' roughness.
REGISTRATION_DEVIATION = np.array([0.005, 0.005, 0.002])


@dataclass(frozen=True)
class KeyScanGraph:
    """Key scans and the links between them, from the front end: precise over some metres, with drift beyond."""

    poses: Array  # (K, 3)
    elements: list[Elements]
    ranges: list[Array]  # (B,) m
    links: list[PoseLink]  # between successive key scans; a piece may begin with a link to the one before
    pieces: npt.NDArray[np.int_]  # (K,) piece of the drive to which each belongs


@dataclass(frozen=True)
class TrackedDrive:
    """A whole drive, tracked by the front end without loop closures."""

    poses: Array  # (N, 3) of all scans
    pieces: npt.NDArray[np.int_]  # (N,) of the drive, or `NO_PIECE`
    keys: list[int]  # indices of the key scans
    key_scans: KeyScanGraph
    unmatched: int  # number of scans that are suspect, or of which too little matches


@dataclass(frozen=True)
class ScanPose:
    """The pose of one scan, and how it was found.

    `FrontEnd.add` returns it in the frame of the first scan, `Mapper.add` in map.
    """

    pose: Array  # (3,)
    covariance: Array  # (3, 3) relative to the last key scans
    # Whether the scan matched the local map, or begins a piece, at an arbitrary pose. For `Mapper.add`, the piece must
    # also be connected to the map.
    matched: bool
    piece: int = 0  # of the drive, or `NO_PIECE` for a suspect scan
    linked: bool = False  # whether this scan begins a piece with a link to the one before


@dataclass(frozen=True)
class _Scan:
    """A scan, corrected for the robot's motion."""

    elements: Elements
    ranges: Array  # (B,) m
    angles: Array  # (B,) rad


class FrontEnd:
    """Registers one scan after another, and keeps the key scans."""

    def __init__(self, laser: Laser) -> None:
        self.laser, self._sweep = laser, Sweep.of_angles(laser.angles)
        # One entry for each scan.
        self.stamps: list[float] = []  # s
        self.poses: list[Array] = []  # (3,)
        self.pieces: list[int] = []
        self._odom: list[Array | None] = []  # (3,)
        self.unmatched = 0  # number of scans that are suspect, or of which too little matches
        # One entry for each key scan.
        self.keys: list[int] = []  # its number among all scans
        self._key_pieces: list[int] = []
        self._elements: list[Elements] = []
        self._ranges: list[Array] = []
        self._links: list[PoseLink] = []
        # One entry for each scan that is kept for the grid: its number among all scans, and its ranges (B,) m.
        self._grid_scans: list[tuple[int, npt.NDArray[np.float32]]] = []
        # The local map: the surfaces of the last key scans, and the scans themselves, to check what they saw through.
        self._surface: Surface
        self._local: Submap
        self._first_local = 0  # first key scan that links connect to the latest one; the local map starts no earlier
        # The motion. The next pose is predicted from the reference, the last scan that matched or became a key scan.
        self._reference = 0  # its number among all scans
        self._since_reference = 0.0  # s; a step back of the clock counts as `MAX_PERIOD_S`
        self._clock_stepped = False  # since the reference
        self._velocity: Array | None = None  # (3,) base_link
        self._period: float | None = None  # s between the last two scans between which the clock did not step
        self._scale = np.ones(3)  # of the deviations of the motion, learned
        # Of the motion since the last key scan, by the motion model: to the latest scan, and to the reference.
        self._covariance_since_key = self._covariance_at_reference = np.zeros((3, 3))
        self._suspect_scans = 0  # in a row until now
        self._recent_contradiction = 0.0  # recent maximum of the share of contradictions, see `FADING_SCANS`

    def add(self, stamp: float, ranges: Array, odom: Array | None = None) -> ScanPose:
        """Registers a scan and returns its pose in the frame of the first scan.

        ``ranges`` (B,) are in m, +inf without a return and -inf if not measured. ``stamp`` is in s, and not that of the
        scan before; it may step back, as after a reset of the simulator, which also resets the odometry. ``odom`` (3,)
        is the pose of base_link in odom, or None if it is unknown.
        """
        # Predict the motion since the reference, and correct the scan for it.
        since_last = stamp - self.stamps[-1] if self.stamps else 0.0
        self._clock_stepped |= self._update_period(since_last)
        self.stamps.append(stamp)
        self._odom.append(odom)
        if since_last < 0:  # the real time since then is unknown, and odometry may have been reset
            since_last, self._odom[self._reference] = MAX_PERIOD_S, None
        self._since_reference += since_last
        period = self._since_reference
        motion, deviation = self._predict_motion(period)
        scan = self._correct(ranges, motion, period)
        used_odometry = self._odom[self._reference] is not None and odom is not None
        # Begin with the first scan, and begin again with the first one that shows enough for others to match.
        if len(self.stamps) == 1:
            return self._begin_piece(np.zeros(3), scan)
        prior, covariance = self._prior(motion, deviation)
        shows_first_surfaces = len(self._local.elements) < MIN_CORRESPONDENCES <= len(scan.elements)
        if shows_first_surfaces and self.shows_too_little:
            self._remove_key_scans()
            return self._begin_piece(prior.mean, scan)
        if shows_first_surfaces and odom is None:
            return self._begin_piece(self.poses[-1], scan)  # so far there was nothing that a scan could match
        self._covariance_since_key = self._covariance_at_reference + PRIOR_INFLATION**2 * covariance
        # Register the scan, and judge whether the match can be right.
        last = self.poses[self._reference]
        found, ambiguous = self._register(scan, prior, period)
        contradiction = self._contradiction(scan, found, prior)
        reachable_from = [last, prior.mean] if used_odometry else [last]
        suspect = ambiguous or contradiction > MAX_CONTRADICTION
        suspect = suspect or self._is_suspect(found, prior, reachable_from, period)
        # If odometry and registration agree even after many suspect scans, the surroundings have changed.
        confirmed = self._suspect_scans + 1 >= MAX_SUSPECT_SCANS and used_odometry and not _is_far(found, prior)
        # Add the scan where it matches, or where the motion model predicts it.
        if found is not None and (confirmed or not suspect):
            slipped = _squared_deviation(found, prior, covariance) > MAX_SLIP**2
            may_be_accidental = self._reference < len(self.poses) - 1 and found.matched_fraction < FAMILIAR_FRACTION
            begins_piece = (
                self._clock_stepped or suspect or slipped or may_be_accidental or self._is_unusual(contradiction)
            )
            # A match that was not expected may be wrong, and the scan would be bent to fit it.
            if self.laser.time_increment and not used_odometry and not begins_piece:
                scan, found = self._register_sweep(ranges, found, prior, period)
            if not suspect:  # in a suspect scan, the contradiction is not due to moving objects
                self._update_recent_contradiction(contradiction)
            return self._add_matched(scan, found, prior, deviation, period, begins_piece=begins_piece)
        self.unmatched += 1
        if used_odometry:  # without it, the old velocity is still the best prediction
            self._velocity = None
        if suspect:
            return self._add_suspect(scan, prior.mean)
        return self._add_unmatched(scan, prior.mean, is_key=shows_first_surfaces)

    def _update_period(self, period: float) -> bool:
        """Stores the time in s since the last scan, or forgets the velocity if the clock stepped.

        Returns whether it stepped.
        """
        usual = self._period
        if period < 0 or (usual is not None and period > max(MAX_PERIOD_S, MAX_PERIOD_RATIO * usual)):
            self._velocity = None
            return True
        if self.stamps:
            self._period = period
        return False

    @property
    def shows_too_little(self) -> bool:
        """Whether there is one key scan, on which too little is seen for others to match; another will replace it."""
        return len(self.keys) == 1 and len(self._elements[0]) < MIN_CORRESPONDENCES

    def key_scans(self) -> KeyScanGraph:
        """Returns the key scans so far."""
        poses = np.array([self.poses[key] for key in self.keys])
        pieces = np.array(self._key_pieces)
        return KeyScanGraph(poses, self._elements.copy(), self._ranges.copy(), self._links.copy(), pieces)

    def grid_scans(self) -> tuple[npt.NDArray[np.int_], Array]:
        """Returns the scans of which a grid is drawn: their numbers (M,) among all scans, and ranges (M, B) m."""
        numbers, ranges = zip(*self._grid_scans, strict=True)
        return np.array(numbers), np.array(ranges, float)

    def tracked_drive(self) -> TrackedDrive:
        """Returns the drive so far."""
        return TrackedDrive(
            np.array(self.poses), np.array(self.pieces), self.keys.copy(), self.key_scans(), self.unmatched
        )

    def _predict_motion(self, period: float) -> tuple[Array, Array]:
        """Motion (3,) in base_link in the ``period`` since the reference, and its standard deviations (3,)."""
        velocity, odom_before, odom = self._velocity, self._odom[self._reference], self._odom[-1]
        if odom is not None and odom_before is not None:
            motion = se2.between(odom_before, odom)
            # A robot that seems to stop suddenly may go on: odometry lags behind the scans, or pauses.
            possible = np.abs([motion, np.zeros(3) if velocity is None else velocity * period])
            moved, turned = np.hypot(possible[:, 0], possible[:, 1]).max(), possible[:, 2].max()
            path, turn = ODOMETRY_PATH * moved, ODOMETRY_TURN_BY_PATH * moved + ODOMETRY_TURN * turned
            return motion, STANDING_DEVIATION + np.array([path, path, turn])
        if velocity is None:
            return np.zeros(3), STANDING_DEVIATION + VELOCITY_DEVIATION * period
        deviation = np.minimum(VELOCITY_CHANGE_DEVIATION * period, VELOCITY_DEVIATION)
        return velocity * period, STANDING_DEVIATION + deviation * period

    def _correct(self, ranges: Array, motion: Array, period: float) -> _Scan:
        """The scan as if measured at its stamp, with a ``motion`` (3,) in the ``period`` before."""
        laser, angles = self.laser, self.laser.angles
        if laser.time_increment and period:
            times = beam_times(len(angles), laser.time_increment)
            ranges, angles = correct_beams(ranges, angles, times[:, None] * (motion / period), laser.mount)
        return _Scan(elements_of_scan(ranges, angles, laser.mount, laser.range_max), ranges, angles)

    def _prior(self, motion: Array, deviation: Array) -> tuple[PosePrior, Array]:
        """The pose after a motion, and the covariance (3, 3) of the motion."""
        last = self.poses[self._reference]
        _, jacobian = se2.compose_jacobians(last, motion)
        covariance = (jacobian * (self._scale * deviation) ** 2) @ jacobian.T
        return PosePrior(se2.compose(last, motion), np.asarray(np.linalg.inv(covariance), float)), covariance

    def _register(self, scan: _Scan, prior: PosePrior, period: float) -> tuple[Registration | None, bool]:
        """Registers a scan to the local map, starting at the prior's mean.

        If only a part of the scan matches, also starts at the pose that the last velocity predicts and at the results
        of a search. Returns the best match, or None if too little matches, and whether it is ambiguous.
        """
        surface, elements = self._surface, scan.elements
        found = register(surface, elements, prior.mean, prior)
        if found is not None and found.matched_fraction > FAMILIAR_FRACTION:
            return found, False
        last, deviation = self.poses[self._reference], np.sqrt(np.diag(np.linalg.inv(prior.information)))
        window = np.clip(SEARCH_SIGMAS * deviation, MIN_SEARCH_WINDOW, MAX_SEARCH_WINDOW)
        starts = [last if self._velocity is None else se2.compose(last, self._velocity * period)]
        near = elements.part(np.hypot(*elements.points.T) < MAX_SEARCHED_M)
        starts += list(correlative_search(surface.elements, near, prior.mean, window))
        others = [register(surface, elements, start, prior) for start in starts]
        matches = [each for each in (found, *others) if each is not None]
        best = min(matches, key=lambda each: each.cost, default=None)
        if best is None or best.matched_fraction < MIN_MATCHED_FRACTION:
            return None, False
        rivals = [each for each in matches if each.cost < best.cost + MAX_RIVAL_NATS]
        return best, any(_is_elsewhere(best.pose, each.pose) for each in rivals)

    def _register_sweep(
        self, ranges: Array, found: Registration, prior: PosePrior, period: float
    ) -> tuple[_Scan, Registration]:
        """Corrects a swept scan for the motion to the pose at which it was found, and registers it again."""
        for _ in range(SWEEP_CORRECTIONS):
            scan = self._correct(ranges, se2.between(self.poses[self._reference], found.pose), period)
            found = register(self._surface, scan.elements, found.pose, prior) or found
        return scan, found

    def _is_suspect(
        self, found: Registration | None, prior: PosePrior, reachable_from: list[Array], period: float
    ) -> bool:
        """Whether a registration implies that the robot was kidnapped, or may match by chance.

        The robot was kidnapped if it cannot have driven there within ``period`` s from any pose in ``reachable_from``.
        These are the last known pose and, with odometry, the pose that odometry predicts: after a pause, odometry
        reports the motion of several scans at once.
        """
        pose = prior.mean if found is None else found.pose
        if all((np.abs(se2.between(each, pose)) > MAX_VELOCITY * period).any() for each in reachable_from):
            return True
        if found is not None and found.matched_fraction > FAMILIAR_FRACTION:
            return False
        return self._suspect_scans > 0 and _is_far(found, prior)

    def _contradiction(self, scan: _Scan, found: Registration | None, prior: PosePrior) -> float:
        """Share of contradictions between a scan and the local map; 0 if most of the scan matches."""
        if found is not None and found.matched_fraction > FAMILIAR_FRACTION:
            return 0.0
        scans = PosedScans(self.laser.mount[None], self._evenly_spaced(scan)[None], self.laser.angles)
        pose = prior.mean if found is None else found.pose
        counted = compare_submaps(self._local, self._surface, Submap(0, 0, scan.elements, scans), pose)
        return counted.contradicting / (counted.agreeing + PRIOR_AGREEMENT + counted.contradicting)

    def _is_unusual(self, contradiction: float) -> bool:
        """Whether a share of contradictions is clearly larger than moving objects caused lately."""
        return contradiction > max(UNUSUAL_CONTRADICTION, UNUSUAL_RATIO * self._recent_contradiction)

    def _update_recent_contradiction(self, contradiction: float) -> None:
        self._recent_contradiction = max(contradiction, self._recent_contradiction * (1 - 1 / FADING_SCANS))

    def _add_matched(
        self, scan: _Scan, found: Registration, prior: PosePrior, deviation: Array, period: float, *, begins_piece: bool
    ) -> ScanPose:
        """Adds a scan at its pose. If ``begins_piece``, it starts another piece, linked to the last key scan."""
        self._suspect_scans = 0
        # After scans that did not match, the motion may not have been steady.
        steady = not begins_piece and self._reference == len(self.poses) - 1
        self._velocity = se2.between(self.poses[self._reference], found.pose) / period if steady else None
        familiar = found.matched_fraction > FAMILIAR_FRACTION
        if familiar:
            self._scale = _learn_scale(self._scale, self._scale * deviation, prior, found)
        covariance = found.covariance + np.diag(REGISTRATION_DEVIATION**2)
        piece = self._key_pieces[-1] + (1 if begins_piece else 0)
        scan_pose = ScanPose(found.pose, covariance, matched=True, piece=piece, linked=begins_piece)
        self._append(scan_pose)
        self._make_reference()
        off = np.abs(se2.between(self.poses[self._grid_scans[-1][0]], found.pose))
        if begins_piece or np.hypot(*off[:2]) > GRID_SCAN_DISTANCE_M or off[2] > GRID_SCAN_TURN_RAD:
            self._keep_for_grid(scan)
        if begins_piece or self._is_key_due(scan, early=not familiar):
            self._add_linked_key(scan, found.information)
        return scan_pose

    def _add_unmatched(self, scan: _Scan, pose: Array, *, is_key: bool) -> ScanPose:
        """Adds a scan of which too little matches, at the pose that the motion model predicts.

        It is a key scan if ``is_key``, or if the robot has moved far enough. Then its predicted pose counts as known.
        """
        scan_pose = ScanPose(pose, self._covariance_since_key, matched=False, piece=self._key_pieces[-1])
        self._append(scan_pose)
        # A scan that sees something new is a key scan sooner, but not this one: its pose is only predicted.
        if is_key or self._is_key_due(scan, early=False):
            self._add_linked_key(scan, np.zeros((3, 3)))
        return scan_pose

    def _add_suspect(self, scan: _Scan, pose: Array) -> ScanPose:
        """Adds a scan whose pose is unknown; after several of them, another piece begins."""
        self._suspect_scans += 1
        if self._suspect_scans >= MAX_SUSPECT_SCANS and len(scan.elements) >= MIN_CORRESPONDENCES:
            return self._begin_piece(pose, scan)
        scan_pose = ScanPose(pose, self._covariance_since_key, matched=False, piece=NO_PIECE)
        self._append(scan_pose)
        return scan_pose

    def _begin_piece(self, pose: Array, scan: _Scan) -> ScanPose:
        """Begins a piece with a scan at an arbitrary pose (3,)."""
        self._velocity, self._suspect_scans = None, 0
        self._first_local = len(self.keys)
        piece = max(self._key_pieces, default=-1) + 1
        scan_pose = ScanPose(pose, np.diag(REGISTRATION_DEVIATION**2), matched=True, piece=piece)
        self._append(scan_pose)
        self._keep_for_grid(scan)
        self._add_key(scan)
        return scan_pose

    def _remove_key_scans(self) -> None:
        for each in (self.keys, self._key_pieces, self._elements, self._ranges, self._links):
            each.clear()

    def _append(self, scan_pose: ScanPose) -> None:
        self.poses.append(scan_pose.pose)
        self.pieces.append(scan_pose.piece)

    def _make_reference(self) -> None:
        """Makes the last scan the one from which the next pose is predicted."""
        self._reference, self._covariance_at_reference = len(self.poses) - 1, self._covariance_since_key
        self._since_reference, self._clock_stepped = 0.0, False

    def _keep_for_grid(self, scan: _Scan) -> None:
        """Keeps the last scan for the grid."""
        self._grid_scans.append((len(self.poses) - 1, self._evenly_spaced(scan).astype(np.float32)))

    def _is_key_due(self, scan: _Scan, *, early: bool) -> bool:
        """Whether the last scan is so far from the last key scan that it has to become one, sooner if ``early``."""
        off = se2.between(self.poses[self.keys[-1]], self.poses[-1])
        distance = max(KEY_DISTANCE_M, KEY_RANGE_SHARE * _median_range(scan.elements))
        progress = max(np.hypot(off[0], off[1]) / distance, abs(off[2]) / KEY_TURN_RAD)
        return bool(progress >= (EARLY_KEY_PROGRESS if early else 1.0))

    def _add_linked_key(self, scan: _Scan, information: Array) -> None:
        """Makes the last scan, registered with an ``information`` (3, 3), a key scan with a link to the last one."""
        last_key, pose = self.poses[self.keys[-1]], self.poses[-1]
        self._links.append(_link(len(self.keys) - 1, last_key, pose, information, self._covariance_since_key))
        self._add_key(scan)

    def _add_key(self, scan: _Scan) -> None:
        """Makes the last scan a key scan, and updates the local map."""
        piece = self.pieces[-1]
        self.keys.append(len(self.poses) - 1)
        self._key_pieces.append(piece)
        self._elements.append(scan.elements)
        self._ranges.append(self._evenly_spaced(scan))
        self._covariance_since_key = np.zeros((3, 3))
        self._make_reference()
        recent = range(max(self._first_local, len(self.keys) - LOCAL_SCANS), len(self.keys))
        poses = np.array([self.poses[self.keys[k]] for k in recent])
        local = concatenate([self._elements[k].transformed(pose) for k, pose in zip(recent, poses, strict=True)])
        scans = PosedScans(
            se2.compose(poses, self.laser.mount), np.array([self._ranges[k] for k in recent]), self.laser.angles
        )
        self._surface, self._local = Surface(local), Submap(0, 0, local, scans)

    def _evenly_spaced(self, scan: _Scan) -> Array:
        """The ranges (B,) of a scan at the laser's own angles."""
        if not self.laser.time_increment:
            return scan.ranges
        return evenly_spaced(scan.ranges, scan.angles, self._sweep, -np.inf)


def track_drive(drive: RawDrive, report: Callable[[float], None] = lambda _done: None) -> TrackedDrive:
    """Tracks the scans of a drive; reports the share that is done."""
    front_end = FrontEnd(drive.laser)
    for k, (stamp, ranges) in enumerate(zip(drive.stamps, drive.ranges, strict=True)):
        front_end.add(float(stamp), ranges, se2.known_pose(drive.odom, k))
        report(k / len(drive.ranges))
    return front_end.tracked_drive()


def _is_far(found: Registration | None, prior: PosePrior) -> bool:
    """Whether a registration is far from where the motion model expects it, or there is none."""
    return found is None or _is_elsewhere(prior.mean, found.pose)


def _is_elsewhere(a: Array, b: Array) -> bool:
    """Whether two poses (3,) are different places."""
    return bool((np.abs(se2.between(a, b)) > SAME_PLACE).any())


def _squared_deviation(found: Registration, prior: PosePrior, motion_covariance: Array) -> float:
    """Squared Mahalanobis distance of a registration from the prior's mean; both are uncertain."""
    difference = se2.difference(prior.mean, found.pose)
    return float(difference @ np.linalg.solve(motion_covariance + found.covariance, difference))


def _median_range(elements: Elements) -> float:
    return float(np.median(np.hypot(*elements.points.T))) if len(elements) else 0.0


def _learn_scale(scale: Array, deviation: Array, prior: PosePrior, found: Registration) -> Array:
    """The factor (3,) of the motion's deviations after one more scan, roughly by expectation maximisation.

    It is learned because the errors of odometries differ tenfold. Where the scan does not observe the motion, the
    factor stays. Where it hardly observes it, the factor becomes too large, as the match follows the scan more than the
    prior allows (`PRIOR_INFLATION`).
    """
    turn = se2.rotation(-float(prior.mean[2]))
    variance = np.diag(turn @ np.linalg.inv(found.information + prior.information) @ turn.T)
    squared = (se2.between(prior.mean, found.pose) ** 2 + variance) / deviation**2
    return np.asarray(scale * np.sqrt(1 + (np.minimum(squared, MAX_LEARNED_SIGMAS**2) - 1) / LEARNING_SCANS))


def _link(number: int, first: Array, second: Array, information: Array, motion_covariance: Array) -> PoseLink:
    """The link from key scan ``number`` to the next one, from two measurements of the motion between them.

    These are a registration, with its ``information`` (3, 3), and the motion model, with its covariance (3, 3), both in
    the frame of the front end.
    """
    turn = se2.rotation(-float(first[2]))
    registration_covariance = np.linalg.inv(turn @ information @ turn.T + 1e-6 * np.eye(3))
    registration_information = np.linalg.inv(registration_covariance + np.diag(REGISTRATION_DEVIATION**2))
    motion_information = np.linalg.inv(turn @ motion_covariance @ turn.T)
    return PoseLink(number, number + 1, se2.between(first, second), registration_information + motion_information)
