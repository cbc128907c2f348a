"""Uses scan matching to tell a changed scene from a kidnapping.

A scan that fits the scans just before it was taken near them: nobody has carried the robot off meanwhile, however
little the model explains of what is seen. What is seen behind the walls that it expects speaks against that (`DOUBT`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.gauss_newton import NARROW, WIDE, Prior, View, descending, polishing
from services.estimator.precise.motion_model import Candidate
from services.estimator.precise.scan_memory import Match, RecentScans

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.settings import Settings
    from services.estimator.shared.asking import Conversation

BEGINS, GOES_ON = 0.75, 0.45  # least share of a scan's points that were seen before: the first that is held; others
TURNS = np.array([-0.3, -0.15, 0.15, 0.3])  # rad, tried besides where a scan does not go on so clearly:
CLEARLY = 0.8
REACH = 0.3  # m: a robot that may have gone further since the last scan may have been carried as well
PROVEN = 3  # scans kept that the model explained, before it may explain less
DRIFT = np.array([0.02, 0.02, 0.005])  # m, m, rad: standard deviation that every scan kept adds
DOUBT, MEMORY = 0.35, 0.95  # share of the beams, averaged over so many scans, that may end behind what is expected
PARTLY, LESS = 0.1, 4  # weight of what a model says that explains a scan in part, and the power of its share of `good`
FAR = 16.0  # squared standard deviations
AROUND = np.array([0.3, 0.3, 0.3])  # m, m, rad: how far a place that the model claims may be off


class Continuity:
    """The scans since the place was sure, in a frame of their own that the model's evidence moves as one."""

    def __init__(self, mount: Array) -> None:
        """``mount`` (3,) is the laser in base_link."""
        self._scans = RecentScans(mount)
        self.forget()

    def forget(self, *, given: bool = False) -> None:
        """Begin anew: the robot is elsewhere; ``given``: where is known, and need not be proven by scans."""
        self._scans.forget()
        self._frame = np.zeros(3)  # of the scans kept, in map
        self._anchor = np.zeros((3, 3))  # covariance of the place that they hang on
        self._late, self._proven = 0.0, PROVEN * given
        self._seen_from: Array | None = None  # (3,) in that frame, of the last scan
        self._holds = False  # the place, since some scans
        self._often = True  # scans come, for a robot as fast as this

    def keep(self, pose: Array, covariance: Array, points: Array, *, explained: bool) -> None:
        """A scan's points (K, 2) m in the laser, seen from ``pose`` (3,) that is known within ``covariance``."""
        if self._scans.empty:
            self._frame = np.array(pose)
        local = self._seen_from
        if local is None:  # the model alone has said where
            self._holds = False
            local = se2.between(self._frame, pose)
        if self._scans.keep(local, points):
            self._frame = se2.compose(pose, se2.inverse(local))
            self._anchor = covariance + np.diag(DRIFT**2)
            self._proven += explained

    def passed(self, reach: float) -> None:
        """The next scan is another; the robot may have gone ``reach`` m since the last."""
        self._seen_from, self._often = None, reach <= REACH

    def hold(self, options: list[Candidate], start: Array, points: Array, late: float) -> Candidate | None:
        """Where a scan goes on from those kept, if it does.

        ``options``: where the robot may have moved, the widest last; ``start`` (3,): where else to begin; points (K, 2)
        m in the laser; ``late``: the share of the beams that end behind what is expected.
        """
        if self._proven < PROVEN or not self._often:
            return None
        self._late += (1 - MEMORY) * (late - self._late)
        match = self._match(np.array([*(option.mean for option in options), start]), points, options[-1])
        least = GOES_ON if self._holds else BEGINS
        self._holds = False
        if match is None or match.share < least or match.blind or self._late > DOUBT:
            return None
        self._seen_from, self._holds = match.pose, True
        turn = _turned(self._frame[2])
        spread = self._anchor + turn @ match.covariance @ turn.T
        return Candidate("recent scans", se2.compose(self._frame, match.pose), spread, 1.0)

    def _match(self, starts: Array, points: Array, widest: Candidate) -> Match | None:
        back = _turned(-self._frame[2])
        prior = replace(
            widest, mean=se2.between(self._frame, widest.mean), covariance=back @ widest.covariance @ back.T
        )
        local = se2.between(self._frame, starts)
        found = [self._scans.match(local, points, prior)]
        if found[0] is None or found[0].share < CLEARLY:
            turned = np.repeat(local[:1], len(TURNS), axis=0)
            turned[:, 2] = se2.wrap(turned[:, 2] + TURNS)
            found.append(self._scans.match(turned, points, prior))
        return max((each for each in found if each is not None), key=lambda each: each.score, default=None)


def looked_at(view: View, held: Candidate, settings: Settings) -> Conversation[tuple[Array, Evidence]]:
    """Pose (1, 3) and evidence of the model near ``held``, where it has changed or was never learned.

    What was moved moves many beams alike, so such evidence counts little; where next to nothing is explained it is
    chance, and none is left.
    """
    starts = held.mean + _spread_out(held.covariance)
    starts[:, 2] = se2.wrap(starts[:, 2])
    prior = Prior.alike(len(starts), held.mean, held.covariance)
    for widen in (WIDE, NARROW):
        starts, _ = yield from descending(view, starts, prior, widen, 4)
    poses, evidence = yield from polishing(view, starts, prior)
    best = int(np.argmin(evidence.accuracy + prior.energy(poses)))
    poses, evidence = poses[best : best + 1], evidence.part(np.array([best]))
    share = float(evidence.explained[0]) / settings.good
    if evidence.explained[0] < settings.believable:
        poses, share = held.mean[None].copy(), 0.0
        evidence = yield from view.looking(poses)
    weight = PARTLY * min(1.0, share) ** LESS
    parts = ("xi", "curvature", "of_noise", "of_model")
    return poses, replace(evidence, **{name: weight * getattr(evidence, name) for name in parts})


def agree(pose: Array, held: Candidate) -> bool:
    """Whether ``pose`` (3,) lies where ``held`` says."""
    return held.squared_distance(pose) < FAR


def around(pose: Array) -> Candidate:
    """Where a robot is whose place (3,) the model claims."""
    return Candidate("here", pose, np.diag(AROUND**2), 1.0)


def _spread_out(covariance: Array) -> Array:
    """(13, 3) offsets: none, and one and two standard deviations along each axis of (3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    axes = (np.sqrt(np.maximum(values, 0.0)) * vectors).T
    return np.concatenate([np.zeros((1, 3)), axes, -axes, 2 * axes, -2 * axes])


def _turned(yaw: float) -> Array:
    """(3, 3) of a covariance of x, y, yaw in a frame turned by ``yaw`` rad."""
    matrix = np.eye(3)
    matrix[:2, :2] = se2.rotate(float(yaw), np.eye(2)).T
    return matrix
