"""Masks beams that hit the robot itself.

In published scans such a beam is marked as not measured (0, see `ranges`), so that it is used neither for localisation
nor for obstacles. For braking and planning within a process it is NaN, which counts as no beam at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import wrap
from common.robot.ranges import NOT_MEASURED
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.messages.definitions import Scan

# A masked sector wider than this is removed from the field of view; a narrow one, such as a post, is not.
MIN_TRIMMED_SECTOR_RAD = float(np.deg2rad(30))


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
        return self._replaced(scan, self._masked(scan), NOT_MEASURED) if self.is_active else scan

    def mask_for_planning(self, scan: Scan) -> Scan:
        """The scan for braking and planning, not to be published: masked beams are NaN, and wide sectors are removed.

        A wide sector in the middle of a scan that does not cover the full circle cannot be removed and is NaN only.
        """
        if not self.is_active:
            return scan
        in_sector = self._in_sectors(scan)
        scan = self._replaced(scan, self._masked(scan), np.nan)
        sweep, shift = Sweep.of(scan), 0
        if sweep.all_round and in_sector.any() and not in_sector.all():
            shift = _end_of_longest_run(in_sector)  # rotate the longest run to the end, where it can be removed
            in_sector = np.roll(in_sector, -shift)
        min_beams = max(1, round(MIN_TRIMMED_SECTOR_RAD / sweep.spacing)) if sweep.spacing else len(in_sector) + 1
        first, last = _leading_run(in_sector), _leading_run(in_sector[::-1])
        first, last = (run if run >= min_beams else 0 for run in (first, last))
        if first + last >= len(in_sector) or not (first or last):
            return scan
        ranges = np.roll(scan.ranges, -shift)[first : len(in_sector) - last]
        angle_min = float(wrap(scan.angle_min + scan.angle_increment * (shift + first)))
        return scan.model_copy(update={"ranges": ranges, "angle_min": angle_min})

    def _in_sectors(self, scan: Scan) -> npt.NDArray[np.bool_]:
        angles, inside = scan.angles(), np.zeros(len(scan.ranges), bool)
        for low, high in self.sectors:
            inside |= np.abs(wrap(angles - (low + high) / 2)) <= (high - low) / 2 + 1e-9
        return inside

    def _masked(self, scan: Scan) -> npt.NDArray[np.bool_]:
        """(B,) mask by sectors and radius: it includes -inf (too close) but not 0, which is not a distance."""
        if not self.radius:
            return self._in_sectors(scan)
        return np.asarray(self._in_sectors(scan) | (scan.ranges < np.float32(self.radius)) & (scan.ranges != 0))

    @staticmethod
    def _replaced(scan: Scan, masked: npt.NDArray[np.bool_], value: float) -> Scan:
        ranges = np.where(masked, np.float32(value), scan.ranges).astype(np.float32)
        return scan.model_copy(update={"ranges": ranges})


def _leading_run(mask: npt.NDArray[np.bool_]) -> int:
    """Number of True values at the beginning."""
    return len(mask) if mask.all() else int(np.argmin(mask))


def _end_of_longest_run(mask: npt.NDArray[np.bool_]) -> int:
    """Index after the longest run of True values in a circular mask that has both values."""
    begin = int(np.argmin(mask))  # False, so that no run continues across it
    ring = np.roll(mask, -begin).astype(np.int8)
    edges = np.diff(ring, prepend=0, append=0)
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return (begin + int(ends[np.argmax(ends - starts)])) % len(mask)
