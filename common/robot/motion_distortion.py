"""Motion distortion: a scanner measures one beam after another while the robot moves, and the correction of a scan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.ranges import NOT_MEASURED, is_surface
from common.robot.scan_geometry import Sweep

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Scan


def beam_times(beams: int, increment: float) -> Array:
    """(B,) times in s at which beams are measured, after the first of them; the last one, if ``increment`` < 0."""
    times = increment * np.arange(beams, dtype=np.float64)
    return np.asarray(times - times.min(initial=0.0))


def sweep_time(beams: int, increment: float) -> float:
    """Time in s from the first beam to the last."""
    return abs(increment) * max(0, beams - 1)


def correct_beams(ranges: Array, angles: Array, poses: Array, mount: Array) -> tuple[Array, Array]:
    """Ranges (B,) in m and angles (B,) in rad of the same surface points, seen from the laser's pose at the stamp.

    ``poses`` (B, 3) are those of base_link when each beam was measured, in base_link at the stamp; ``mount`` (3,) is
    the laser in base_link. A beam without a distance (inf, 0) only turns. The angles are no longer evenly spaced.
    """
    lasers = se2.compose(se2.inverse(mount), se2.compose(poses, mount))
    hit = is_surface(ranges)
    heading = angles + lasers[:, 2]
    distance = np.where(hit, ranges, 0.0)
    x, y = lasers[:, 0] + distance * np.cos(heading), lasers[:, 1] + distance * np.sin(heading)
    # Near the old angle, so that angles beyond pi stay beyond pi.
    turned = np.where(hit, heading + se2.wrap(np.arctan2(y, x) - heading), heading)
    return np.where(hit, np.hypot(x, y), ranges), turned


def correct_scan(scan: Scan, velocity: Array) -> Scan:
    """The scan as if all beams had been measured at its stamp, by a robot with ``velocity`` (3,) in base_link.

    ``time_increment`` stays, because it states how long the scan took.
    """
    if not scan.time_increment or not velocity.any():
        return scan
    angles, measured = scan.angles(), scan.ranges.astype(np.float64)
    ranges, angles = correct_beams(measured, angles, scan.beam_times()[:, None] * velocity, scan.mount.array())
    return scan.model_copy(update={"ranges": evenly_spaced(ranges, angles, Sweep.of(scan)).astype(np.float32)})


def evenly_spaced(ranges: Array, angles: Array, sweep: Sweep, not_measured: float = NOT_MEASURED) -> Array:
    """Ranges (B,) in m of the beams of ``sweep``, from ranges (K,) at other angles (K,) in rad.

    Each range is assigned to the nearest beam, of several the shortest. So directions are exact to half the angle
    between beams, which is enough to avoid obstacles and to draw maps. Beams without a range are ``not_measured``.
    """
    beam = sweep.beams_at(angles)
    used = (beam >= 0) & (ranges != not_measured)
    shortest = np.full(sweep.beams, np.nan)
    np.fmin.at(shortest, beam[used], ranges[used])
    return np.where(np.isnan(shortest), not_measured, shortest)
