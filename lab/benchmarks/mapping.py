"""`presage bench mapping`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from lab.integrity.cases import CASES, make_trial
from lab.statistics import root_mean_square
from presage.learning.map_of_log import raw_drive
from presage.logs.scan_files import read_scans
from presage.terminal.output import check_file, provenance, write_json
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.trajectory import build_trajectory

Errors = tuple[Array, Array]  # (K,) m and (K,) rad
COLUMNS = ("position_mean_m", "position_std_m", "position_max_m", "heading_mean_deg", "heading_std_deg")


def bench_mapping(
    log: Path | None,
    relations: Path | None,
    worlds: int,
    seed: int,
    seconds: float,
    json_file: Path | None,
    console: Console,
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    if (log is None) != (relations is None):
        raise UserError("--log and --relations belong together: give both, or neither")
    rows = []
    if log is not None and relations is not None:
        table = _read_relations(relations)
        drive = _drive_of_log(log)
        rows += _rows(log.name, drive, partial(relation_errors, stamps=drive.stamps, relations=table), console)
    for number in range(seed, seed + worlds):
        simulated, truths = _simulated(number, seconds)
        rows += _rows(f"building {number}", simulated, partial(trajectory_errors, truths=truths), console)
    if not rows:
        raise UserError("nothing to map: give --worlds, or --log and --relations")
    _print(rows, console)
    write_json(json_file, {"rows": rows, **provenance(seed)})


def relation_errors(poses: Array, stamps: Array, relations: Array) -> Errors:
    """Errors of the relative poses between times, as Kümmerle et al. (Autonomous Robots 27, 2009) define them.

    ``relations`` (K, 5) are two times in s and the true relative pose x, y (m), yaw (rad).
    """
    known = np.isfinite(poses).all(axis=1)
    unwrapped, stamps = poses[known], stamps[known]
    unwrapped[:, 2] = np.unwrap(poses[known, 2])
    first, second = (
        np.stack([np.interp(times, stamps, axis) for axis in unwrapped.T], axis=-1) for times in relations[:, :2].T
    )
    error = se2.between(relations[:, 2:], se2.between(first, second))
    return np.hypot(error[:, 0], error[:, 1]), np.abs(se2.wrap(error[:, 2]))


def trajectory_errors(poses: Array, truths: Array) -> Errors:
    """Errors of the known poses of a trajectory (N, 3), moved and turned as a whole so that its positions fit best."""
    known = np.isfinite(poses).all(axis=1)
    poses, truths = poses[known], truths[known]
    error = fitted(poses, truths) - truths
    return np.hypot(*error[:, :2].T), np.abs(se2.wrap(error[:, 2]))


def fitted(poses: Array, truths: Array) -> Array:
    """A trajectory (N, 3), moved and turned as a whole so that its positions are nearest to those of ``truths``."""
    return se2.compose(se2.alignment(poses, truths), poses)


def _read_relations(file: Path) -> Array:
    """Relations (K, 5) of a file with two times, x, y, z, roll, pitch and yaw in each line."""
    try:
        table = np.loadtxt(file, ndmin=2)
        return np.asarray(table[:, [0, 1, 2, 3, 7]])
    except (OSError, ValueError, IndexError) as error:
        raise UserError(
            f"--relations {file}: not two times, x, y, z, roll, pitch, yaw in each line ({error})"
        ) from None


def _drive_of_log(log: Path) -> RawDrive:
    scans = read_scans(log)
    if scans.stamps is None:
        raise UserError(f"{log}: the scans have no times")
    return raw_drive(scans, scans.stamps, scans.odom)


def _simulated(seed: int, seconds: float) -> tuple[RawDrive, Array]:
    """A drive in the building of a seed with the simulator's odometry noise, and its true poses (N, 3)."""
    trial = make_trial(CASES["odometry"], seed, seconds)
    scans, scanner = trial.observations, trial.scanner
    ranges, odom = np.array([scan.ranges for scan in scans]), np.array([scan.odom for scan in scans])
    stamps = np.array([scan.stamp for scan in scans], float)
    laser = Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max)
    return RawDrive(stamps, ranges, laser, odom), trial.truths


def _rows(name: str, drive: RawDrive, errors: Callable[[Array], Errors], console: Console) -> list[dict[str, Any]]:
    """Results of mapping a drive with odometry, where it has any, and without."""
    rows = []
    for odometry in (True, False) if drive.odom is not None else (False,):
        begin = time.perf_counter()
        with console.status(f"mapping {name} {'with' if odometry else 'without'} odometry"):
            built = build_trajectory(drive if odometry else replace(drive, odom=None))
        taken = time.perf_counter() - begin
        position, heading = errors(built.poses)
        placed = np.isfinite(built.poses).all(axis=1).mean()
        degrees = np.rad2deg(heading)
        values = (position.mean(), position.std(), position.max(), degrees.mean(), degrees.std())
        rows.append(
            {
                "drive": name,
                "odometry": odometry,
                **dict(zip(COLUMNS, map(float, values), strict=True)),
                "position_rms_m": root_mean_square(position),
                "closures": len(built.closures),
                "lost": built.unmatched,
                "placed": float(placed),
                "duration_s": float(drive.stamps[-1] - drive.stamps[0]),
                "seconds": taken,
            }
        )
    return rows


def _print(rows: list[dict[str, Any]], console: Console) -> None:
    table = Table(title="Mapping without reference poses")
    for title in (
        "drive",
        "odometry",
        "position, mean ± std (m)",
        "RMS; max (m)",
        "heading (°)",
        "closures; lost",
        "time",
    ):
        table.add_column(title)
    for row in rows:
        table.add_row(
            row["drive"],
            "yes" if row["odometry"] else "no",
            f"{row['position_mean_m']:.4f} ± {row['position_std_m']:.4f}",
            f"{row['position_rms_m']:.4f}; {row['position_max_m']:.3f}",
            f"{row['heading_mean_deg']:.3f} ± {row['heading_std_deg']:.3f}",
            f"{row['closures']}; {row['lost']}",
            f"{row['seconds']:.0f} s of {row['duration_s']:.0f} s",
        )
    console.print(table)
