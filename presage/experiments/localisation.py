"""E1, the paper's first experiment: a robot stands somewhere; error of the belief against iterations (its figure 3).

100 trials of 50 iterations at places uniform over free space; those in front of the objects, the paper's unobstructed
middle, are told apart. An iteration is one scan with fresh noise, and one gradient step of preset paper. Its belief
begins at the map's centre, the particle filter's particles anywhere in free space; nobody has odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from presage.accuracy import bound
from presage.experiments import drawing, results
from presage.experiments.contestants import PAPER, STEPS, Field, enter
from presage.experiments.trials import run_trials
from services.estimator.perception import Descent

NUMBER = 1  # of the experiment, in its seeds
ESTIMATORS = (
    "paper",
    f"paper, {STEPS}",
    "precise",
    "particle-filter",
    "particle-filter, heading known",
    "amcl-defaults",
)
FOUND = 0.5  # m
CLOSE = 0.2  # m


@dataclass(frozen=True)
class Job:
    """One trial: one place, the same scans to everybody."""

    index: int
    seed: int
    iterations: int
    estimators: tuple[str, ...] = ESTIMATORS
    field: Field = Field()  # noqa: RUF009 - frozen
    descent: Descent = PAPER


def trial(job: Job) -> dict[str, Any]:
    """Errors in m after each iteration, and what was claimed at the end, by estimator; the bound beside them."""
    scene = job.field.scene(job.seed, NUMBER, job.index)
    pose = scene.poses(1)[0]
    pose[2] = job.field.heading
    clean = scene.clean(pose[None])[0]
    scans = [scene.observe(clean, k / scene.scanner.rate) for k in range(job.iterations)]
    one_scan = float(bound.position(bound.single(scene, pose[None]))[0])
    found: dict[str, Any] = {
        "pose": pose.tolist(), "in_front": bool(pose[1] < job.field.front()), "bound_m": one_scan,
        "error_m": {}, "claim": {},
    }  # fmt: skip
    for name in job.estimators:
        estimator = enter(name, job.field, scene, job.seed * 100_003 + job.index, job.descent)
        posteriors = [estimator.update(scan) for scan in scans]
        found["error_m"][name] = [round(float(np.hypot(*(p.pose - pose)[:2])), 6) for p in posteriors]
        found["claim"][name] = posteriors[-1].state
    return found


def summarise(trials: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Numbers of one estimator over all trials."""
    errors = np.array([each["error_m"][name] for each in trials])
    last, claims = errors[:, -1], [each["claim"][name] == "tracking" for each in trials]
    front = np.array([each["in_front"] for each in trials], bool)
    # Iterations until it is close and stays so; those that never are have none.
    far = errors >= CLOSE
    until = np.array([np.inf if row[-1] else (np.flatnonzero(row)[-1] + 2 if row.any() else 1) for row in far])
    return {
        "trials": len(trials),
        "final_error_mean_m": float(last.mean()),
        "final_error_std_m": float(last.std()),
        "final_error_median_m": float(np.median(last)),
        "final_error_max_m": float(last.max()),
        "found_within_0.5_m": int((last < FOUND).sum()),
        "found_within_0.2_m": int((last < CLOSE).sum()),
        "first_scan_error_median_m": float(np.median(errors[:, 0])),
        "iterations_to_0.2_m_median": float(np.median(until)) if np.isfinite(np.median(until)) else None,
        "places_in_front": int(front.sum()),
        "in_front_within_0.5_m": int((last[front] < FOUND).sum()),
        "in_front_error_mean_m": float(last[front].mean()) if front.any() else None,
        "in_front_error_std_m": float(last[front].std()) if front.any() else None,
        "in_front_error_median_m": float(np.median(last[front])) if front.any() else None,
        "claimed_tracking": int(np.sum(claims)),
        "claimed_tracking_but_wrong": int(np.sum(np.array(claims) & (last >= FOUND))),
    }


def run(job: Job, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """All trials; writes e1.json, .csv, .pdf and .png into ``out``."""
    jobs = [replace(job, index=index) for index in range(trials)]
    rows = run_trials("e1", trial, jobs, out, workers, console)
    curves: dict[str, list[Any]] = {"iteration": list(range(1, job.iterations + 1))}
    curves |= results.curves_of(rows, job.estimators)
    curves["bound m"] = _bound(rows, job.iterations)
    parameters = asdict(job) | {"trials": trials, "bound_end_m": curves["bound m"][-1]}
    result = results.Result(
        "e1", "E1: a standing robot localised", job.seed, parameters,
        {name: summarise(rows, name) for name in job.estimators}, curves, rows,
    )  # fmt: skip
    result.write(out, draw(rows, job.estimators, result.curves))
    return result


def _bound(rows: Sequence[dict[str, Any]], iterations: int) -> list[float]:
    """Root mean square over places of the Cramér-Rao bound of so many scans, m; heading unknown."""
    one = float(np.sqrt(np.mean(np.square([row["bound_m"] for row in rows]))))
    return [one / float(np.sqrt(k)) for k in range(1, iterations + 1)]


def draw(rows: Sequence[dict[str, Any]], names: Sequence[str], curves: dict[str, list[Any]]) -> Figure:
    """Error against iteration, as in the paper's figure 3; beside it on a logarithmic axis, where all can be seen."""
    figure, panels = drawing.figure_of(2)
    for axes in panels:
        for name in names:
            drawing.band(axes, curves["iteration"], [row["error_m"][name] for row in rows], name)
        axes.set(xlabel="iteration (one scan)", ylabel="position error (m)", xlim=(1, curves["iteration"][-1]))
    panels[1].plot(curves["iteration"], curves["bound m"], "--", color=drawing.BOUND, label="Cramér-Rao bound")
    panels[0].set(ylim=(0, None), title="mean ± standard deviation, as the paper draws it")
    drawing.log_metres(panels[1])
    panels[1].set(title="the same, logarithmic")
    drawing.legend_below(figure, *panels)
    return figure


def table(summary: dict[str, dict[str, Any]]) -> str:
    """As docs/experiments.md has it."""
    heads = (
        "estimator", "error at the end, mean ± std (m)", "median (m)", "within 0.5 m", "in front of the objects",
        "error there (m)", "iterations to 0.2 m", "claims to know; wrongly",
    )  # fmt: skip
    rows = [
        [
            name, results.mean_std(row, "final_error", 4), results.number(row["final_error_median_m"], 4),
            f"{row['found_within_0.5_m']} of {row['trials']}",
            f"{row['in_front_within_0.5_m']} of {row['places_in_front']}", results.mean_std(row, "in_front_error", 4),
            results.number(row["iterations_to_0.2_m_median"], 0),
            f"{row['claimed_tracking']}; {row['claimed_tracking_but_wrong']}",
        ]
        for name, row in summary.items()
    ]  # fmt: skip
    return results.markdown(heads, rows)
