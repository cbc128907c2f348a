"""The scans on which other programs were measured: a folder with a building, its map, places and drives."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.robot.scanner import Scanner
from services.estimator.precise.learning.calibration import ReferenceDrive

BUILDING, MAP, PLACES, DRIVES = "world.yaml", "map*.yaml", "held.npz", "track.npz"
RATE_HZ = 15.0  # of the scans, which have no stamps
PAUSE_S = 60.0  # between the stamps of two drives


@dataclass(frozen=True)
class TrialScans:
    """K trials of N scans each; base_link is the laser."""

    ranges: Array  # (K, N, B) m; +inf: no return
    truth: Array  # (K, N, 3) m, m, rad in map
    odom: Array  # (K, N, 3)
    scanner: Scanner

    @property
    def stamps(self) -> Array:
        """(N,) s from the beginning of a trial."""
        return np.arange(self.truth.shape[1]) / RATE_HZ

    def drive(self, trials: Sequence[int]) -> ReferenceDrive:
        """Some of the trials, one after another, with their true poses."""
        count, length = len(trials), self.truth.shape[1]
        stamps = self.stamps + np.arange(count)[:, None] * (length / RATE_HZ + PAUSE_S)
        return ReferenceDrive(
            stamps.ravel(),
            self.truth[trials].reshape(-1, 3),
            self.ranges[trials].reshape(count * length, -1),
            self.scanner.angles(),
            np.zeros(3),
            self.scanner.range_max,
            self.odom[trials].reshape(-1, 3),
        )


@functools.lru_cache(maxsize=4)
def read_trial_scans(path: Path) -> TrialScans:
    """Reads ranges_mm (0: no return), truth, odom, angles, range_max and sigma of an .npz file; cached per process."""
    with np.load(path) as stored:
        missing = {"ranges_mm", "truth", "odom", "angles", "range_max", "sigma"} - set(stored.files)
        if missing:
            raise UserError(f"{path}: has no array {min(missing)!r}")
        millimetres, angles = stored["ranges_mm"], stored["angles"].astype(float)
        ranges = np.where(millimetres > 0, millimetres / 1e3, np.inf)
        scanner = Scanner(
            name="peers",
            beams=len(angles),
            fov=float(angles[-1] - angles[0]),
            first=float(angles[0]),
            range_min=0.0,
            range_max=float(stored["range_max"]),
            sigma=float(stored["sigma"]),
            rate=RATE_HZ,
            mount=(0.0, 0.0, 0.0),
        )
        return TrialScans(ranges, stored["truth"].astype(float), stored["odom"].astype(float), scanner)


def map_file(folder: Path) -> Path:
    """The ROS map of the building. Raises UserError if a file is missing from the folder."""
    maps = sorted(folder.glob(MAP))
    for name in (BUILDING, PLACES, DRIVES):
        if not (folder / name).exists():
            raise UserError(
                f"{folder / name}: there is no such file; the folder needs {BUILDING}, {MAP}, {PLACES}, {DRIVES}"
            )
    if not maps:
        raise UserError(f"{folder}: no ROS map there ({MAP})")
    return maps[0]
