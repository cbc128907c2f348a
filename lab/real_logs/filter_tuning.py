"""Tunes the particle filter on the training half.

The odometry noise is learned from the first half, as for preset precise. All other settings are tried on stretches of
the second quarter, in a map of the first quarter. Like the half that is localised later, the second quarter sees rooms
that the map lacks, and this decides whether recovery helps or harms.

Three sets of settings are tuned separately, so that no task suffers from the needs of another: tracking with odometry,
tracking without, and finding (global localisation and kidnapping). With the best tracking settings most scans have a
correct pose, and among equals the smallest median error. The best finding settings find the most starts, and among
equals need the fewest scans.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry.ros_map_writer import write_grid
from common.geometry.world import load_world
from lab.accuracy.compared_estimators import amcl_noise
from lab.real_logs.drive import (
    GLOBAL,
    KIDNAPPED,
    LASER,
    MAX_SEARCH_SCANS,
    ODOMETRY,
    StretchJob,
    trial,
)
from lab.real_logs.scoring import counted, is_correct, scans_until_found
from services.estimator.precise.motion_model import MotionNoise
from services.mapper.slam.drive import Laser
from services.mapper.slam.grid import grid_of_scans

TRACKING_CANDIDATES: dict[str, tuple[float, ...]] = {
    "amcl_defaults": (1.0,),
    "keep_initial_pose": (0.0,),
    "sigma_hit": (0.05, 0.2),
    "sigma_odometry": (0.0, 0.03, 0.1, 0.2),
    "z_rand": (0.2, 0.5),
    "max_beams": (60,),
    "jitter_position": (0.005, 0.015),
    "jitter_heading": (0.005, 0.015),
    "alpha": (4.0, 16.0),
}
# amcl_defaults 1: nav2's values instead of the tuned set for all other settings. keep_initial_pose 0: allow recovery
# after a start from a given pose. sigma_odometry 0: use sigma_hit and max_beams with odometry too. alpha: factor on all
# five learned noise parameters.
SEARCH_CANDIDATES: dict[str, tuple[float, ...]] = {
    "recovery_alpha_fast": (0.0, 0.1),
    "sigma_search": (0.2,),
    "jitter_position": (0.005, 0.05),
}
MAX_STRETCHES, MAX_STRETCH_SCANS = 3, 150  # of the second quarter, for tracking
SEARCH_STARTS, SEARCH_SCANS = 4, 15  # starts to find, and scans allowed for global localisation
CELL_SIZE = 0.05  # m, of the first quarter's map if the drive's own map is not a grid
ParameterValues = tuple[tuple[str, float], ...]
Score = tuple[float, float]  # the first number decides, the second among equals; larger is better


@dataclass(frozen=True)
class TunedSettings:
    """Tuned settings of the particle filter."""

    odometry: ParameterValues  # for tracking with odometry
    laser: ParameterValues  # for tracking without
    finding: ParameterValues  # for global localisation and kidnapping
    # A line per trial: task and setting, share of correct scans or found starts, median error (m) or number of scans.
    tried: list[str]


def starting_point(motion: MotionNoise) -> ParameterValues:
    """Odometry noise of AMCL's omnidirectional model, from the noise learned on the first half."""
    return tuple(amcl_noise(motion).items())


def tune(
    job: StretchJob, half: int, start: ParameterValues, folder: Path, report: Callable[[str, float], None]
) -> TunedSettings:
    """Tunes the settings by coordinate search. Writes the map of the first quarter into ``folder``.

    ``job`` gives the log, the map and the mount; ``half`` is the number of scans in the first half, ``start`` the
    settings to start from.
    """
    quarter = half // 2
    stretches = TuningStretches(replace(job, map=str(_map_of_quarter(job, quarter, folder))), quarter, half)
    search = CoordinateSearch(lambda title, done: report(f"{job.estimator}, {title}", done))
    laser = search.best(LASER, start, TRACKING_CANDIDATES, partial(stretches.tracking_score, LASER))
    odometry = start
    if job.drive.odom is not None:
        odometry = search.best(ODOMETRY, start, TRACKING_CANDIDATES, partial(stretches.tracking_score, ODOMETRY))
    # A kidnapped robot must give up its given pose, and nav2's default number of particles is too small for a search.
    start_finding = _with(_with(odometry, "keep_initial_pose", 0.0), "amcl_defaults", 0.0)
    finding = search.best("finding", start_finding, SEARCH_CANDIDATES, stretches.finding_score)
    return TunedSettings(odometry, laser, finding, search.tried)


class TuningStretches:
    """Parts of the second quarter on which settings are tried."""

    def __init__(self, job: StretchJob, quarter: int, half: int) -> None:
        """The second quarter begins at scan ``quarter`` and ends before scan ``half``."""
        self.job, self.length = job, min(MAX_STRETCH_SCANS, half - quarter)
        self.firsts = sorted(set(_evenly_spaced(job, quarter, half - self.length, MAX_STRETCHES)))
        self.starts = _evenly_spaced(job, quarter, half - MAX_SEARCH_SCANS, SEARCH_STARTS)

    def tracking_score(self, task: str, settings: ParameterValues) -> Score:
        """Score of settings for tracking with or without odometry."""
        job = replace(self.job, task=task, count=self.length, particles=settings)
        return _tracking_score([trial(replace(job, first=first)) for first in self.firsts])

    def finding_score(self, settings: ParameterValues) -> Score:
        """Score of settings for global localisation and kidnapping."""
        job, half = replace(self.job, particles=settings), len(self.starts) // 2
        rows = [trial(replace(job, task=GLOBAL, first=first, count=SEARCH_SCANS)) for first in self.starts]
        kidnappings = zip(self.starts, self.starts[half:] + self.starts[:half], strict=True)
        rows += [trial(replace(job, task=KIDNAPPED, first=first, to=to)) for first, to in kidnappings]
        return _search_score(rows)


class CoordinateSearch:
    """Changes one setting after the other and keeps what improves the score."""

    def __init__(self, report: Callable[[str, float], None]) -> None:
        """``report`` gets what is tried, and the share that is done."""
        self.tried: list[str] = []  # as in `TunedSettings`
        self._report = report
        # Each of the three searches also tries its initial settings.
        self._total = 2 * sum(map(len, TRACKING_CANDIDATES.values())) + sum(map(len, SEARCH_CANDIDATES.values())) + 3

    def best(
        self,
        title: str,
        settings: ParameterValues,
        candidates: dict[str, tuple[float, ...]],
        score: Callable[[ParameterValues], Score],
    ) -> ParameterValues:
        """The settings with the best score, starting from ``settings``; of each setting tries the candidate values."""
        best, best_score = settings, score(settings)
        self._note(f"{title}, initial settings", best_score)
        for name, values in candidates.items():
            base = best
            for value in values:
                changed = _with(base, name, value)
                changed_score = score(changed)
                self._note(f"{title}, {name} {value:g}", changed_score)
                if changed_score > best_score:
                    best, best_score = changed, changed_score
                self._report(f"{title}: {name}", len(self.tried) / self._total)
        return best

    def _note(self, what: str, score: Score) -> None:
        self.tried.append(f"{what}: {score[0]:.0%}, {-score[1]:.3g}")


def _map_of_quarter(job: StretchJob, quarter: int, folder: Path) -> Path:
    """Writes a ROS map of the first ``quarter`` scans, with the cell size of the job's map. Returns its path."""
    grid = load_world(job.map).grid
    cell = grid.resolution if grid is not None else CELL_SIZE
    drive = job.drive.part(np.arange(quarter))
    laser = Laser(drive.angles, drive.mount, drive.range_max)
    return write_grid(folder, "quarter", grid_of_scans(drive.poses, drive.ranges, laser, cell))


def _evenly_spaced(job: StretchJob, first: int, last: int, count: int) -> list[int]:
    """Indices of ``count`` scans from ``first`` to ``last``, evenly spaced among those with a pose in free space."""
    free = np.flatnonzero(load_world(job.map).clearance(job.drive.poses[first : last + 1, :2]) > 0)
    indices = first + (free if len(free) else np.arange(last + 1 - first))
    return [int(k) for k in indices[np.linspace(0, len(indices) - 1, count).astype(int)]]


def _with(settings: ParameterValues, name: str, value: float) -> ParameterValues:
    """The settings with one changed, as in `TRACKING_CANDIDATES`; z_hit follows z_rand."""
    values = dict(settings)
    if name == "alpha":
        return tuple({**values, **{f"alpha{k}": values[f"alpha{k}"] * value for k in range(1, 6)}}.items())
    return tuple({**values, name: value, **({"z_hit": 1 - value} if name == "z_rand" else {})}.items())


def _tracking_score(rows: list[dict[str, Any]]) -> Score:
    """Share of scans with a correct pose, and the negative median error (m) of those."""
    errors = np.concatenate([counted(row, "error_m") for row in rows])
    correct = np.concatenate([is_correct(row) for row in rows])
    return round(float(correct.mean()), 2), -float(np.median(errors[correct])) if correct.any() else -np.inf


def _search_score(rows: list[dict[str, Any]]) -> Score:
    """Share of starts found, and the negative mean number of scans until then."""
    scans = [scans_until_found(row) for row in rows]
    found = [k for k in scans if k is not None]
    return len(found) / len(rows), -float(np.mean([MAX_SEARCH_SCANS if k is None else k for k in scans]))
