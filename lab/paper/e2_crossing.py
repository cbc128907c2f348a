"""E2: small teleports across the map.

The robot is teleported 5 cm between two scans (0.75 m/s at 15 Hz) from one end of the corridor to the other, at a
distance from the objects' wall that differs between trials. All estimators know the start. Only those with "odometry"
in their name have odometry: dead reckoning of the teleports, with the same drift as in the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.figure import Figure
from rich.console import Console

from common.errors import UserError
from common.geometry.se2 import Array
from common.robot.robot import Robot
from lab.accuracy import bound
from lab.accuracy.scenes import Scene
from lab.experiments import results
from lab.experiments.estimators import (
    NAMES,
    PAPER_DESCENT,
    ExperimentWorld,
    create_estimator,
    knows_heading,
    uses_odometry,
)
from lab.experiments.trials import run_trials
from lab.statistics import root_mean_square
from presage.plotting import style as drawing
from services.estimator.paper.perception import Descent
from services.simulator.odometry import Odometer, OdometryNoise

EXPERIMENT_ID = 2  # part of the random seeds
START_COVARIANCE = np.diag([0.01, 0.01, 0.01])  # m², m², rad²: 10 cm and 6 degrees
LOST_DISTANCE = 0.5  # m; a larger error counts as lost
BOUND_NAMES = ("one scan", "one scan, heading known", "all scans, odometry")
MARGIN = 0.1  # m, between the robot and any obstacle


@dataclass(frozen=True)
class CrossingJob:
    """One crossing, with the same scans for every estimator."""

    index: int
    seed: int
    step: float = 0.05  # m, of each teleport
    estimators: tuple[str, ...] = NAMES
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen
    descent: Descent = PAPER_DESCENT


def bound_of(name: str) -> str:
    """Name of the bound that applies to an estimator: without odometry each scan counts alone."""
    return BOUND_NAMES[2] if uses_odometry(name) else BOUND_NAMES[knows_heading(name)]


def path_of(scene: Scene, heading: float, step: float) -> Array:
    """Poses (N, 3) along a random free straight line across the world in direction x, every ``step`` m.

    Raises UserError if no free line is found.
    """
    x0, y0, x1, y1 = scene.world.bounds
    away = Robot().radius + MARGIN
    room = shapely.buffer(scene.world.free_space, -away)
    for y in scene.rng.uniform(y0 + away, y1 - away, 1000):
        if shapely.covers(room, shapely.LineString([(x0 + away + 1e-6, y), (x1 - away - 1e-6, y)])):
            x = np.arange(x0 + away + 1e-6, x1 - away, step)
            return np.column_stack([x, np.full(len(x), y), np.full(len(x), heading)])
    raise UserError(f"world {scene.world.name!r} has no free straight line from one side to the other: take another")


def trial(job: CrossingJob) -> dict[str, Any]:
    """Runs one crossing. Returns each estimator's error (m) at every scan, and the bounds."""
    scene = job.field.scene(job.seed, EXPERIMENT_ID, job.index)
    path = path_of(scene, job.field.heading, job.step)
    odometer, scans = Odometer(OdometryNoise(), np.random.default_rng((job.seed, EXPERIMENT_ID, job.index, 1))), []
    for k, clean in enumerate(scene.clean(path)):
        if k:
            odometer.move(path[k - 1], path[k])
        scans.append(scene.observe(clean, k / scene.scanner.rate, odometer.pose.copy()))
    outcome: dict[str, Any] = {"y": float(path[0, 1]), "error_m": {}, "lost": {}}
    one = bound.single(scene, path)
    limits = one, bound.heading_known(one), bound.recursive(scene, path, OdometryNoise(), START_COVARIANCE)
    outcome["bound_m"] = {
        name: np.round(bound.position(each), 7).tolist() for name, each in zip(BOUND_NAMES, limits, strict=True)
    }
    for name in job.estimators:
        estimator = create_estimator(name, job.field, scene, job.seed * 100_003 + job.index, job.descent)
        estimator.restart(path[0], START_COVARIANCE)
        with_odometry = scans if uses_odometry(name) else [replace(scan, odom=None) for scan in scans]
        poses = np.array([estimator.update(scan).pose for scan in with_odometry])
        error = np.hypot(*(poses - path)[:, :2].T)
        outcome["error_m"][name] = np.round(error, 6).tolist()
        outcome["lost"][name] = bool((error > LOST_DISTANCE).any())
    return outcome


def summarise(trials: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Statistics of one estimator over all crossings."""
    error = np.concatenate([each["error_m"][name] for each in trials])
    limit = np.concatenate([each["bound_m"][bound_of(name)] for each in trials])
    return {
        "crossings": len(trials),
        "error_mean_m": float(error.mean()),
        "error_std_m": float(error.std()),
        "error_median_m": float(np.median(error)),
        "error_rms_m": root_mean_square(error),
        "error_max_m": float(error.max()),
        "bound": bound_of(name),
        "rms_over_bound": float(np.sqrt(np.mean(error**2) / np.mean(limit**2))),
        "crossings_ever_0.5_m_off": int(np.sum([each["lost"][name] for each in trials])),
    }


def run(job: CrossingJob, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """Runs all crossings. Writes e2.json, .csv, .pdf and .png into ``out``."""
    jobs = [replace(job, index=index) for index in range(trials)]
    rows = run_trials("e2", trial, jobs, out, workers, console)
    scans = len(rows[0]["bound_m"][BOUND_NAMES[0]])
    scanner = job.field.scene(job.seed).scanner
    curves: dict[str, list[Any]] = {"time s": [round(k / scanner.rate, 6) for k in range(scans)]}
    curves |= results.curves_of(rows, job.estimators)
    for name in job.estimators:
        curves[f"{name} RMS m"] = _rms([row["error_m"][name] for row in rows])
    parameters = asdict(job) | {"trials": trials}
    for name in BOUND_NAMES:
        limits = [row["bound_m"][name] for row in rows]
        curves[f"bound, {name} RMS m"] = _rms(limits)
        parameters[f"bound, {name}, rms_m"] = root_mean_square(np.array(limits))
    result = results.Result(
        "e2",
        "E2: crossing the map by small teleports",
        job.seed,
        parameters,
        {name: summarise(rows, name) for name in job.estimators},
        curves,
        rows,
    )
    result.write(out, draw(job.estimators, result.curves))
    return result


def _rms(rows: Sequence[Sequence[float]]) -> list[float]:
    """Root mean square over N trials at each of K times."""
    return [float(value) for value in np.sqrt(np.mean(np.square(rows), axis=0))]


def draw(names: Sequence[str], curves: dict[str, list[Any]]) -> Figure:
    """RMS error and RMS bound of all crossings over time, without and with odometry."""
    figure, panels = drawing.figure_of(2)
    with_odometry = [name for name in names if uses_odometry(name)]
    groups = [name for name in names if name not in with_odometry], with_odometry
    titles, limits = ("laser alone", "with odometry that drifts"), (BOUND_NAMES[:2], BOUND_NAMES[2:])
    for axes, group, title, lines in zip(panels, groups, titles, limits, strict=True):
        for name in group:
            drawing.line(axes, curves["time s"], curves[f"{name} RMS m"], name)
        for name, style in zip(lines, ("--", ":"), strict=False):
            limit = curves[f"bound, {name} RMS m"]
            axes.plot(curves["time s"], limit, style, color=drawing.BOUND, label=f"bound: {name}")
        drawing.log_metres(axes)
        axes.set(xlabel="time (s)", ylabel="position error, RMS of all crossings (m)", title=title)
    low, high = zip(*(axes.get_ylim() for axes in panels), strict=True)
    for axes in panels:
        axes.set(ylim=(max(min(low), drawing.MIN_LOG_VALUE), max(high)))
    drawing.legend_below(figure, *panels)
    return figure


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    heads = ("estimator", "median (mm)", "RMS (mm)", "RMS / bound", "max (mm)", "crossings lost")
    rows = [
        [
            name,
            *(results.millimetres(row[f"error_{kind}_m"]) for kind in ("median", "rms")),
            results.ratio(row["rms_over_bound"]),
            results.millimetres(row["error_max_m"]),
            f"{row['crossings_ever_0.5_m_off']}/{row['crossings']}",
        ]
        for name, row in summary.items()
    ]
    return results.markdown(heads, rows)
