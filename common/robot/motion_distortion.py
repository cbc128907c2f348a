"""Corrects the motion distortion of scans: a scanner measures one beam after another while the robot moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.ranges import NOT_MEASURED, is_surface
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan


def beam_times(beams: int, time_increment: float) -> Array:
    """(B,) times in s at which the beams are measured, since the earliest of them.

    The earliest beam is the first one, or the last one if ``time_increment`` is negative.
    """
    times = time_increment * np.arange(beams, dtype=np.float64)
    return np.asarray(times - times.min(initial=0.0))


def sweep_time(beams: int, time_increment: float) -> float:
    """Time in s from the earliest beam to the latest."""
    return abs(time_increment) * max(0, beams - 1)


def correct_beams(ranges: Array, angles: Array, poses: Array, mount: Array) -> tuple[Array, Array]:
    """Ranges (B,) in m and angles (B,) in rad of the same surface points, seen from the laser's pose at one time.

    ``poses`` (B, 3) are those of base_link when each beam was measured, in base_link at that time; ``mount`` (3,) is
    the pose of the laser in base_link. Beams without a distance (inf, 0) keep their range. The corrected angles are not
    evenly spaced.
    """
    lasers = se2.compose(se2.inverse(mount), se2.compose(poses, mount))
    hit = is_surface(ranges)
    heading = angles + lasers[:, 2]
    distance = np.where(hit, ranges, 0.0)
    x, y = lasers[:, 0] + distance * np.cos(heading), lasers[:, 1] + distance * np.sin(heading)
    # The nearest equivalent of the old angle, so that angles beyond pi stay beyond pi.
    turned = np.where(hit, heading + se2.wrap(np.arctan2(y, x) - heading), heading)
    return np.where(hit, np.hypot(x, y), ranges), turned


def correct_scan(scan: Scan, velocity: Array) -> Scan:
    """The scan as if all beams had been measured at its stamp, for a robot moving with ``velocity`` (3,) in base_link.

    The pose after t s is approximated by t times the velocity. ``time_increment`` is kept, because it states how long
    the scan took.
    """
    if not scan.time_increment or not velocity.any():
        return scan
    angles, measured = scan.angles(), scan.ranges.astype(np.float64)
    ranges, angles = correct_beams(measured, angles, scan.beam_times()[:, None] * velocity, scan.mount.array())
    return scan.model_copy(update={"ranges": evenly_spaced(ranges, angles, Sweep.of(scan)).astype(np.float32)})


def evenly_spaced(ranges: Array, angles: Array, sweep: Sweep, not_measured: float = NOT_MEASURED) -> Array:
    """Ranges (B,) in m of the beams of ``sweep``, from ranges (K,) at other angles (K,) in rad.

    Each range goes to the beam nearest to its direction, and a beam gets the shortest of its ranges, or
    ``not_measured``. So directions are exact to half the angle between beams, which is enough to avoid obstacles and
    to draw maps.
    """
    beam = sweep.beams_at(angles)
    used = (beam >= 0) & (ranges != not_measured)
    shortest = np.full(sweep.beams, np.nan)
    np.fmin.at(shortest, beam[used], ranges[used])
    return np.where(np.isnan(shortest), not_measured, shortest)
