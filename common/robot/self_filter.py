"""Masks beams that hit the robot itself.

On the bus such a beam is one that was not measured (0, see `ranges`): it says nothing of the place or of obstacles. For
who brakes and plans here it is no beam at all (NaN).
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

MIN_TRIMMED_SECTOR_RAD = float(np.deg2rad(30))  # a blind sector wider than this is taken out of the field of view; a post is not


@dataclass(frozen=True)
class SelfFilter:
    """Of one scanner; nothing is cut out unless told."""

    sectors: tuple[tuple[float, float], ...] = ()  # rad, lower and upper bound, in laser, seen from above
    radius: float = 0.0  # m about the laser; what is nearer is the robot

    @property
    def anything(self) -> bool:
        """Whether there is anything to cut out."""
        return bool(self.sectors) or self.radius > 0

    def mask_for_bus(self, scan: Scan) -> Scan:
        """For the bus: beams cut out are not measured."""
        return self._with(scan, self._cut(scan), NOT_MEASURED) if self.anything else scan

    def mask_for_planning(self, scan: Scan) -> Scan:
        """For who brakes and plans, never for the bus: beams cut out are NaN; a wide sector is no more in the sweep.

        In the middle of a scan that does not go all round it cannot be left out: there the beams are NaN alone.
        """
        if not self.anything:
            return scan
        cut = self._by_angle(scan)
        scan = self._with(scan, self._cut(scan), np.nan)
        sweep, shift = Sweep.of(scan), 0
        if sweep.all_round and cut.any() and not cut.all():
            shift = _after_longest(cut)  # the longest run goes to the end, where it can be left out
            cut = np.roll(cut, -shift)
        least = max(1, round(MIN_TRIMMED_SECTOR_RAD / sweep.spacing)) if sweep.spacing else len(cut) + 1
        first, last = _run(cut), _run(cut[::-1])
        first, last = (run if run >= least else 0 for run in (first, last))
        if first + last >= len(cut) or not (first or last):
            return scan
        ranges = np.roll(scan.ranges, -shift)[first : len(cut) - last]
        begin = float(wrap(scan.angle_min + scan.angle_increment * (shift + first)))
        return scan.model_copy(update={"ranges": ranges, "angle_min": begin})

    def _by_angle(self, scan: Scan) -> npt.NDArray[np.bool_]:
        angles, cut = scan.angles(), np.zeros(len(scan.ranges), bool)
        for low, high in self.sectors:
            cut |= np.abs(wrap(angles - (low + high) / 2)) <= (high - low) / 2 + 1e-9
        return cut

    def _cut(self, scan: Scan) -> npt.NDArray[np.bool_]:
        """(B,) too near as well; what is too close to say (-inf) is, and 0, which is no distance, is not."""
        if not self.radius:
            return self._by_angle(scan)
        return np.asarray(self._by_angle(scan) | (scan.ranges < np.float32(self.radius)) & (scan.ranges != 0))

    @staticmethod
    def _with(scan: Scan, cut: npt.NDArray[np.bool_], value: float) -> Scan:
        ranges = np.where(cut, np.float32(value), scan.ranges).astype(np.float32)
        return scan.model_copy(update={"ranges": ranges})


def _run(cut: npt.NDArray[np.bool_]) -> int:
    """How many are cut out at the beginning."""
    return len(cut) if cut.all() else int(np.argmin(cut))


def _after_longest(cut: npt.NDArray[np.bool_]) -> int:
    """Index behind the longest run of a ring of which some are cut out, not all."""
    begin = int(np.argmin(cut))  # not cut out: no run goes over it
    ring = np.roll(cut, -begin).astype(np.int8)
    edges = np.diff(ring, prepend=0, append=0)
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return (begin + int(ends[np.argmax(ends - starts)])) % len(cut)
