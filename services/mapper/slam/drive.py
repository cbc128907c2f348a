"""A drive: scans, with or without odometry, and without reference poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.geometry.se2 import Array


@dataclass(frozen=True)
class Laser:
    """Beams and mount of a scanner."""

    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    time_increment: float = 0.0  # s between beams, as in a scan message


@dataclass(frozen=True)
class RawDrive:
    """Scans in order of time, with or without odometry."""

    stamps: Array  # (N,) s
    ranges: Array  # (N, B) m
    laser: Laser
    odom: Array | None = None  # (N, 3) base_link in odom; NaN where unknown
