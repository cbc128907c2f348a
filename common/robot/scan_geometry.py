"""Beam directions of a scan, for any field of view and sense of rotation."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import wrap

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan


class Sector(NamedTuple):
    """The directions in base_link that a scanner sees."""

    centre: float  # rad
    half: float  # rad to either side of the centre; pi for the full circle


ALL_ROUND = Sector(0.0, float(np.pi))


class Sweep(NamedTuple):
    """Directions of the evenly spaced beams of a scan."""

    first: float  # rad in laser
    increment: float  # rad, negative if the beams run clockwise
    beams: int

    @classmethod
    def of(cls, scan: Scan) -> Sweep:
        """Beam directions of a scan message."""
        return cls(scan.angle_min, scan.angle_increment, len(scan.ranges))

    @classmethod
    def of_angles(cls, angles: Array) -> Sweep:
        """Evenly spaced beams at ``angles`` (B,) rad in laser."""
        return cls(float(angles[0]), float(angles[-1] - angles[0]) / max(1, len(angles) - 1), len(angles))

    @property
    def spacing(self) -> float:
        """Angle between neighbouring beams, rad."""
        return abs(self.increment)

    @property
    def all_round(self) -> bool:
        """Whether the beams cover the full circle, without a gap between the last beam and the first."""
        return self.beams > 2 and self.spacing * self.beams >= 2 * np.pi - self.spacing / 2

    @property
    def middle(self) -> float:
        """Centre of the field of view, rad in laser."""
        return self.first + self.increment * (self.beams - 1) / 2

    def sector(self, yaw: float) -> Sector:
        """Directions in base_link that a scanner mounted with ``yaw`` rad sees."""
        if self.all_round:
            return ALL_ROUND
        return Sector(float(wrap(self.middle + yaw)), float(min(np.pi, self.spacing * max(self.beams - 1, 0) / 2)))

    def beams_at(self, bearings: Array) -> npt.NDArray[np.intp]:
        """(K,) index of the beam nearest to each of ``bearings`` (K,) rad in laser; -1 outside the field of view."""
        if not self.increment or not self.beams:
            return np.full(np.shape(bearings), -1)
        beam = np.rint(wrap(bearings - self.middle) / self.increment + (self.beams - 1) / 2).astype(int)
        if self.all_round:
            return np.asarray(beam % self.beams)
        return np.where((beam >= 0) & (beam < self.beams), beam, -1)
