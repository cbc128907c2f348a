"""`presage bench distortion`: errors of a tracking robot whose scanner measures one beam after another.

Each drive is run three times with the same noise: with instantaneous scans, with swept scans that the estimator
corrects, and with the same scans uncorrected. Errors are of the pose at the stamp, when the first beam is measured.
They are stated for scans at full speed, at least 0.9 m/s and 0.9 rad/s, and for scans during acceleration, at least
0.5 m/s² or 1.5 rad/s². NEES and protection levels are of all scans.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.interpolate import CubicHermiteSpline

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.robot.motion_distortion import beam_times
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS, EstimatorSetup
from lab.accuracy.scenes import Scene
from lab.accuracy.tasks import is_at
from lab.statistics import root_mean_square
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.factory import ScannerGeometry
from services.estimator.shared.interface import Observation
from services.simulator.odometry import Odometer, OdometryNoise

SCANS = ("instantaneous", "corrected", "uncorrected")
PRIORS = ("laser only", "odometry")
FULL_SPEED, FULL_TURN = 0.9, 0.9  # m/s, rad/s
MIN_ACCELERATION, MIN_TURN_ACCELERATION = 0.5, 1.5  # m/s², rad/s²
MAX_ERROR_RATIO = 1.3  # required of errors with corrected scans, relative to those with instantaneous scans


@dataclass(frozen=True)
class DistortionJob:
    """One estimator in one world."""

    world: str
    estimator: str
    prior: str
    drives: int
    seconds: float
    beams: int
    seed: int


@dataclass(frozen=True)
class _DriveErrors:
    """Errors of the estimates along one drive."""

    errors: Array  # (N, 3) m, m, rad in map
    nees: Array  # (N,)
    exceeded: Array  # (N, 3) whether an error was larger than the protection level; NaN where none is stated
    full_speed: npt.NDArray[np.bool_]  # (N,)
    accelerating: npt.NDArray[np.bool_]  # (N,)
    update_ms: Array  # (N,)


def run(job: DistortionJob) -> list[dict[str, Any]]:
    """One row for each kind of scan, over all drives."""
    world = load_world(job.world)
    drives: dict[str, list[_DriveErrors]] = {kind: [] for kind in SCANS}
    for number in range(job.drives):
        scene = Scene.of(world, job.beams, (job.seed, number))
        path = scene.path(job.seconds, at_full_speed=True)
        for kind in SCANS:
            scene.rng = np.random.default_rng((job.seed, number, 1))
            drives[kind].append(_run_drive(job, scene, path, kind))
    if not any(drive.full_speed.any() for drive in drives[SCANS[0]]):
        raise UserError(f"no scan at full speed in drives of {job.seconds:g} s: give more --seconds")
    rows = [_row(job, kind, drives[kind]) for kind in SCANS]
    for row in rows:
        for name in ("full_speed", "accelerating"):
            for error in ("position_rms_m", "heading_rms_rad"):
                row[name][f"{error}_over_instantaneous"] = row[name][error] / rows[0][name][error]
    return rows


def _run_drive(job: DistortionJob, scene: Scene, path: Array, kind: str) -> _DriveErrors:
    setup = EstimatorSetup(scene.world, ScannerGeometry.of(scene.scanner), job.seed)
    estimator = COMPARED_ESTIMATORS[job.estimator].make(setup)
    estimator.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    errors, nees, exceeded, update_ms = [], [], [], []
    for observation, truth in zip(observations(scene, path, kind, job.prior), path, strict=False):
        began = time.process_time()
        posterior = estimator.update(observation)
        update_ms.append((time.process_time() - began) * 1e3)
        error = se2.difference(posterior.pose, truth)
        errors.append(error)
        covariance = posterior.covariance
        nees.append(np.nan if covariance is None else float(error @ np.linalg.solve(covariance, error)))
        level = np.full(3, np.nan) if posterior.protection is None else posterior.protection
        in_base = np.abs(se2.rotation(-float(posterior.pose[2])) @ error)
        exceeded.append(np.where(np.isnan(level), np.nan, in_base > level))
    rate = scene.scanner.rate
    velocity = np.diff(path, axis=0) * rate
    velocity[:, 2] = se2.wrap(velocity[:, 2] / rate) * rate
    change = np.diff(velocity, axis=0, prepend=velocity[:1]) * rate
    full_speed = (np.hypot(*velocity[:, :2].T) >= FULL_SPEED) & (np.abs(velocity[:, 2]) >= FULL_TURN)
    accelerating = np.hypot(*change[:, :2].T) >= MIN_ACCELERATION
    accelerating |= np.abs(change[:, 2]) >= MIN_TURN_ACCELERATION
    return _DriveErrors(
        np.array(errors),
        np.array(nees),
        np.array(exceeded),
        full_speed & ~accelerating,
        accelerating,
        np.array(update_ms),
    )


def observations(scene: Scene, path: Array, kind: str, prior: str) -> list[Observation]:
    """Observations along a path (N, 3) at all poses but the last, to which the last sweep leads.

    Between these poses, the robot moves along a cubic curve, so that its velocity changes during a sweep.
    """
    scanner, rate = scene.scanner, scene.scanner.rate
    increment = 0.0 if kind == "instantaneous" else scanner.turn_per_beam / rate
    shares = beam_times(scanner.beams, increment) * rate
    smooth = path.copy()
    smooth[:, 2] = np.unwrap(path[:, 2])
    velocity = np.gradient(smooth, axis=0)
    velocity[0] = 0.0  # a drive begins at rest
    poses_at = CubicHermiteSpline(np.arange(len(path)), smooth, velocity)
    odometer, found = Odometer(OdometryNoise(), scene.rng), []
    for k, pose in enumerate(path[:-1]):
        if k:
            odometer.move(path[k - 1], pose)
        lasers = se2.compose(poses_at(k + shares), np.array(scanner.mount))
        lasers[:, 2] += scanner.angles()
        clean = scene.world.ray_distances(lasers, np.zeros(1))[:, 0]
        odom = odometer.pose.copy() if prior == "odometry" else None
        found.append(scene.observe(clean, k / rate, odom, increment if kind == "corrected" else 0.0))
    return found


def _row(job: DistortionJob, kind: str, drives: list[_DriveErrors]) -> dict[str, Any]:
    errors = np.concatenate([drive.errors for drive in drives])
    exceeded = np.concatenate([drive.exceeded for drive in drives])
    exceeded = exceeded[~np.isnan(exceeded).any(axis=1)]
    return {
        "world": job.world,
        "estimator": job.estimator,
        "prior": job.prior,
        "scans": kind,
        "of": len(errors),
        "not_found": sum(not is_at(error, np.zeros(3)) for error in errors),
        "full_speed": _errors_of(errors[np.concatenate([drive.full_speed for drive in drives])]),
        "accelerating": _errors_of(errors[np.concatenate([drive.accelerating for drive in drives])]),
        "nees_mean": float(np.mean(np.concatenate([drive.nees for drive in drives]))),
        "protection_exceeded": {"count": int(exceeded.any(axis=1).sum()), "of": len(exceeded)},
        "update_ms_median": float(np.median(np.concatenate([drive.update_ms for drive in drives]))),
    }


def _errors_of(errors: Array) -> dict[str, Any]:
    position = np.hypot(errors[:, 0], errors[:, 1])
    return {
        "of": len(errors),
        "position_median_m": float(np.median(position)),
        "position_rms_m": root_mean_square(position),
        "position_p95_m": float(np.quantile(position, 0.95)),
        "heading_rms_rad": root_mean_square(errors[:, 2]),
    }


def bench_distortion(
    worlds: str,
    estimators: str,
    drives: int,
    seconds: float,
    beams: int,
    seed: int,
    json_file: Path | None,
    console: Console,
) -> int:
    """Runs the benchmark, prints a table, and writes ``json_file`` if given. Returns 1 if the limit is exceeded."""
    check_file(json_file, "--json")
    jobs = [
        DistortionJob(world, estimator, prior, drives, seconds, beams, seed)
        for world in worlds.split(",")
        for estimator in estimators.split(",")
        for prior in PRIORS
    ]
    rows = [row for job in track(jobs, "measuring", console=console, transient=True) for row in run(job)]
    errors = ("full speed: mm", "mrad", "accelerating: mm", "mrad")
    table = Table("world", "estimator", "motion from", "scans", *errors, "NEES", "exceeded", "not found", "ms")
    for row in rows:
        table.add_row(
            row["world"],
            row["estimator"],
            row["prior"],
            row["scans"],
            *(text for name in ("full_speed", "accelerating") for text in _cells(row[name])),
            f"{row['nees_mean']:.3g}",
            "{count}/{of}".format(**row["protection_exceeded"]),
            f"{row['not_found']}/{row['of']}",
            f"{row['update_ms_median']:.1f}",
        )
    console.print(table)
    console.print("RMS errors in mm and mrad, and their ratios to those with instantaneous scans")
    worst = max(row["full_speed"]["position_rms_m_over_instantaneous"] for row in rows if row["scans"] == "corrected")
    console.print(
        f"largest ratio with corrected scans at full speed {worst:.2f}; required: at most {MAX_ERROR_RATIO:g}"
    )
    parameters = {"drives": drives, "seconds": seconds, "beams": beams}
    write_json(json_file, {"rows": rows, "limit_ratio": MAX_ERROR_RATIO, **parameters, **provenance(seed)})
    return int(worst > MAX_ERROR_RATIO)


def _cells(errors: dict[str, Any]) -> list[str]:
    position, heading = errors["position_rms_m"], errors["heading_rms_rad"]
    ratio, heading_ratio = errors["position_rms_m_over_instantaneous"], errors["heading_rms_rad_over_instantaneous"]
    return [f"{1e3 * position:.2f} ({ratio:.2f})", f"{1e3 * heading:.2f} ({heading_ratio:.2f})"]
