"""`presage bench distortion`: errors of a tracking robot whose scanner measures one beam after another.

Each drive is run three times with the same noise: with instantaneous scans, with swept scans that the estimator
corrects, and with the same scans uncorrected. Errors are those of scans taken at full speed: at least 0.9 m/s and
0.9 rad/s. They are of the pose at the stamp, when the first beam is measured.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.robot.motion_distortion import beam_times
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS, EstimatorSetup
from lab.accuracy.scenes import Scene
from lab.accuracy.tasks import is_at
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.factory import ScannerGeometry
from services.estimator.shared.interface import Observation
from services.simulator.odometry import Odometer, OdometryNoise

SCANS = ("instantaneous", "corrected", "uncorrected")
PRIORS = ("laser only", "odometry")
FULL_SPEED, FULL_TURN = 0.9, 0.9  # m/s, rad/s
LIMIT = 1.3  # required ratio of the errors with corrected and with instantaneous scans


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


def run(job: DistortionJob) -> list[dict[str, Any]]:
    """One row for each kind of scan, over all drives."""
    world = load_world(job.world)
    errors: dict[str, list[Array]] = {kind: [] for kind in SCANS}
    update_ms: dict[str, list[float]] = {kind: [] for kind in SCANS}
    for number in range(job.drives):
        scene = Scene.of(world, job.beams, (job.seed, number))
        path = scene.path(job.seconds, at_full_speed=True)
        for kind in SCANS:
            scene.rng = np.random.default_rng((job.seed, number, 1))
            estimator = COMPARED_ESTIMATORS[job.estimator].make(
                EstimatorSetup(world, ScannerGeometry.of(scene.scanner), job.seed)
            )
            estimator.restart(path[0], np.diag([0.01, 0.01, 0.01]))
            estimates = []
            for observation in observations(scene, path, kind, job.prior):
                began = time.process_time()
                estimates.append(estimator.update(observation).pose)
                update_ms[kind].append((time.process_time() - began) * 1e3)
            errors[kind].append(full_speed_errors(np.array(estimates), path, scene.scanner.rate))
    joined = {kind: np.concatenate(errors[kind]) for kind in SCANS}
    if not len(joined[SCANS[0]]):
        raise UserError(f"no scan at full speed in drives of {job.seconds:g} s: give more --seconds")
    rows = [_row(job, kind, joined[kind]) for kind in SCANS]
    for row in rows:
        row["update_ms_median"] = float(np.median(update_ms[row["scans"]]))
        row["over_instantaneous"] = row["position_error_rms_m"] / rows[0]["position_error_rms_m"]
        row["heading_over_instantaneous"] = row["heading_error_rms_rad"] / rows[0]["heading_error_rms_rad"]
    return rows


def observations(scene: Scene, path: Array, kind: str, prior: str) -> list[Observation]:
    """Observations along a path (N, 3) at all poses but the last, to which the last sweep leads."""
    scanner, rate = scene.scanner, scene.scanner.rate
    increment = 0.0 if kind == "instantaneous" else scanner.turn_per_beam / rate
    shares = beam_times(scanner.beams, increment) * rate
    odometer, found = Odometer(OdometryNoise(), scene.rng), []
    for k, (pose, following) in enumerate(pairwise(path)):
        if k:
            odometer.move(path[k - 1], pose)
        step = following - pose
        step[2] = se2.wrap(step[2])
        lasers = se2.compose(pose + shares[:, None] * step, np.array(scanner.mount))
        lasers[:, 2] += scanner.angles()
        clean = scene.world.ray_distances(lasers, np.zeros(1))[:, 0]
        odom = odometer.pose.copy() if prior == "odometry" else None
        found.append(scene.observe(clean, k / rate, odom, increment if kind == "corrected" else 0.0))
    return found


def full_speed_errors(estimates: Array, path: Array, rate: float) -> Array:
    """Errors (K, 3) m, m, rad in map of the estimates (N, 3) at full speed."""
    velocity = np.diff(path, axis=0) * rate
    velocity[:, 2] = se2.wrap(velocity[:, 2] / rate) * rate
    fast = (np.hypot(*velocity[:, :2].T) >= FULL_SPEED) & (np.abs(velocity[:, 2]) >= FULL_TURN)
    error = estimates - path[:-1]
    error[:, 2] = se2.wrap(error[:, 2])
    return np.asarray(error[fast])


def _row(job: DistortionJob, kind: str, errors: Array) -> dict[str, Any]:
    position, heading = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    return {
        "world": job.world,
        "estimator": job.estimator,
        "prior": job.prior,
        "scans": kind,
        "of": len(errors),
        "not_found": sum(not is_at(error, np.zeros(3)) for error in errors),
        "position_error_median_m": float(np.median(position)),
        "position_error_rms_m": float(np.sqrt(np.mean(position**2))),
        "position_error_p95_m": float(np.quantile(position, 0.95)),
        "heading_error_rms_rad": float(np.sqrt(np.mean(heading**2))),
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
    table = Table(
        "world", "estimator", "motion from", "scans", "RMS mm", "ratio", "RMS mrad", "ratio", "not found", "ms"
    )
    for row in rows:
        table.add_row(
            row["world"],
            row["estimator"],
            row["prior"],
            row["scans"],
            f"{1e3 * row['position_error_rms_m']:.2f}",
            f"{row['over_instantaneous']:.2f}",
            f"{1e3 * row['heading_error_rms_rad']:.2f}",
            f"{row['heading_over_instantaneous']:.2f}",
            f"{row['not_found']}/{row['of']}",
            f"{row['update_ms_median']:.1f}",
        )
    console.print(table)
    worst = max(row["over_instantaneous"] for row in rows if row["scans"] == "corrected")
    console.print(f"largest ratio with corrected scans {worst:.2f}; required: at most {LIMIT:g}")
    parameters = {"drives": drives, "seconds": seconds, "beams": beams}
    write_json(json_file, {"rows": rows, "limit_ratio": LIMIT, **parameters, **provenance(seed)})
    return int(worst > LIMIT)
