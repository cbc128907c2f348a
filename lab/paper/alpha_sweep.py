"""The step size α of perception."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from lab.experiments import results
from lab.experiments.trials import run_trials
from lab.paper import e1_localisation as localisation
from presage.plotting import style as drawing
from services.estimator.paper.perception import Descent

ALPHAS = (2e-4, 5e-4, 1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 1e-2, 2e-2)  # m²
STEPS_PER_SCAN = (1, 10)  # gradient steps a scan: the paper's, and the service's default


@dataclass(frozen=True)
class AlphaJob:
    """One place at one step size."""

    alpha: float
    steps: int
    place: localisation.LocalisationJob


def trial(job: AlphaJob) -> dict[str, Any]:
    """E1's trial with the job's step size."""
    descent = Descent(alpha=job.alpha, iterations=job.steps)
    return localisation.trial(replace(job.place, estimators=("paper",), descent=descent))


def run(
    job: localisation.LocalisationJob,
    trials: int,
    out: Path,
    workers: int,
    console: Console,
    alphas: tuple[float, ...] = ALPHAS,
) -> results.Result:
    """Runs all step sizes at the places of E1. Writes alpha.json, .csv, .pdf and .png into ``out``."""
    grid = [(steps, alpha) for steps in STEPS_PER_SCAN for alpha in alphas]
    jobs = [AlphaJob(alpha, steps, replace(job, index=k)) for steps, alpha in grid for k in range(trials)]
    rows = run_trials("alpha", trial, jobs, out, workers, console)
    summary: dict[str, dict[str, Any]] = {}
    for number, (steps, alpha) in enumerate(grid):
        own = rows[number * trials : (number + 1) * trials]
        statistics = localisation.summarise(own, "paper")
        summary[f"{alpha:g} m², {steps} a scan"] = {"alpha_m2": alpha, "steps_a_scan": steps, **statistics}
    columns = ("alpha_m2", "steps_a_scan", "final_error_mean_m", "final_error_median_m", "found_within_0.2_m")
    curves = {name: [row[name] for row in summary.values()] for name in columns}
    parameters = {"alphas": alphas, "steps": STEPS_PER_SCAN, "trials": trials, "e1": asdict(job)}
    result = results.Result(
        "alpha",
        "Step size of the paper's perception",
        job.seed,
        parameters,
        summary,
        curves,
        notes=[f"best with {each} a scan: {best(summary, each):g} m² (most within 0.2 m)" for each in STEPS_PER_SCAN],
    )
    result.write(out, draw(summary, trials))
    return result


def best(summary: dict[str, dict[str, Any]], steps: int) -> float:
    """The step size with the most places within 0.2 m; among equals the one with the smaller median error."""
    own = [row for row in summary.values() if row["steps_a_scan"] == steps]
    return float(max(own, key=lambda r: (r["found_within_0.2_m"], -r["final_error_median_m"]))["alpha_m2"])


def draw(summary: dict[str, dict[str, Any]], trials: int) -> Figure:
    """Share of places found, and median error, over alpha."""
    figure, (share, error) = drawing.figure_of(2, height=3.6)
    for steps, colour, mark in zip(
        STEPS_PER_SCAN, (drawing.COLOURS["paper"], drawing.COLOURS["precise"]), "os", strict=True
    ):
        own = [row for row in summary.values() if row["steps_a_scan"] == steps]
        alphas = [row["alpha_m2"] for row in own]
        for limit, style in (("0.5", "--"), ("0.2", "-")):
            shares = [row[f"found_within_{limit}_m"] / trials for row in own]
            label = f"within {limit} m, {steps} step{'s' if steps > 1 else ''} a scan"
            share.plot(alphas, shares, style + mark, color=colour, label=label)
        medians = [row["final_error_median_m"] for row in own]
        error.plot(alphas, medians, "-" + mark, color=colour, label=f"{steps} step{'s' if steps > 1 else ''} a scan")
    share.set(ylabel="share of places", ylim=(0, 1.02), title="places found after 50 scans")
    drawing.log_metres(error)
    error.set(ylabel="position error (m)", title="median error after 50 scans")
    for axes in (share, error):
        drawing.log_metres(axes, "x")
        axes.set(xlabel="step size α (m²)")
        axes.set_xticks([float(a) for a in np.unique([row["alpha_m2"] for row in summary.values()])][::2])
        axes.legend(fontsize=8.5, frameon=False)
    return figure


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    by_setting = {(row["alpha_m2"], row["steps_a_scan"]): row for row in summary.values()}
    sizes, steps = (list(dict.fromkeys(setting)) for setting in zip(*by_setting, strict=True))
    heads = ("α (m²)", *(f"{n} step{'s' if n > 1 else ''} per scan: within 0.2 m; median (m)" for n in steps))
    rows = [
        [
            f"{size:g}",
            *(
                f"{row['found_within_0.2_m']}/{row['trials']}; {results.number(row['final_error_median_m'])}"
                for row in (by_setting[size, n] for n in steps)
            ),
        ]
        for size in sizes
    ]
    return results.markdown(heads, rows)
