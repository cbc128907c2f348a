"""Masks beams that hit the robot itself.

In published scans such a beam is marked as not measured (0, see `ranges`), so that it is used neither for localisation
nor for obstacles. For braking and planning within a process it is NaN, as if the scanner did not have this beam, or 0
if the scan was corrected for the robot's motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import wrap
from common.robot.motion_distortion import correct_scan
from common.robot.ranges import NOT_MEASURED
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan

# A sector at least this wide can be removed from the field of view; a narrower one, such as a post, is only masked.
MIN_TRIMMED_SECTOR_RAD = float(np.deg2rad(30))

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class SelfFilter:
    """Masks the beams of one scanner that hit the robot: those in given sectors, and those shorter than a radius."""

    sectors: tuple[tuple[float, float], ...] = ()  # rad, lower and upper bound, in laser, seen from above
    radius: float = 0.0  # m around the laser

    @property
    def is_active(self) -> bool:
        """Whether any beam may be masked."""
        return bool(self.sectors) or self.radius > 0

    def mask_for_bus(self, scan: Scan) -> Scan:
        """The scan to publish: masked beams are marked as not measured."""
        return self._mask(scan, NOT_MEASURED) if self.is_active else scan

    def correct_and_mask(self, scan: Scan, velocity: Array) -> Scan:
        """The scan for braking and planning, not to be published; the robot moves with ``velocity`` (3,) in base_link.

        It is corrected for that motion, see `correct_scan`. Masked beams are NaN, or 0 if the scan was corrected. A
        wide sector at an end of the scan is removed from the field of view; of a scan that covers the full circle, the
        widest sector.
        """
        if not self.is_active:
            return correct_scan(scan, velocity)
        corrected = correct_scan(self._mask(scan, np.nan), velocity)
        return _trim_wide_sectors(corrected, self._in_sectors(corrected))

    def _in_sectors(self, scan: Scan) -> Mask:
        angles, inside = scan.angles(), np.zeros(len(scan.ranges), bool)
        for low, high in self.sectors:
            inside |= np.abs(wrap(angles - (low + high) / 2)) <= (high - low) / 2 + 1e-9
        return inside

    def _mask(self, scan: Scan, value: float) -> Scan:
        """Sets the ranges of beams in the sectors or within the radius to ``value``."""
        # Within the radius are also those that are too close to measure (-inf), but not those not measured (0).
        in_radius = (scan.ranges < np.float32(self.radius)) & (scan.ranges != NOT_MEASURED)
        masked = self._in_sectors(scan) | (in_radius & (self.radius > 0))
        return scan.model_copy(update={"ranges": np.where(masked, np.float32(value), scan.ranges)})


NO_FILTER = SelfFilter()


def _trim_wide_sectors(scan: Scan, in_sector: Mask) -> Scan:
    """Removes the beams ``in_sector`` (B,) from both ends of a scan, as far as they form wide sectors.

    The scan takes as long as before. The times of its beams are not kept, so it must have been corrected for motion.
    """
    sweep, shift = Sweep.of(scan), 0
    if in_sector.all() or not in_sector.any() or not sweep.spacing:
        return scan
    ranges = scan.ranges
    if sweep.all_round:
        beams = min(len(ranges), round(2 * np.pi / sweep.spacing))  # further ones repeat the directions of the first
        ranges, in_sector = ranges[:beams], in_sector[:beams]
        shift = _end_of_longest_run(in_sector)  # rotate the longest run to the end, where it can be removed
        ranges, in_sector = np.roll(ranges, -shift), np.roll(in_sector, -shift)
    min_beams = max(1, round(MIN_TRIMMED_SECTOR_RAD / sweep.spacing))
    first, last = (run if run >= min_beams else 0 for run in (_leading_run(in_sector), _leading_run(in_sector[::-1])))
    if not (first or last):
        return scan
    ranges = ranges[first : len(ranges) - last]
    time_increment = scan.time_increment * (len(scan.ranges) - 1) / max(1, len(ranges) - 1)
    angle_min = float(wrap(scan.angle_min + scan.angle_increment * (shift + first)))
    return scan.model_copy(update={"ranges": ranges, "angle_min": angle_min, "time_increment": time_increment})


def _leading_run(mask: Mask) -> int:
    """Number of True values before the first False one."""
    return int(np.argmin(mask))


def _end_of_longest_run(mask: Mask) -> int:
    """Index after the longest run of True values in a circular mask that has both values."""
    begin = int(np.argmin(mask))  # False, so that no run continues across it
    ring = np.roll(mask, -begin).astype(np.int8)
    edges = np.diff(ring, prepend=0, append=0)
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return (begin + int(ends[np.argmax(ends - starts)])) % len(mask)
