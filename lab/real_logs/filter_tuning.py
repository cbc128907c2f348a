"""Tunes the particle filter on the training half.

The odometry noise is learned from the first half, as for preset precise. All other settings are tried on stretches of
the second quarter, in a map of the first quarter. Like the half that is localised later, the second quarter sees rooms
that the map lacks, and this decides whether recovery helps or harms.

Three sets of settings are tuned separately, so that no task suffers from the needs of another: tracking with odometry,
tracking without, and finding (global localisation and kidnapping). The best tracking settings keep the most scans, and
among equals have the smallest median error. The best finding settings find the most starts, and among equals need the
fewest scans.
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
    SCANS_BEFORE_KIDNAPPING,
    TRACKED_DISTANCE,
    StretchJob,
    trial,
)
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


@dataclass(frozen=True)
class TunedSettings:
    """Tuned settings of the particle filter."""

    odometry: ParameterValues  # for tracking with odometry
    laser: ParameterValues  # for tracking without
    finding: ParameterValues  # for global localisation and kidnapping
    # A line per trial: task and setting, share of scans kept or starts found, median error (m) or mean number of scans.
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
    lines: list[str] = []
    total = 2 * sum(map(len, TRACKING_CANDIDATES.values())) + sum(map(len, SEARCH_CANDIDATES.values())) + 3
    quarter = half // 2
    job = replace(job, map=str(_map_of_quarter(job, quarter, folder)))
    length = min(MAX_STRETCH_SCANS, half - quarter)
    firsts = sorted(set(_evenly_spaced(job, quarter, half - length, MAX_STRETCHES)))

    starts = _evenly_spaced(job, quarter, half - MAX_SEARCH_SCANS, SEARCH_STARTS)

    def tracking(task: str, settings: ParameterValues) -> tuple[float, float]:
        return _tracking_score(
            [trial(replace(job, task=task, first=first, count=length, particles=settings)) for first in firsts]
        )

    def finding(settings: ParameterValues) -> tuple[float, float]:
        rows = [trial(replace(job, task=GLOBAL, first=k, count=SEARCH_SCANS, particles=settings)) for k in starts]
        kidnappings = zip(starts, starts[len(starts) // 2 :] + starts[: len(starts) // 2], strict=True)
        rows += [trial(replace(job, task=KIDNAPPED, first=k, to=to, particles=settings)) for k, to in kidnappings]
        return _search_score(rows)

    def coordinate_search(
        title: str,
        settings: ParameterValues,
        tried: dict[str, tuple[float, ...]],
        score: Callable[[ParameterValues], tuple[float, float]],
    ) -> ParameterValues:
        best, best_score = settings, score(settings)
        lines.append(f"{title}, initial settings: {best_score[0]:.0%}, {-best_score[1]:.3g}")
        for name, values in tried.items():
            base = best
            for value in values:
                changed = _with(base, name, value)
                changed_score = score(changed)
                lines.append(f"{title}, {name} {value:g}: {changed_score[0]:.0%}, {-changed_score[1]:.3g}")
                if changed_score > best_score:
                    best, best_score = changed, changed_score
                report(f"particle filter, {title}: {name}", len(lines) / total)
        return best

    odometry, laser = start, coordinate_search(LASER, start, TRACKING_CANDIDATES, partial(tracking, LASER))
    if job.drive.odom is not None:
        odometry = coordinate_search(ODOMETRY, start, TRACKING_CANDIDATES, partial(tracking, ODOMETRY))
    # A kidnapped robot must give up its given pose, and nav2's default number of particles is too small for a search.
    start_finding = _with(_with(odometry, "keep_initial_pose", 0.0), "amcl_defaults", 0.0)
    return TunedSettings(
        odometry, laser, coordinate_search("finding", start_finding, SEARCH_CANDIDATES, finding), lines
    )


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
    values = dict(settings)
    if name == "alpha":
        return tuple({**values, **{f"alpha{k}": values[f"alpha{k}"] * value for k in range(1, 6)}}.items())
    return tuple({**values, name: value, **({"z_hit": 1 - value} if name == "z_rand" else {})}.items())


def _tracking_score(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Share of scans tracked, and the negative median error (m) of those; larger is better."""
    errors = np.array([value for row in rows for value in row["error_m"]])
    tracked = errors < TRACKED_DISTANCE
    return round(float(tracked.mean()), 2), -float(np.median(errors[tracked])) if tracked.any() else -np.inf


def _search_score(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Share of starts found, and the negative mean number of scans until then; larger is better."""
    scans = []
    for row in rows:
        skip = SCANS_BEFORE_KIDNAPPING if row["task"] == KIDNAPPED else 0
        right = (np.array(row["error_m"][skip:]) < TRACKED_DISTANCE) & (np.array(row["state"][skip:]) == "tracking")
        scans.append(int(np.argmax(right)) + 1 if right.any() else None)
    found = [k for k in scans if k is not None]
    return len(found) / len(rows), -float(np.mean([MAX_SEARCH_SCANS if k is None else k for k in scans]))
