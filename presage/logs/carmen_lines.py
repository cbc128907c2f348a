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

OLD = re.compile(r"(FLASER|RLASER|LASER\d)$")
ROBOT, RAW = re.compile(r"ROBOTLASER\d$"), re.compile(r"RAWLASER\d$")
WORD = re.compile(r"[A-Z][A-Z0-9_]*$")
HEADER = 8  # words of ROBOTLASER1 and RAWLASER1 before the readings, the number of them included


@dataclass(frozen=True)
class Beams:
    """What a header says."""

    start: float  # rad
    step: float  # rad
    count: int
    range_max: float  # m

    def angles(self) -> Array:
        """(count,) rad."""
        return self.start + self.step * np.arange(self.count, dtype=np.float64)


@dataclass(frozen=True)
class LaserLine:
    """One scan."""

    ranges: Array  # (B,) m
    beams: Beams | None  # None: an old line, which does not say
    laser: Array | None  # (3,) its pose in odom, or corrected
    robot: Array | None  # (3,) base_link in odom
    ipc: float  # s, when the message was made
    logger: float  # s, when it was logged


def is_laser(word: str) -> bool:
    """Whether lines of that name hold scans."""
    return any(pattern.match(word) for pattern in (OLD, ROBOT, RAW))


def laser_line(words: list[str], *, ranges: bool = True) -> LaserLine:
    """Of the words of a line; raises ValueError where it is garbled. Without ``ranges`` these are not looked at."""
    if OLD.match(words[0]):
        seen, tail = _readings(words, 1, wanted=ranges)
        ipc, logger = _times(tail[6:])
        return LaserLine(seen, None, _pose(tail), _pose(tail[3:]), ipc, logger)
    seen, tail = _readings(words, HEADER, wanted=ranges)
    count = _count(words[HEADER])
    _, start, fov, step, range_max = (float(word) for word in words[1:6])
    step = step if step > 0 else fov / max(1, count - 1)
    if not (abs(start) <= 2 * np.pi and 0 < step * (count - 1) <= 2 * np.pi + step and 0 < range_max < np.inf):
        raise ValueError("an impossible header")
    beams = Beams(start, step, count, range_max)
    remissions = len(tail) != 13 or RAW.match(words[0]) is not None
    if remissions:
        tail = tail[1 + _count(tail[0]) :]
    if RAW.match(words[0]):
        return LaserLine(seen, beams, None, None, *_times(tail))
    return LaserLine(seen, beams, _pose(tail), _pose(tail[3:]), *_times(tail[11 if remissions else 10 :]))


def pose_line(words: list[str]) -> tuple[Array, float, float]:
    """Of ODOM and TRUEPOS: the pose (3,), and the times ipc and logger, s. Raises ValueError where it is garbled."""
    return _pose(words[1:]), *_times(words[7:])


def _readings(words: list[str], at: int, *, wanted: bool) -> tuple[Array, list[str]]:
    """(B,) m, and the words behind them."""
    count = _count(words[at])
    if len(words) < at + 1 + count or count < 3:
        raise ValueError("readings are missing")
    ranges = np.array(words[at + 1 : at + 1 + count] if wanted else (), np.float64)
    return ranges, words[at + 1 + count :]


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
    """Ipc and logger; logs without the last have its place filled with the first."""
    if len(words) not in (2, 3):
        raise ValueError(f"{len(words)} words where the times should be")
    ipc, logger = float(words[0]), float(words[-1]) if len(words) == 3 else float(words[0])
    if not (0 <= ipc < 1e10 and 0 <= logger < 1e10):
        raise ValueError("an impossible time")
    return ipc, logger
