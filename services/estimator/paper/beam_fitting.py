"""Resamples another scanner's scan to the beams of the training, or refuses it.

Each of the model's beams takes the range between the two beams of the scan on either side of it, linearly. That holds
where the scan looks wherever the model does, with beams at most `COARSEST` times as far apart, from the same place on
the robot; a scanner turned or hung upside down is no hindrance, for only directions in base_link count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.errors import UserError
from common.geometry.se2 import wrap

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.scanner import Scanner

TOLERANCE = 1e-4  # rad and m; nearer is the same
ROUND = 360.1  # deg, from the first beam to the last; some drivers measure the first direction twice
COARSEST = 4.0  # times the model's spacing


@dataclass(frozen=True)
class Fit:
    """From B beams of a scan to the M of a model and back."""

    own: Array  # (M,) rad, the model's beams from the middle of its view, ascending
    order: npt.NDArray[np.intp]  # (M,) which of its beams these are
    low: npt.NDArray[np.intp]  # (M,) beam of the scan before each, and
    high: npt.NDArray[np.intp]  # (M,) after
    share: Array  # (M,) of the second
    middle: float  # rad, of the model's view, in the scan's laser frame
    same: bool  # beam for beam: nothing is computed

    def ranges(self, ranges: Array) -> Array:
        """(M,) m the model's beams measure, of finite ranges (B,) m."""
        if self.same:
            return ranges
        found = np.empty(len(self.own))
        found[self.order] = (1 - self.share) * ranges[self.low] + self.share * ranges[self.high]
        return found

    def of_all(self, beams: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(M,) which of the model's beams are made of none but these (B,) of the scan's."""
        if self.same:
            return beams
        found = np.empty(len(self.own), bool)
        found[self.order] = (beams[self.low] | (self.share >= 1)) & (beams[self.high] | (self.share <= 0))
        return found

    def predicted(self, ranges: Array, angles: Array) -> Array:
        """(N, B) m expected along the scan's beams at ``angles`` (B,) rad, of the model's (N, M); +inf outside."""
        off = wrap(angles - self.middle)
        ascending = np.atleast_2d(ranges)[:, self.order]
        inside = (off >= self.own[0] - TOLERANCE) & (off <= self.own[-1] + TOLERANCE)
        found = np.full((len(ascending), len(off)), np.inf)
        found[:, inside] = [np.interp(off[inside], self.own, row) for row in ascending]
        return found


def fit(scanner: Scanner, angles: Array, mount: Array, remedy: str) -> Fit:
    """How scans at ``angles`` (B,) rad of a laser mounted at ``mount`` (3,) serve a model of ``scanner``.

    Raises UserError where they do not, saying why; ``remedy`` is the command that helps.
    """

    def refuse(why: str) -> UserError:
        known = f"{scanner.name} with {scanner.beams} beams"
        return UserError(f"the scan does not fit the weights, trained for {known}: {why}; train for it: {remedy}")

    off = np.abs(mount[:2] - np.array(scanner.mount[:2])).max()
    if off > TOLERANCE:
        here, there = (f"({x:g}, {y:g}) m" for x, y in (mount[:2], scanner.mount[:2]))
        raise refuse(f"its laser is mounted at {here}, theirs at {there}")
    if (round_deg := float(np.rad2deg(np.ptp(angles)))) > ROUND:
        raise refuse(f"its beams go round more than once, {round_deg:.0f} deg from the first to the last")
    turned = float(mount[2]) - scanner.mount[2]
    middle = scanner.angle_min + scanner.angle_increment * (scanner.beams - 1) / 2
    own = scanner.angles() - middle
    seen = wrap(angles + turned - middle)
    same = len(angles) == scanner.beams and float(np.abs(wrap(seen - own)).max()) < TOLERANCE
    order, by_angle = np.argsort(own), np.argsort(seen)
    # Once more on either side, for views that go all round.
    around = np.concatenate([seen[by_angle] - 2 * np.pi, seen[by_angle], seen[by_angle] + 2 * np.pi])
    index = np.tile(by_angle, 3)
    asc = own[order]
    after = np.searchsorted(around, asc - TOLERANCE)
    before = np.maximum(after - 1, 0)
    at = np.abs(around[after] - asc) <= TOLERANCE
    gap = np.where(at, 0.0, around[after] - around[before])
    most = COARSEST * abs(scanner.angle_increment)
    if (gap > most).any() and not same:
        spacing = float(np.median(np.diff(np.sort(seen))))
        if spacing > most:
            apart = f"its beams are {np.rad2deg(spacing):.2f} deg apart, theirs {np.rad2deg(most / COARSEST):.2f}"
            raise refuse(f"{apart}, and {COARSEST:g} times as far is the most")
        blind = np.rad2deg(float(wrap(asc[np.argmax(gap)] + middle + scanner.mount[2])))
        raise refuse(f"it does not look towards {blind:.0f} deg of base_link, as they do")
    share = np.where(at, 1.0, (asc - around[before]) / np.maximum(gap, 1e-12))
    return Fit(asc, order, index[before], index[after], share, middle - turned, same)
