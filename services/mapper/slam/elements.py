"""Surface elements of a scan: short lines with a position and a normal.

An element is a line fitted to neighbouring beams, so it carries their information with less noise. Its normal points to
the scanner, so the two sides of a thin wall are never confused.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.ranges import is_surface

HALF_WIDTH_M = 0.06  # of an element, across the beams
SPACING_M = 0.1  # between elements, across the beams
# Neighbouring points belong to different surfaces if their distance exceeds both limits; the second one is a
# multiple of the spacing of the beams at this range, on a surface perpendicular to them.
MIN_GAP_M, GAP_BEAMS = 0.12, 6.0
MAX_ROUGHNESS_M = 0.03  # standard deviation of the points from the line; rougher elements are corners
MAX_DIRECTION_VARIANCE = 1.0  # rad², about the variance of a direction that is unknown
MIN_POINTS = 3  # from which the direction of a surface is computed


@dataclass(frozen=True)
class Elements:
    """K surface elements in one frame."""

    points: Array  # (K, 2) m
    normals: Array  # (K, 2) unit vectors towards free space
    lengths: Array  # (K,) m, extent of each along its surface
    direction_variances: Array  # (K,) rad²

    def transformed(self, pose: Array) -> Elements:
        """The elements in the parent frame of the frame with ``pose`` (3,)."""
        points, normals = se2.transform(pose, self.points), se2.rotate(float(pose[2]), self.normals)
        return replace(self, points=points, normals=normals)

    def part(self, which: npt.NDArray[np.integer | np.bool_]) -> Elements:
        """The elements with these indices, or in this mask."""
        return Elements(self.points[which], self.normals[which], self.lengths[which], self.direction_variances[which])

    def divided(self) -> Elements:
        """The same surfaces, in elements of at most `SPACING_M`; where beams are sparse, elements are longer."""
        count = np.maximum(np.ceil(self.lengths / SPACING_M), 1).astype(int)
        which = np.repeat(np.arange(len(self)), count)
        number = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        along = ((number + 0.5) / count[which] - 0.5) * self.lengths[which]
        x, y = self.normals[which].T
        points = self.points[which] + along[:, None] * np.column_stack([-y, x])
        return replace(self.part(which), points=points, lengths=self.lengths[which] / count[which])

    def __len__(self) -> int:
        return len(self.points)


def concatenate(elements: list[Elements]) -> Elements:
    """All elements of a list, in one frame."""
    return Elements(*(np.concatenate([getattr(each, field.name) for each in elements]) for field in fields(Elements)))


def elements_of_scan(ranges: Array, angles: Array, mount: Array, range_max: float) -> Elements:
    """Surface elements in base_link of a scan ``ranges`` (B,) m at ``angles`` (B,) rad."""
    hit = np.flatnonzero(is_surface(ranges) & (ranges < range_max))
    if len(hit) < MIN_POINTS:
        return Elements(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    r, angle = ranges[hit], angles[hit]
    points = r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    step = abs(angles[-1] - angles[0]) / (len(angles) - 1)
    apart = np.hypot(*np.diff(points, axis=0).T) > np.maximum(MIN_GAP_M, GAP_BEAMS * np.minimum(r[1:], r[:-1]) * step)
    surface = np.concatenate([[0], np.cumsum(apart)])
    # Distance along the scan across the beams, with a jump from one surface to the next.
    along = np.concatenate([[0.0], np.cumsum((r[1:] + r[:-1]) / 2 * np.diff(hit) * step + apart * 10 * HALF_WIDTH_M)])
    return _fit_lines(points, *_windows(along, surface)).transformed(mount)


def _windows(along: Array, surface: npt.NDArray[np.int_]) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.int_]]:
    """Index of the first point and of the one after the last of each element; an element lies on one ``surface`` (N,).

    ``along`` (N,) m are the places of the points along the scan.
    """
    middle = np.flatnonzero(np.diff(np.floor(along / SPACING_M), prepend=-1.0) > 0)  # first point of each interval
    first = np.minimum(np.searchsorted(along, along[middle] - HALF_WIDTH_M), middle - 1)
    last = np.maximum(np.searchsorted(along, along[middle] + HALF_WIDTH_M, side="right"), middle + 2)
    first = np.maximum(first, np.searchsorted(surface, surface[middle]))
    last = np.minimum(last, np.searchsorted(surface, surface[middle], side="right"))
    return first, last


def _fit_lines(points: Array, first: npt.NDArray[np.int_], last: npt.NDArray[np.int_]) -> Elements:
    """Lines through points ``first`` to ``last`` - 1 of ``points`` (N, 2) m in laser, without corners."""
    x, y = points.T
    sums = np.concatenate([np.zeros((1, 5)), np.cumsum(np.stack([x, y, x * x, x * y, y * y], axis=-1), axis=0)])
    count = last - first
    mx, my, xx, xy, yy = ((sums[last] - sums[first]) / np.maximum(count, 1)[:, None]).T
    xx, xy, yy = xx - mx**2, xy - mx * my, yy - my**2  # covariance
    angle = np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    normals *= -np.sign(normals[:, 0] * mx + normals[:, 1] * my)[:, None]  # towards the scanner
    # Eigenvalues of the covariance.
    middle, half_difference = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    across, along = middle - half_difference, middle + half_difference
    flat = (count >= MIN_POINTS) & (across < MAX_ROUGHNESS_M**2)
    lengths = np.hypot(*(points[last - 1] - points[first]).T) / 2
    # Asymptotic variance of the direction of a principal component (Anderson, Ann. Math. Stat. 34, 1963), with n - 2
    # instead of n, because a line has two parameters.
    spread = (count - 2) * (along - across) ** 2
    variances = np.clip((across * along)[flat] / np.maximum(spread[flat], 1e-12), 0.0, MAX_DIRECTION_VARIANCE)
    return Elements(np.column_stack([mx, my])[flat], normals[flat], lengths[flat], variances)
