"""E1: a standing robot.

100 trials of 50 iterations at places uniform over free space. Places in front of the objects, the unobstructed middle
of the paper, are also reported separately. An iteration is one scan with fresh noise, and one gradient step of preset
paper. Its belief starts at the map's centre; the particle filter's particles start anywhere in free space. No estimator
has odometry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from common.geometry.se2 import Array
from lab.accuracy import bound
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
from services.estimator.shared.interface import PoseEstimator

EXPERIMENT_ID = 1  # part of the random seeds
ESTIMATORS = tuple(name for name in NAMES if not uses_odometry(name))  # the robot stands
FOUND_DISTANCE = 0.5  # m; an error below it counts as found
CLOSE_DISTANCE = 0.2  # m; an error below it counts as close


@dataclass(frozen=True)
class LocalisationJob:
    """One trial: one place, with the same scans for every estimator."""

    index: int
    seed: int
    iterations: int
    estimators: tuple[str, ...] = ESTIMATORS
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen
    descent: Descent = PAPER_DESCENT


def trial(job: LocalisationJob, create: Callable[..., PoseEstimator] = create_estimator) -> dict[str, Any]:
    """Runs one trial. Returns each estimator's error (m) after every iteration and its final state, and the bound.

    ``create`` makes the estimators of the job by their names; it has the arguments of `create_estimator`.
    """
    scene = job.field.scene(job.seed, EXPERIMENT_ID, job.index)
    pose = scene.poses(1)[0]
    pose[2] = job.field.heading
    clean = scene.clean(pose[None])[0]
    scans = [scene.observe(clean, k / scene.scanner.rate) for k in range(job.iterations)]
    one_scan = bound.single(scene, pose[None])
    outcome: dict[str, Any] = {
        "pose": pose.tolist(),
        "in_front": bool(pose[1] < job.field.front()),
        "bound": one_scan[0].tolist(),
        "error_m": {},
        "claim": {},
    }
    for name in job.estimators:
        estimator = create(name, job.field, scene, job.seed * 100_003 + job.index, job.descent)
        posteriors = [estimator.update(scan) for scan in scans]
        outcome["error_m"][name] = [round(float(np.hypot(*(p.pose - pose)[:2])), 6) for p in posteriors]
        outcome["claim"][name] = posteriors[-1].state
    return outcome


def summarise(trials: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Statistics of one estimator over all trials."""
    errors = np.array([each["error_m"][name] for each in trials])
    limit = bounds(trials, knows_heading(name)) / errors.shape[1]
    last, claims = errors[:, -1], [each["claim"][name] == "tracking" for each in trials]
    front = np.array([each["in_front"] for each in trials], bool)
    # Iterations until the estimate is close and stays close; infinite if it never is.
    far = errors >= CLOSE_DISTANCE
    until = np.array([np.inf if row[-1] else (np.flatnonzero(row)[-1] + 2 if row.any() else 1) for row in far])
    return {
        "trials": len(trials),
        "final_error_mean_m": float(last.mean()),
        "final_error_std_m": float(last.std()),
        "final_error_median_m": float(np.median(last)),
        "final_error_max_m": float(last.max()),
        "final_error_rms_m": root_mean_square(last),
        "final_rms_over_bound": float(np.sqrt(np.mean(last**2) / np.mean(bound.position(limit) ** 2))),
        "final_median_over_bound": float(np.median(last)) / bound.median_error(limit),
        "found_within_0.5_m": int((last < FOUND_DISTANCE).sum()),
        "found_within_0.2_m": int((last < CLOSE_DISTANCE).sum()),
        "first_scan_error_median_m": float(np.median(errors[:, 0])),
        "iterations_to_0.2_m_median": float(np.median(until)) if np.isfinite(np.median(until)) else None,
        "places_in_front": int(front.sum()),
        "in_front_within_0.5_m": int((last[front] < FOUND_DISTANCE).sum()),
        "in_front_error_mean_m": float(last[front].mean()) if front.any() else None,
        "in_front_error_std_m": float(last[front].std()) if front.any() else None,
        "in_front_error_median_m": float(np.median(last[front])) if front.any() else None,
        "claimed_tracking": int(np.sum(claims)),
        "claimed_tracking_but_wrong": int(np.sum(np.array(claims) & (last >= FOUND_DISTANCE))),
    }


def run(job: LocalisationJob, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """Runs all trials. Writes e1.json, .csv, .pdf and .png into ``out``."""
    jobs = [replace(job, index=index) for index in range(trials)]
    rows = run_trials("e1", trial, jobs, out, workers, console)
    curves: dict[str, list[Any]] = {"iteration": list(range(1, job.iterations + 1))}
    curves |= results.curves_of(rows, job.estimators)
    for name in job.estimators:
        curves[f"{name} median m"] = np.median([row["error_m"][name] for row in rows], axis=0).tolist()
    for text, known in (("", False), (", heading known", True)):
        one = bounds(rows, known)
        rms, median = root_mean_square(bound.position(one)), bound.median_error(one)
        for what, value in (("RMS", rms), ("median", median)):
            curves[f"bound{text} {what} m"] = [value / float(np.sqrt(k)) for k in range(1, job.iterations + 1)]
    parameters = asdict(job) | {"trials": trials, "bound_end_m": curves["bound RMS m"][-1]}
    result = results.Result(
        "e1",
        "E1: a standing robot localised",
        job.seed,
        parameters,
        {name: summarise(rows, name) for name in job.estimators},
        curves,
        rows,
    )
    result.write(out, draw(rows, job.estimators, result.curves))
    return result


def bounds(rows: Sequence[dict[str, Any]], heading_known: bool) -> Array:
    """Cramér-Rao bound (N, 3, 3) of one scan at each trial's place; for k scans it is k times smaller."""
    limits = np.array([row["bound"] for row in rows])
    return bound.heading_known(limits) if heading_known else limits


def draw(rows: Sequence[dict[str, Any]], names: Sequence[str], curves: dict[str, list[Any]]) -> Figure:
    """Error over iterations, as in the paper's figure 3, and on a logarithmic axis, which shows all estimators."""
    figure, panels = drawing.figure_of(2)
    for axes, draw_curve in zip(panels, (drawing.band, drawing.quartiles), strict=True):
        for name in names:
            draw_curve(axes, curves["iteration"], [row["error_m"][name] for row in rows], name)
        axes.set(xlabel="iteration (one scan)", ylabel="position error (m)", xlim=(1, curves["iteration"][-1]))
    for text, style in (("", "--"), (", heading known", ":")):
        limit = curves[f"bound{text} median m"]
        panels[1].plot(curves["iteration"], limit, style, color=drawing.BOUND, label=f"Cramér-Rao bound{text}")
    panels[0].set(ylim=(0, None), title="mean ± standard deviation, as the paper draws it")
    drawing.log_metres(panels[1])
    panels[1].set(title="median and quartiles; bound: median at best")
    drawing.legend_below(figure, *panels)
    return figure


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    heads = (
        "estimator",
        "error, mean ± std (m)",
        "median (mm)",
        "RMS / bound",
        "within 0.5 m",
        "iterations to 0.2 m",
        "reports `tracking`; wrongly",
    )
    rows = [
        [
            name,
            results.mean_std(row, "final_error"),
            results.millimetres(row["final_error_median_m"]),
            results.ratio(row["final_rms_over_bound"]),
            f"{row['found_within_0.5_m']}/{row['trials']}",
            results.number(row["iterations_to_0.2_m_median"], 0),
            f"{row['claimed_tracking']}; {row['claimed_tracking_but_wrong']}",
        ]
        for name, row in summary.items()
    ]
    return results.markdown(heads, rows)
