"""Uses scan matching to tell a changed scene from a kidnapping.

If a scan matches the scans just before it, it was taken near them. The robot was then not carried away, however little
the model explains of the scan. Beams that end behind the walls that the model expects are evidence against this
(`MAX_BEHIND_RATIO`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.gauss_newton import FINE_SIGMA_M, MEDIUM_SIGMA_M, Prior, View
from services.estimator.precise.motion_model import Candidate
from services.estimator.precise.scan_memory import Match, RecentScans

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.settings import Settings

# Minimum share of a scan's points that match recent scans, for matching to hold the pose: at the first scan, and at the
# scans that follow it.
MIN_SHARE_TO_BEGIN, MIN_SHARE_TO_CONTINUE = 0.75, 0.45
CLEAR_SHARE = 0.8  # if the share is smaller, matching is repeated from other headings
EXTRA_HEADINGS_RAD = np.array([-0.3, -0.15, 0.15, 0.3])
MAX_REACH_M = 0.3  # if the robot can drive farther between two scans, a match does not exclude a kidnapping
MIN_PROVEN_SCANS = 3  # scans that the model explained, needed before matching may give the pose
DRIFT_PER_SCAN = np.array([0.02, 0.02, 0.005])  # m, m, rad: standard deviation that each added scan contributes
MAX_BEHIND_RATIO = 0.35  # limit of the average share of beams behind the expected surface
BEHIND_MEMORY = 0.95  # decay of this average from scan to scan
# Weight of the model's evidence where it explains only part of a scan:
# PARTIAL_WEIGHT * (inlier ratio / good_inlier_ratio) ** PARTIAL_EXPONENT.
PARTIAL_WEIGHT, PARTIAL_EXPONENT = 0.1, 4
MAX_SQUARED_DISTANCE = 16.0  # squared standard deviations within which two poses are consistent
MODEL_POSE_SIGMAS = np.array([0.3, 0.3, 0.3])  # m, m, rad: standard deviation assumed for a pose found by the model


class Continuity:
    """The scans since the pose became certain, in a local frame.

    Evidence from the model moves this frame in the map, and all scans with it.
    """

    def __init__(self, mount: Array) -> None:
        """``mount`` (3,) is the laser in base_link."""
        self._scans = RecentScans(mount)
        self.reset()

    def reset(self, *, pose_given: bool = False) -> None:
        """Discards all scans; a pose that was given by the user does not have to be proven by scans first."""
        self._scans.clear()
        self._frame = np.zeros(3)  # local frame in map
        self._anchor_covariance = np.zeros((3, 3))  # of the pose at which the last scan was added
        self._mean_behind_ratio, self._proven_scans = 0.0, MIN_PROVEN_SCANS * pose_given
        self._matched_pose: Array | None = None  # (3,) of the present scan, in the local frame
        self._last_scan_matched = False  # matching gave the pose of the last scan
        self._scans_frequent = True  # the robot can drive at most MAX_REACH_M between two scans

    def add(self, pose: Array, covariance: Array, points: Array, *, explained: bool) -> None:
        """Adds the present scan, points (K, 2) m in the laser frame, taken at ``pose`` (3,) with ``covariance``.

        ``explained`` is whether the model explains the scan.
        """
        if self._scans.empty:
            self._frame = np.array(pose)
        local = self._matched_pose
        if local is None:  # the pose comes from the model alone
            self._last_scan_matched = False
            local = se2.between(self._frame, pose)
        if self._scans.add(local, points):
            self._frame = se2.compose(pose, se2.inverse(local))
            self._anchor_covariance = covariance + np.diag(DRIFT_PER_SCAN**2)
            self._proven_scans += explained

    def begin_scan(self, reach: float) -> None:
        """Prepares for the next scan; the robot can have driven up to ``reach`` m since the last one."""
        self._matched_pose, self._scans_frequent = None, reach <= MAX_REACH_M

    def match(self, candidates: list[Candidate], start: Array, points: Array, behind_ratio: float) -> Candidate | None:
        """Returns the pose at which the present scan continues the stored ones; None if it does not.

        ``candidates`` are the possible motions, the widest last. ``start`` (3,) is an additional start of the descent.
        ``points`` (K, 2) m are in the laser frame. ``behind_ratio`` is the share of beams behind the expected surface.
        """
        if self._proven_scans < MIN_PROVEN_SCANS or not self._scans_frequent:
            return None
        self._mean_behind_ratio += (1 - BEHIND_MEMORY) * (behind_ratio - self._mean_behind_ratio)
        match = self._match(np.array([*(each.mean for each in candidates), start]), points, candidates[-1])
        min_share = MIN_SHARE_TO_CONTINUE if self._last_scan_matched else MIN_SHARE_TO_BEGIN
        self._last_scan_matched = False
        if match is None or match.share < min_share or match.degenerate or self._mean_behind_ratio > MAX_BEHIND_RATIO:
            return None
        self._matched_pose, self._last_scan_matched = match.pose, True
        turn = _rotation(self._frame[2])
        covariance = self._anchor_covariance + turn @ match.covariance @ turn.T
        return Candidate("recent scans", se2.compose(self._frame, match.pose), covariance, 1.0)

    def _match(self, starts: Array, points: Array, widest: Candidate) -> Match | None:
        turn = _rotation(-self._frame[2])
        prior = replace(
            widest, mean=se2.between(self._frame, widest.mean), covariance=turn @ widest.covariance @ turn.T
        )
        local = se2.between(self._frame, starts)
        found = [self._scans.match(local, points, prior)]
        if found[0] is None or found[0].share < CLEAR_SHARE:
            turned = np.repeat(local[:1], len(EXTRA_HEADINGS_RAD), axis=0)
            turned[:, 2] = se2.wrap(turned[:, 2] + EXTRA_HEADINGS_RAD)
            found.append(self._scans.match(turned, points, prior))
        return max((each for each in found if each is not None), key=lambda each: each.score, default=None)


def refine_in_changed_scene(view: View, matched: Candidate, settings: Settings) -> tuple[Array, Evidence]:
    """Returns a pose (1, 3) near ``matched``, the pose from scan matching, and the model's evidence there.

    It is for places that changed or were not learned. One moved object shifts many beams in the same way, so the
    evidence gets a low weight. If the model explains almost nothing of the scan, the beams that it does explain are
    coincidences: the pose is then ``matched``, and the evidence has weight 0.
    """
    starts = matched.mean + _sigma_points(matched.covariance)
    starts[:, 2] = se2.wrap(starts[:, 2])
    prior = Prior.repeated(len(starts), matched.mean, matched.covariance)
    for extra_sigma in (MEDIUM_SIGMA_M, FINE_SIGMA_M):
        starts, _ = view.descend(starts, prior, extra_sigma, 4)
    poses, evidence = view.polish(starts, prior)
    best = int(np.argmin(evidence.accuracy + prior.energy(poses)))
    poses, evidence = poses[best : best + 1], evidence.part(np.array([best]))
    share = float(evidence.inlier_ratio[0]) / settings.good_inlier_ratio
    if evidence.inlier_ratio[0] < settings.min_inlier_ratio:
        poses, share = matched.mean[None].copy(), 0.0
        evidence = view.evidence(poses)
    weight = PARTIAL_WEIGHT * min(1.0, share) ** PARTIAL_EXPONENT
    weighted = ("xi", "curvature", "xi_noise_covariance", "xi_model_covariance")
    return poses, replace(evidence, **{name: weight * getattr(evidence, name) for name in weighted})


def is_consistent(pose: Array, matched: Candidate) -> bool:
    """Whether ``pose`` (3,) agrees with the pose from scan matching within its covariance."""
    return matched.squared_distance(pose) < MAX_SQUARED_DISTANCE


def candidate_at(pose: Array) -> Candidate:
    """A prior for scan matching around ``pose`` (3,) that the model found."""
    return Candidate("here", pose, np.diag(MODEL_POSE_SIGMAS**2), 1.0)


def _sigma_points(covariance: Array) -> Array:
    """Offsets (13, 3): zero, and one and two standard deviations along each axis of ``covariance`` (3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    axes = (np.sqrt(np.maximum(values, 0.0)) * vectors).T
    return np.concatenate([np.zeros((1, 3)), axes, -axes, 2 * axes, -2 * axes])


def _rotation(yaw: float) -> Array:
    """Matrix (3, 3) that rotates a covariance of x, y, yaw by ``yaw`` rad."""
    matrix = np.eye(3)
    matrix[:2, :2] = se2.rotate(float(yaw), np.eye(2)).T
    return matrix
