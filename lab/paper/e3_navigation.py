"""E3: navigation.

The real processes (router, simulator, estimator, controller) run in lockstep over zenoh. One iteration is one scan, one
belief and one velocity command: 1/15 s. The belief starts at the true start. Unlike in the paper the robot is not
teleported, but drives with limited speed and acceleration. A trial ends when the robot truly is within 0.8 m of the
goal; it need not stop there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.robot.robot import Robot
from lab.experiments import results
from lab.experiments.estimators import PAPER_DESCENT, TEN_STEPS, ExperimentWorld, uses_odometry
from lab.experiments.lockstep import LockstepRun, RunTrace, session
from lab.experiments.lockstep import run as run_in_lockstep
from lab.experiments.start_and_goal import (
    ARRIVAL_DISTANCE,
    CLEARANCE,
    MIN_DISTANCE,
    StartAndGoal,
    draw_start_and_goal,
    least_time,
    path_ratio,
)
from lab.experiments.trials import run_trials
from presage.plotting import style as drawing
from services.estimator.paper.perception import Descent

EXPERIMENT_ID = 3  # part of the random seeds
ESTIMATORS = (f"paper, {TEN_STEPS}", "precise", "particle-filter")


@dataclass(frozen=True)
class PaperNavigationJob:
    """One start and goal, the same for every estimator."""

    index: int
    seed: int
    apart: float = MIN_DISTANCE  # m, minimum distance between start and goal
    limit: int = 900  # maximum number of iterations: one minute
    free: bool = True  # whether the straight line between start and goal must be free
    estimators: tuple[str, ...] = ESTIMATORS
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen
    descent: Descent = PAPER_DESCENT  # parameters of estimator `paper`


def arguments(name: str, descent: Descent) -> tuple[str, ...]:
    """Command-line arguments of the estimator service, for an estimator's name in the figures.

    Raises UserError if the service does not offer this estimator.
    """
    kind, _, how = name.partition(", ")
    if how not in ("", "odometry", TEN_STEPS):
        raise UserError(f"estimator {name!r} is not available as a service: choose others for e3 with --estimators")
    steps = ("--alpha", repr(descent.alpha), "--iterations", str(descent.iterations)) if name == "paper" else ()
    return ("--estimator", kind, *(("--prior", "odometry") if uses_odometry(name) else ()), *steps)


def trial(job: PaperNavigationJob) -> dict[str, Any]:
    """Drives from one start to its goal with every estimator. Returns both, and each estimator's results."""
    world = load_world(job.field.world)
    ends = draw_start_and_goal(
        world, np.random.default_rng((job.seed, EXPERIMENT_ID, job.index)), Robot(), job.apart, free=job.free
    )
    outcome: dict[str, Any] = asdict(ends) | {"straight_m": ends.straight, "estimators": {}}
    outcome["least_s"] = least_time(ends.straight, Robot())
    seed = (job.seed * 100_003 + job.index) % 2**31
    with session() as stack:
        for name in job.estimators:
            lockstep_run = LockstepRun(
                ends,
                job.field.heading,
                job.field.world,
                job.field.beams,
                seed,
                arguments(name, job.descent),
                job.limit,
            )
            outcome["estimators"][name] = measure(run_in_lockstep(lockstep_run, stack), ends)
    return outcome


def measure(trace: RunTrace, ends: StartAndGoal) -> dict[str, Any]:
    """Results of one run. Lists have one entry per iteration, the first from before any motion."""
    path = trace.path()
    away = np.hypot(*(path[:, :2] - np.array(ends.goal)).T)
    error = np.hypot(*(trace.believed() - path)[:, :2].T)
    seconds = trace.truths[-1].stamp_ns * 1e-9
    return {
        "reached": bool(away[-1] <= ARRIVAL_DISTANCE),
        "iterations": len(path) - 1,
        "seconds": seconds,
        "time_over_least": seconds / least_time(ends.straight, Robot()),
        "path_over_straight": path_ratio(path),
        "contacts": sum(truth.contact for truth in trace.truths),
        "held_back": sum(truth.stopped for truth in trace.truths),  # by the obstacle stop
        "distance_m": np.round(away, 6).tolist(),
        "error_m": np.round(error, 6).tolist(),
        "x_m": np.round(path[:, 0], 4).tolist(),
        "y_m": np.round(path[:, 1], 4).tolist(),
    }


def summarise(trials: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Statistics of one estimator over all trials; times and paths only of trials that reached the goal."""
    every = [each["estimators"][name] for each in trials]
    reached = [each for each in every if each["reached"]]
    error = np.concatenate([each["error_m"] for each in every])

    def of(quantity: str, statistic: Any) -> float | None:
        return float(statistic([each[quantity] for each in reached])) if reached else None

    return {
        "trials": len(every),
        "reached": len(reached),
        "trials_with_contact": sum(each["contacts"] > 0 for each in every),
        "scans_held_back": sum(each["held_back"] for each in every),
        "iterations_mean": of("iterations", np.mean),
        "iterations_median": of("iterations", np.median),
        "seconds_median": of("seconds", np.median),
        "time_over_least_median": of("time_over_least", np.median),
        "time_over_least_max": of("time_over_least", np.max),
        "path_over_straight_mean": of("path_over_straight", np.mean),
        "path_over_straight_max": of("path_over_straight", np.max),
        "error_mean_m": float(error.mean()),
        "error_std_m": float(error.std()),
        "error_median_m": float(np.median(error)),
        "error_max_m": float(error.max()),
    }


def run(job: PaperNavigationJob, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """Runs all trials. Writes e3.json, .csv, .trials.jsonl, .pdf and .png into ``out``."""
    for name in job.estimators:
        arguments(name, job.descent)
    jobs = [replace(job, index=index) for index in range(trials)]
    rows = run_trials("e3", trial, jobs, out, workers, console)
    curves: dict[str, list[Any]] = {"iteration": []}
    for name in job.estimators:
        for what, quantity in (("distance", "distance_m"), ("error", "error_m")):
            mean, std = results.spread(_rows(rows, name, quantity, job.estimators))
            curves[f"{name} {what} mean m"], curves[f"{name} {what} std m"] = mean, std
            curves["iteration"] = list(range(len(mean)))
    straight = [row["straight_m"] for row in rows]
    redrawn = {name: sum(row[name] for row in rows) for name in ("too_near", "obstructed")}
    parameters = asdict(job) | {
        "trials": trials,
        "close_m": ARRIVAL_DISTANCE,
        "clearance_m": CLEARANCE,
        "robot": Robot().model_dump(),
        "straight_mean_m": float(np.mean(straight)),
        "straight_max_m": float(np.max(straight)),
        "pairs_redrawn_too_near": redrawn["too_near"],
        "pairs_redrawn_obstructed": redrawn["obstructed"],
    }
    result = results.Result(
        "e3",
        "E3: navigation through the real processes",
        job.seed,
        parameters,
        {name: summarise(rows, name) for name in job.estimators},
        curves,
        rows,
        [_note_on_pairs(trials, redrawn["obstructed"] if job.free else None, float(np.mean(straight)))],
    )
    result.write(out, draw(rows, job))
    return result


def _note_on_pairs(trials: int, obstructed: int | None, straight_mean_m: float) -> str:
    """How starts and goals were chosen.

    ``obstructed`` counts pairs left out because something stood between; None if those were taken too.
    """
    if obstructed is None:
        note = f"{trials} pairs at random, though this controller goes straight: what stands between holds the robot."
    else:
        note = (
            f"{trials} of {trials + obstructed} pairs far enough apart were taken. Of the others the straight "
            f"line comes nearer than {Robot().radius + CLEARANCE:.2f} m to something, and this controller goes "
            "straight."
        )
    return f"{note} On average the goal is {straight_mean_m:.1f} m from the start (the paper: about 11 to 13.5 m)."


def _rows(rows: Sequence[dict[str, Any]], name: str, quantity: str, names: Sequence[str]) -> Array:
    """One quantity of all trials (N, K), padded with the last value to the longest trial of all estimators."""
    longest = max(len(row["estimators"][each][quantity]) for row in rows for each in names)
    return drawing.pad_with_last([row["estimators"][name][quantity] for row in rows], longest)


def draw(rows: Sequence[dict[str, Any]], job: PaperNavigationJob) -> Figure:
    """Distance to the goal and error over iterations, as in the paper's figure 3, and the paths below."""
    figure = drawing.empty_figure(13.0, 7.2)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.25, 1))
    left, right, below = (drawing.style_axes(figure.add_subplot(part)) for part in (grid[0, 0], grid[0, 1], grid[1, :]))
    for name in job.estimators:
        colour = drawing.GOAL if name == "precise" else drawing.COLOURS[name]
        for axes, quantity in ((left, "distance_m"), (right, "error_m")):
            values = _rows(rows, name, quantity, job.estimators)
            drawing.band(axes, range(values.shape[1]), values, name, colour)
            if name == "precise" and axes is left:  # wide, because another estimator's line may cover it
                axes.lines[-1].set(linewidth=3.2, zorder=1.5)
    left.axhline(ARRIVAL_DISTANCE, linestyle="--", color=drawing.BOUND, linewidth=1)
    left.annotate(
        f"{ARRIVAL_DISTANCE:g} m: there", (1, ARRIVAL_DISTANCE), (4, 4), textcoords="offset points", fontsize=9
    )
    left.set(xlabel="iteration (one scan, 1/15 s)", ylabel="distance to the goal (m)", ylim=(0, None))
    right.set(xlabel="iteration", ylabel="position error of the belief (m)")
    drawing.log_metres(right)
    # The axis ends with the last arrival; robots that never arrive stand still after it.
    every = [each for row in rows for each in row["estimators"].values()]
    last = max((each["iterations"] for each in every if each["reached"]), default=job.limit)
    for axes in (left, right):
        axes.set_xlim(0, last + 10)
    drawing.world_map(below, load_world(job.field.world))
    name = "precise" if "precise" in job.estimators else job.estimators[-1]
    for row in rows:
        one = row["estimators"][name]
        below.plot(one["x_m"], one["y_m"], color=drawing.GOAL, linewidth=0.7, alpha=0.7)
        below.plot(*row["start"], "o", color="black", markersize=2.5)
        below.plot(*row["goal"], "x", color=drawing.PREDICTED, markersize=4)
    below.set(title=f"true paths with {name}: from dots to crosses, until within {ARRIVAL_DISTANCE:g} m")
    drawing.legend_below(figure, left)
    return figure


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    heads = (
        "estimator",
        "reached",
        "trials with contact",
        "scans with obstacle stop",
        "iterations, mean",
        "time / least, median; max",
        "error, mean ± std (m)",
    )
    rows = [
        [
            name,
            f"{row['reached']}/{row['trials']}",
            str(row["trials_with_contact"]),
            str(row["scans_held_back"]),
            results.number(row["iterations_mean"], 1),
            f"{results.number(row['time_over_least_median'])}; {results.number(row['time_over_least_max'])}",
            results.mean_std(row, "error"),
        ]
        for name, row in summary.items()
    ]
    return results.markdown(heads, rows)
