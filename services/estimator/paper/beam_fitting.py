"""Resamples another scanner's scan to the beams of the training, or refuses it.

The range of each of the model's beams is interpolated linearly between the two nearest beams of the scan. This is
possible if the scan covers the model's field of view, with beams at most `MAX_SPACING_RATIO` times as far apart, from
the same position on the robot. A scanner may be rotated or mounted upside down, because only directions in base_link
matter.
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

TOLERANCE = 1e-4  # rad and m; smaller differences are ignored
MAX_FIELD_OF_VIEW_DEG = 360.1  # from the first beam to the last; some drivers measure the first direction twice
MAX_SPACING_RATIO = 4.0  # of the scan's beams, relative to the model's


@dataclass(frozen=True)
class BeamFit:
    """Converts between the B beams of a scan and the M beams of a model."""

    model_angles: Array  # (M,) rad, the model's beams relative to the centre of its view, ascending
    order: npt.NDArray[np.intp]  # (M,) indices of these beams in the model
    before: npt.NDArray[np.intp]  # (M,) the scan's beam before each of them
    after: npt.NDArray[np.intp]  # (M,) the scan's beam after each of them
    share: Array  # (M,) weight of the beam after it
    view_centre: float  # rad, centre of the model's view in the scan's laser frame
    same: bool  # the beams are identical, so that nothing is interpolated

    def ranges(self, ranges: Array) -> Array:
        """Ranges (M,) in m along the model's beams, from the scan's finite ranges (B,) m."""
        if self.same:
            return ranges
        found = np.empty(len(self.model_angles))
        found[self.order] = (1 - self.share) * ranges[self.before] + self.share * ranges[self.after]
        return found

    def valid_beams(self, valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Whether each of the model's beams (M,) is computed from ``valid`` beams of the scan (B,) only."""
        if self.same:
            return valid
        found = np.empty(len(self.model_angles), bool)
        found[self.order] = (valid[self.before] | (self.share >= 1)) & (valid[self.after] | (self.share <= 0))
        return found

    def predicted(self, ranges: Array, angles: Array) -> Array:
        """Ranges (N, B) in m along the scan's beams at ``angles`` (B,) rad, from the model's (N, M); +inf outside."""
        off = wrap(angles - self.view_centre)
        ascending = np.atleast_2d(ranges)[:, self.order]
        inside = (off >= self.model_angles[0] - TOLERANCE) & (off <= self.model_angles[-1] + TOLERANCE)
        found = np.full((len(ascending), len(off)), np.inf)
        found[:, inside] = [np.interp(off[inside], self.model_angles, row) for row in ascending]
        return found


def fit(scanner: Scanner, angles: Array, mount: Array, remedy: str) -> BeamFit:
    """Returns the conversion of scans at ``angles`` (B,) rad, of a laser at ``mount`` (3,), for a model of ``scanner``.

    Raises UserError with the reason if the scans do not suit the model; ``remedy`` is the command that trains another.
    """

    def refuse(reason: str) -> UserError:
        known = f"{scanner.name} with {scanner.beams} beams"
        return UserError(f"the scan does not fit the weights, trained for {known}: {reason}; train for it: {remedy}")

    off = np.abs(mount[:2] - np.array(scanner.mount[:2])).max()
    if off > TOLERANCE:
        here, there = (f"({x:g}, {y:g}) m" for x, y in (mount[:2], scanner.mount[:2]))
        raise refuse(f"the laser is mounted at {here}, but the weights are for {there}")
    if (round_deg := float(np.rad2deg(np.ptp(angles)))) > MAX_FIELD_OF_VIEW_DEG:
        raise refuse(f"the scan's beams cover {round_deg:.0f} deg, more than a full turn")
    turned = float(mount[2]) - scanner.mount[2]
    centre = scanner.angle_min + scanner.angle_increment * (scanner.beams - 1) / 2
    model_angles = scanner.angles() - centre
    scan_angles = wrap(angles + turned - centre)
    same = len(angles) == scanner.beams and float(np.abs(wrap(scan_angles - model_angles)).max()) < TOLERANCE
    order, by_angle = np.argsort(model_angles), np.argsort(scan_angles)
    # Repeated by a full turn to either side, for scanners that look all round.
    around = np.concatenate(
        [scan_angles[by_angle] - 2 * np.pi, scan_angles[by_angle], scan_angles[by_angle] + 2 * np.pi]
    )
    index = np.tile(by_angle, 3)
    ascending = model_angles[order]
    after = np.searchsorted(around, ascending - TOLERANCE)
    before = np.maximum(after - 1, 0)
    exact = np.abs(around[after] - ascending) <= TOLERANCE
    gap = np.where(exact, 0.0, around[after] - around[before])
    max_gap = MAX_SPACING_RATIO * abs(scanner.angle_increment)
    if (gap > max_gap).any() and not same:
        spacing = float(np.median(np.diff(np.sort(scan_angles))))
        if spacing > max_gap:
            raise refuse(
                f"the scan's beams are {np.rad2deg(spacing):.2f} deg apart; these weights accept at most "
                f"{np.rad2deg(max_gap):.2f} deg"
            )
        blind = np.rad2deg(float(wrap(ascending[np.argmax(gap)] + centre + scanner.mount[2])))
        raise refuse(f"the scan has no beams towards {blind:.0f} deg in base_link, which these weights need")
    share = np.where(exact, 1.0, (ascending - around[before]) / np.maximum(gap, 1e-12))
    return BeamFit(ascending, order, index[before], index[after], share, centre - turned, same)
