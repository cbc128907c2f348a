"""Key scans: scans at trusted poses, from which the field is learned while driving.

A scan is trusted if the estimator is `tracking` and its protection level is small. It is used only if the robot is
still tracked after driving another `VERIFIED_AFTER_M`. A pose that turns out to be wrong before that is dropped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.motion_distortion import beam_times, correct_beams, evenly_spaced
from common.robot.scan_geometry import Sweep
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.local_map import is_key_pose
from services.estimator.precise.motion_model import MotionNoise

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.shared.interface import Observation, Posterior

PLACE_M, HEADINGS = 0.5, 4  # one key scan is kept for each square of this size and each of these headings
MAX_KEY_SCANS = 4000  # with 622 beams, 10 MB; if there are more, the squares become twice as large
MAX_PROTECTION = np.array([0.2, 0.2, np.deg2rad(5)])  # m, m, rad: protection level of a trusted pose
VERIFIED_AFTER_M = 5.0  # of driving: about a room
# A version is learned from at least this many key scans, of which this many and this fraction are new.
MIN_KEY_SCANS, MIN_NEW, MIN_NEW_FRACTION = 50, 20, 0.1
MAX_GAP_S = 1.0  # longest time without `tracking` after which the robot is still assumed to be where it was tracked
# A pose jumps if it moves by more than this between two scans, beyond this multiple of the robot's full speed.
JUMP_M, JUMP_RAD = 0.2, 0.2
MAX_SPEED_FACTOR = 2.0


@dataclass(frozen=True)
class KeyScan:
    """A scan as if all its beams had been measured at its stamp."""

    stamp: float  # s, of the collector's clock
    pose: Array  # (3,) base_link in map
    ranges: npt.NDArray[np.float32]  # (B,) m
    path: float  # m that the robot had driven

    def cell(self, size: float) -> tuple[int, int, int]:
        """The square of ``size`` m and the heading in which it was taken."""
        x, y, yaw = self.pose
        return int(x // size), int(y // size), int(yaw // (2 * np.pi / HEADINGS))


class KeyScanCollector:
    """Collects the key scans of one scanner, and keeps the newest one of each place and heading.

    Its clock follows the stamps of the scans. Where these begin again, as after a reset of the simulator, it goes on.
    """

    def __init__(self, angles: Array, mount: Array, range_max: float, motion: MotionNoise | None = None) -> None:
        """``angles`` (B,) rad are those of the scanner's beams, ``mount`` (3,) is the laser in base_link.

        ``motion`` states the full speeds of the robot.
        """
        self.angles, self.mount, self.range_max = angles, np.asarray(mount, float), range_max
        self._motion = motion or MotionNoise()
        self.verified: dict[tuple[int, int, int], KeyScan] = {}  # by cell
        self.dropped_total = 0  # scans dropped because their pose may be wrong
        self.learned_until = -np.inf  # s, stamp of the newest key scan from which the model in use was learned
        self._unverified: deque[KeyScan] = deque()
        self._taken_until = -np.inf  # s, stamp of the newest key scan that was taken
        self._size = PLACE_M
        self._path = 0.0  # m
        self._path_end: Array | None = None  # (3,) pose up to which the path was added
        self._clock, self._clock_ahead = -np.inf, 0.0  # s; how far it is ahead of the stamps
        self._last: tuple[float, Array] | None = None  # stamp and pose of the last scan in `tracking`
        self._last_key: Array | None = None  # (3,) pose

    def __len__(self) -> int:
        return len(self.verified)

    def add(self, posterior: Posterior, observation: Observation) -> None:
        """Processes a scan and the posterior after it; keeps the scan if it is due as a key scan."""
        if observation.stamp is None:
            return
        if observation.stamp + self._clock_ahead < self._clock:
            self._clock_ahead = self._clock + 2 * MAX_GAP_S - observation.stamp  # the robot may be elsewhere
        self._clock = stamp = observation.stamp + self._clock_ahead
        if self._last is not None and not 0 < stamp - self._last[0] <= MAX_GAP_S:
            self.forget_unverified()
        if posterior.state != "tracking":
            return
        pose, velocity = posterior.pose, None
        if self._last is not None:
            period, step = stamp - self._last[0], se2.between(self._last[1], pose)
            distance = float(np.hypot(step[0], step[1]))
            most = MAX_SPEED_FACTOR * period * np.array([self._motion.speed, self._motion.turn])
            if distance > JUMP_M + most[0] or abs(step[2]) > JUMP_RAD + most[1]:
                self.forget_unverified()
            else:
                velocity = step / period
        self._last = stamp, pose
        self._extend_path(pose)
        self._verify()
        is_due = self._last_key is None or is_key_pose(self._last_key, pose)
        if velocity is not None and _is_trusted(posterior) and is_due:
            self._last_key = pose
            ranges = self._correct_for_motion(observation, velocity).astype(np.float32)
            self._unverified.append(KeyScan(stamp, pose, ranges, self._path))

    def forget_unverified(self) -> None:
        """Drops the scans since the pose was last verified, because it is not certain that the robot was there."""
        self.dropped_total += len(self._unverified)
        self._unverified.clear()
        self._last = self._last_key = self._path_end = None

    def _extend_path(self, pose: Array) -> None:
        """Adds the way to ``pose`` (3,) in steps of key scans: noise makes the pose of a standing robot wander."""
        if self._path_end is not None and not is_key_pose(self._path_end, pose):
            return
        if self._path_end is not None:
            self._path += float(np.hypot(*(pose - self._path_end)[:2]))
        self._path_end = pose

    def take_drive(self) -> ReferenceDrive | None:
        """Returns the verified key scans in order of time if enough of them are new since the last time, else None."""
        count, new = len(self.verified), sum(key.stamp > self._taken_until for key in self.verified.values())
        if count < MIN_KEY_SCANS or new < max(MIN_NEW, MIN_NEW_FRACTION * count):
            return None
        keys = self._in_order()
        self._taken_until = keys[-1].stamp
        return ReferenceDrive(
            np.array([key.stamp for key in keys]),
            np.array([key.pose for key in keys]),
            np.array([key.ranges for key in keys]),
            self.angles,
            self.mount,
            self.range_max,
        )

    def set_learned(self, stamps: Array, poses: Array) -> None:
        """Notes that the model in use was learned from the key scans taken at ``stamps`` (N,) s; some may be gone.

        They get the ``poses`` (N, 3) that were found in learning.
        """
        self.learned_until = float(stamps.max())
        corrected = dict(zip(stamps.tolist(), poses, strict=True))
        for cell, key in self.verified.items():
            self.verified[cell] = replace(key, pose=corrected.get(key.stamp, key.pose))

    def _in_order(self) -> list[KeyScan]:
        return sorted(self.verified.values(), key=lambda key: key.stamp)

    def _verify(self) -> None:
        while self._unverified and self._unverified[0].path <= self._path - VERIFIED_AFTER_M:
            key = self._unverified.popleft()
            self.verified[key.cell(self._size)] = key
        while len(self.verified) > MAX_KEY_SCANS:
            self._size *= 2
            self.verified = {key.cell(self._size): key for key in self._in_order()}

    def _correct_for_motion(self, observation: Observation, velocity: Array) -> Array:
        """Returns the ranges (B,) in m along the scanner's beams, as if all were measured at the stamp."""
        ranges, angles = observation.ranges, observation.angles
        if observation.time_increment:
            times = beam_times(len(angles), observation.time_increment)
            ranges, angles = correct_beams(ranges, angles, times[:, None] * velocity, self.mount)
        if angles is self.angles or np.array_equal(angles, self.angles):
            return ranges
        return evenly_spaced(ranges, angles, Sweep.of_angles(self.angles), -np.inf)


def _is_trusted(posterior: Posterior) -> bool:
    return posterior.protection is not None and bool((posterior.protection <= MAX_PROTECTION).all())
