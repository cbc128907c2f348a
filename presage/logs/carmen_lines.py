"""One line of a CARMEN log.

    FLASER n [ranges] laser_x laser_y laser_theta odom_x odom_y odom_theta TIMES        (also RLASER, LASER3 ...)
    ROBOTLASER1 HEADER n [ranges] m [remissions] laser pose, robot pose, tv rv forward side turn_axis TIMES
    RAWLASER1 HEADER n [ranges] m [remissions] TIMES
    ODOM x y theta tv rv accel TIMES
    TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta TIMES

HEADER: type, start angle, field of view, resolution (rad), maximum range (m), accuracy, remission mode.
TIMES: ipc_timestamp ipc_hostname logger_timestamp, s. Older ROBOTLASER1 lines have no remissions and no turn_axis.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from common.geometry.se2 import Array
from common.limits import MAX_BEAMS

OLD_LASER = re.compile(r"(FLASER|RLASER|LASER\d)$")
ROBOT_LASER, RAW_LASER = re.compile(r"ROBOTLASER\d$"), re.compile(r"RAWLASER\d$")
LINE_TYPE = re.compile(r"[A-Z][A-Z0-9_]*$")
COUNT_INDEX = 8  # of the word with the number of readings, in ROBOTLASER1 and RAWLASER1


@dataclass(frozen=True)
class BeamHeader:
    """The beams of a scan as stated in the header."""

    start: float  # rad, angle of the first beam
    step: float  # rad, between beams
    count: int
    range_max: float  # m

    def angles(self) -> Array:
        """Angles of the beams (count,) rad."""
        return self.start + self.step * np.arange(self.count, dtype=np.float64)


@dataclass(frozen=True)
class LaserLine:
    """A line with a scan."""

    ranges: Array  # (B,) m
    beams: BeamHeader | None  # None for the old types of lines, which do not state it
    laser: Array | None  # (3,) pose of the laser, in odom or corrected by a mapping program
    robot: Array | None  # (3,) base_link in odom
    ipc: float  # s, time when the message was made
    logger: float  # s, time when it was logged


def is_laser(word: str) -> bool:
    """Whether lines of that type contain scans."""
    return any(pattern.match(word) for pattern in (OLD_LASER, ROBOT_LASER, RAW_LASER))


def laser_line(words: list[str], *, ranges: bool = True) -> LaserLine:
    """Parses the words of a line with a scan; raises ValueError if it is malformed.

    Without ``ranges``, the ranges are not parsed, which saves time.
    """
    if OLD_LASER.match(words[0]):
        readings, tail = _readings(words, 1, wanted=ranges)
        ipc, logger = _times(tail[6:])
        return LaserLine(readings, None, _pose(tail), _pose(tail[3:]), ipc, logger)
    readings, tail = _readings(words, COUNT_INDEX, wanted=ranges)
    count = _count(words[COUNT_INDEX])
    _, start, fov, step, range_max = (float(word) for word in words[1:6])
    step = step if step > 0 else fov / max(1, count - 1)
    if not (abs(start) <= 2 * np.pi and 0 < step * (count - 1) <= 2 * np.pi + step and 0 < range_max < np.inf):
        raise ValueError("an impossible header")
    beams = BeamHeader(start, step, count, range_max)
    remissions = len(tail) != 13 or RAW_LASER.match(words[0]) is not None
    if remissions:
        tail = tail[1 + _count(tail[0]) :]
    if RAW_LASER.match(words[0]):
        return LaserLine(readings, beams, None, None, *_times(tail))
    return LaserLine(readings, beams, _pose(tail), _pose(tail[3:]), *_times(tail[11 if remissions else 10 :]))


def pose_line(words: list[str]) -> tuple[Array, float, float]:
    """Parses an ODOM or TRUEPOS line: the pose (3,), and the ipc and logger times, s; raises ValueError."""
    return _pose(words[1:]), *_times(words[7:])


def _readings(words: list[str], index: int, *, wanted: bool) -> tuple[Array, list[str]]:
    """Returns the ranges (B,) m, empty unless ``wanted``, and the words after them."""
    count = _count(words[index])
    if len(words) < index + 1 + count or count < 3:
        raise ValueError("readings are missing")
    ranges = np.array(words[index + 1 : index + 1 + count] if wanted else (), np.float64)
    return ranges, words[index + 1 + count :]


def _count(word: str) -> int:
    count = int(word)
    if not 0 <= count <= MAX_BEAMS:
        raise ValueError(f"{count} readings")
    return count


def _pose(words: list[str]) -> Array:
    pose = np.array(words[:3], np.float64)
    if len(pose) != 3 or not np.isfinite(pose).all():
        raise ValueError("a pose is missing")
    return pose


def _times(words: list[str]) -> tuple[float, float]:
    """Returns the ipc and logger times, s; without a logger time, returns the ipc time twice."""
    if len(words) not in (2, 3):
        raise ValueError(f"{len(words)} words instead of the times")
    ipc, logger = float(words[0]), float(words[-1]) if len(words) == 3 else float(words[0])
    if not (0 <= ipc < 1e10 and 0 <= logger < 1e10):
        raise ValueError("an impossible time")
    return ipc, logger
