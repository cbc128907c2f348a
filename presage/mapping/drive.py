"""A drive without reference poses."""

from __future__ import annotations

from dataclasses import dataclass

from common.geometry.se2 import Array


@dataclass(frozen=True)
class RawDrive:
    """Scans in order of time, with odometry or without."""

    stamps: Array  # (N,) s
    ranges: Array  # (N, B) m
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    odom: Array | None = None  # (N, 3) base_link in odom
