"""Error against the number of training samples.

The paper's decoder gets the same number of gradient steps for every number of samples, so that only the amount of data
differs. Both models learn from exact rays with noise in the corridor: the paper's decoder at one heading, the distance
field at random headings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from common.geometry.se2 import Array
from lab.accuracy import bound
from lab.accuracy.scenes import Scene
from lab.experiments import model_training as learning
from lab.experiments import results
from lab.experiments.estimators import PAPER_DESCENT, ExperimentWorld
from lab.experiments.trials import run_trials
from lab.paper.e1_localisation import CLOSE_DISTANCE
from presage.plotting import style as drawing
from services.estimator.paper.perception import Descent
from services.estimator.shared.interface import PoseEstimator

EXPERIMENT_ID = 4  # part of the random seeds
SIZES = (100, 500, 1000, 2000, 5000, 13_000)
ESTIMATORS = ("paper", "precise")
SHARED_SEED, LEARNING_SEED = 0, 1  # parts of the random seeds: of the common test data, of training data


@dataclass(frozen=True)
class SamplesJob:
    """One model, trained on a number of samples."""

    seed: int
    estimator: str = "paper"
    samples: int = SIZES[-1]
    steps: int = learning.GRADIENT_STEPS  # of the paper's decoder
    places: int = 50
    iterations: int = 50  # scans per place for the paper's estimator; precise gets one
    held_out: int = 1000  # noise-free test scans
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen
    descent: Descent = PAPER_DESCENT


def trial(job: SamplesJob) -> dict[str, Any]:
    """Trains a model. Returns the errors of its predicted ranges, and of the poses estimated with it."""
    training_scene = job.field.scene(
        job.seed, EXPERIMENT_ID, LEARNING_SEED, ESTIMATORS.index(job.estimator), job.samples
    )
    test_scene = job.field.scene(job.seed, EXPERIMENT_ID, SHARED_SEED)
    make: Callable[[], PoseEstimator]
    if job.estimator == "paper":
        decoder = learning.train_paper(training_scene, job.field.heading, job.samples, job.steps, job.seed)
        model, steps, seconds = decoder.model, learning.steps_of(decoder.card), decoder.card.training_s
        make, scans = (lambda: decoder.estimator(job.descent)), job.iterations
    else:
        field = learning.learn_precise(training_scene, job.samples)
        model, steps, seconds = field.model, None, field.learning_s  # type: ignore[assignment]
        make, scans = (lambda: field.estimator(test_scene)), 1
    held_out = learning.sample_scans(test_scene, job.held_out, job.field.heading, noise=False)
    ranges = learning.range_errors(model, test_scene, held_out)
    poses = test_scene.poses(job.places)
    poses[:, 2] = job.field.heading
    return {
        "estimator": job.estimator,
        "samples": job.samples,
        "gradient_steps": steps,
        "learning_s": seconds,
        "range_error_mean_m": float(np.nanmean(ranges)),
        "range_error_median_m": float(np.nanmedian(ranges)),
        "no_prediction_share": float(np.isnan(ranges).mean()),
        "position_error_m": [round(_position_error(make(), test_scene, pose, scans), 6) for pose in poses],
        "same_scan_everywhere_m": float(np.abs(held_out.ranges - np.median(held_out.ranges, axis=0)).mean()),
        "bound_median_m": bound.median_error(bound.single(test_scene, poses)),
    }


def _position_error(estimator: PoseEstimator, scene: Scene, pose: Array, scans: int) -> float:
    """Position error in m after ``scans`` scans of a robot that stands at ``pose`` (3,)."""
    clean = scene.clean(pose[None])[0]
    for k in range(scans):
        posterior = estimator.update(scene.observe(clean, k / scene.scanner.rate))
    return float(np.hypot(*(posterior.pose - pose)[:2]))


def summarise(row: dict[str, Any]) -> dict[str, Any]:
    """Statistics of one trial."""
    errors = np.array(row["position_error_m"])
    return {
        **{name: value for name, value in row.items() if name != "position_error_m"},
        "places": len(errors),
        "position_error_mean_m": float(errors.mean()),
        "position_error_median_m": float(np.median(errors)),
        "position_error_max_m": float(errors.max()),
        "found_within_0.2_m": int((errors < CLOSE_DISTANCE).sum()),
    }


def run(job: SamplesJob, out: Path, workers: int, console: Console, sizes: Sequence[int] = SIZES) -> results.Result:
    """Runs every estimator with every number of samples. Writes samples.json, .csv, .pdf and .png into ``out``."""
    jobs = [replace(job, estimator=name, samples=size) for name in ESTIMATORS for size in sizes]
    rows = run_trials("samples", trial, jobs, out, workers, console)
    summary = {f"{row['estimator']}, {row['samples']}": summarise(row) for row in rows}
    curves: dict[str, list[Any]] = {"samples": list(sizes)}
    for name in ESTIMATORS:
        for quantity in ("range_error_mean_m", "range_error_median_m", "position_error_median_m", "found_within_0.2_m"):
            curves[f"{name} {quantity}"] = [summary[f"{name}, {size}"][quantity] for size in sizes]
    nothing = [
        f"{name}: nothing was learned, one scan for everywhere is as good; another seed may do better"
        for name, row in summary.items()
        if row["range_error_mean_m"] > 0.9 * row["same_scan_everywhere_m"]
    ]
    reading = (
        f"paper: {job.steps} gradient steps (batches of {learning.BATCH_SIZE}) from any number of samples; 520 are 20 "
        'epochs of 13 000, our reading of its "20 batches of 500 samples"'
    )
    result = results.Result(
        "samples",
        "Error against the number of training samples",
        job.seed,
        asdict(job) | {"sizes": list(sizes)},
        summary,
        curves,
        rows,
        [
            reading,
            f"position: paper {job.iterations} scans from the map's centre, heading known; precise one, nothing known",
            *nothing,
        ],
    )
    result.write(out, draw(result))
    return result


def draw(result: results.Result) -> Figure:
    """Range error and position error over the number of samples."""
    figure, (left, right) = drawing.figure_of(2)
    curves, places = result.curves, result.parameters["places"]
    for name, mark in zip(ESTIMATORS, "os", strict=True):
        colour = drawing.COLOURS[name]
        for quantity, style in (("mean", "-"), ("median", "--")):
            errors = curves[f"{name} range_error_{quantity}_m"]
            left.plot(curves["samples"], errors, style + mark, color=colour, label=f"{name}, {quantity} range error")
        errors = curves[f"{name} position_error_median_m"]
        right.plot(curves["samples"], errors, "-" + mark, color=colour, label=_describe(name, result.parameters))
        offset = 10 if name == "paper" else -16  # points
        for size, error, count in zip(curves["samples"], errors, curves[f"{name} found_within_0.2_m"], strict=True):
            text = f"{count / places:.0%}"
            right.annotate(text, (size, error), (0, offset), textcoords="offset points", ha="center", fontsize=9)
    limit = next(iter(result.summary.values()))["bound_median_m"]
    right.axhline(limit, color=drawing.BOUND, linestyle=":", linewidth=1.4, label="Cramér-Rao bound of 1 scan, median")
    left.set(ylabel="range error (m)", title=f"expected ranges, {result.parameters['held_out']} held-out scans")
    right.set(ylabel="median position error (m)", title=f"position; numbers: share of places within {CLOSE_DISTANCE} m")
    for axes in (left, right):
        _decades(axes, curves["samples"])
        low, high = axes.get_ylim()
        axes.set_ylim(low / 2, high * 2)
    drawing.legend_below(figure, left, right)
    return figure


def _describe(name: str, parameters: dict[str, Any]) -> str:
    if name == "precise":
        return "precise, position: 1 scan, unknown start"
    return f"paper, position: {parameters['iterations']} scans from the centre"


def _decades(axes: Axes, sizes: Sequence[int]) -> None:
    """Makes both axes logarithmic, with the sizes as ticks."""
    drawing.log_metres(axes, "x")
    drawing.log_metres(axes)
    axes.set_xticks(list(sizes), [f"{size:,}".replace(",", " ") for size in sizes])
    axes.minorticks_off()
    axes.set_xlabel("training samples")


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    heads = (
        "estimator",
        "samples",
        "range error, median (m)",
        "learning (CPU s)",
        "position error, median (m)",
        "within 0.2 m",
    )
    rows = [
        [
            row["estimator"],
            str(row["samples"]),
            results.number(row["range_error_median_m"], 4),
            results.number(row["learning_s"], 0),
            results.number(row["position_error_median_m"], 4),
            f"{row['found_within_0.2_m']}/{row['places']}",
        ]
        for row in summary.values()
    ]
    return results.markdown(heads, rows)
