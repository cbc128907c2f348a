"""Predicted against measured scans.

Uses the shipped weights. The paper's decoder predicts no precision, and the paper does not state Σ_o: here it is 1 m².
The distance field predicts each beam's model error m; with the scanner's noise σ the deviation is (σ² + m²)^½.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from common.geometry import se2
from common.geometry.se2 import Array
from lab.accuracy.scenes import ROBOT, Scene
from lab.experiments import results
from lab.experiments.estimators import ExperimentWorld
from lab.experiments.trials import run_trials
from presage.plotting import style as drawing
from services.estimator.paper import weights as paper_weights
from services.estimator.paper.decoder import use_one_core
from services.estimator.paper.training import usable_ranges
from services.estimator.precise.learning import weights as precise_weights
from services.estimator.shared.model_folder import SHIPPED

EXPERIMENT_ID = 6  # part of the random seeds
SAMPLE_SEED, TEST_SEED = 0, 1  # parts of the random seeds
PAPER_SIGMA = 1.0  # m, of every beam in preset `paper`
SIGMA_FACTORS = tuple(np.round(np.arange(0.25, 4.01, 0.25), 2).tolist())  # multiples of the predicted deviation
GAUSSIAN = {1: 0.6827, 2: 0.9545, 3: 0.9973}  # share of a Gaussian within k deviations
# A beam counts as imprecise (`unsure` in the results) if its deviation exceeds the scanner's noise by this factor, that
# is if the deviation τ of the learned field is larger than the noise σ.
IMPRECISE_FACTOR = float(np.sqrt(2))
FRONT_MARGIN = 0.3  # m between the sample's robot and the line of the objects
FAR_RESIDUAL = 0.1  # m; larger residuals are counted in the figure
ESTIMATORS = ("paper", "precise")


@dataclass(frozen=True)
class PredictionJob:
    """One sample scan for the figure, and ``scans`` test scans."""

    seed: int
    scans: int = 500
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen


def trial(job: PredictionJob) -> dict[str, Any]:
    """The sample scan as measured and predicted; shares of test beams within multiples of the predicted deviation."""
    use_one_core()
    sample, test = (job.field.scene(job.seed, EXPERIMENT_ID, part) for part in (SAMPLE_SEED, TEST_SEED))
    pose = in_front(job.field, sample)
    noisy = sample.observe(sample.clean(pose[None])[0], 0.0).ranges
    outcome: dict[str, Any] = {
        "pose": pose.tolist(),
        "angle_rad": sample.scanner.angles().tolist(),
        "measured_m": noisy.tolist(),
        "models": {},
    }
    poses = test.poses(job.scans)
    clean = test.clean(poses)
    for name in ESTIMATORS:
        test_poses = poses.copy()
        if name == "paper":  # trained for one heading only
            test_poses[:, 2] = job.field.heading
        ranges = test.clean(test_poses) if name == "paper" else clean
        ranges = ranges + test.scanner.sigma * test.rng.standard_normal(ranges.shape)
        expected, sigma = _expected(name, job.field, test, test_poses)
        error = np.abs(usable_ranges(test.scanner.limit(ranges), test.scanner.range_max) - expected)
        unsure = sigma > IMPRECISE_FACTOR * test.scanner.sigma
        one, deviation = _expected(name, job.field, sample, pose[None])
        outcome["models"][name] = {
            "expected_m": one[0].tolist(),
            "sigma_m": deviation[0].tolist(),
            "beams": error.size,
            "within": _shares(error, sigma),
            "unsure_share": float(unsure.mean()),
            "unsure_within": _shares(error[unsure], sigma[unsure]),
            "unsure_within_noise_alone": _shares(error[unsure], np.full(unsure.sum(), test.scanner.sigma)),
            "range_error_median_m": float(np.median(error)),
            "range_error_mean_m": float(error.mean()),
            "stated_sigma_median_m": float(np.median(sigma)),
            "stated_sigma_p99_m": float(np.quantile(sigma, 0.99)),
        }
    return outcome


def _shares(error: Array, sigma: Array) -> dict[str, float]:
    """Shares of the absolute errors within each of `SIGMA_FACTORS` deviations; empty if there are no errors."""
    return {f"{k:g}": float((error <= k * sigma).mean()) for k in SIGMA_FACTORS} if error.size else {}


def in_front(field: ExperimentWorld, scene: Scene) -> Array:
    """Random pose (3,) between the bare wall and the objects; anywhere if the world has no objects."""
    places = scene.world.sample_free(1000, scene.rng, ROBOT.radius)
    front = places[places[:, 1] < field.front() - FRONT_MARGIN]
    return np.array([*(front if len(front) else places)[0], field.heading])


def _expected(name: str, field: ExperimentWorld, scene: Scene, poses: Array) -> tuple[Array, Array]:
    """Ranges (N, B), m, predicted with the shipped weights, and the predicted deviations of the measurements, m."""
    if name == "paper":
        path = paper_weights.find(SHIPPED, scene.world.name, scene.scanner.beams)
        ranges = paper_weights.load(path)[0].ranges(poses)
        return ranges, np.full(ranges.shape, PAPER_SIGMA)
    model = precise_weights.load(precise_weights.find(SHIPPED, scene.world, field.world))[0]
    expected = model.expect(se2.compose(poses, np.array(scene.scanner.mount)), scene.scanner.angles())
    ranges = usable_ranges(expected.ranges, scene.scanner.range_max)
    return ranges, np.sqrt(expected.scale**2 + scene.scanner.sigma**2)


def run(job: PredictionJob, out: Path, workers: int, console: Console) -> results.Result:
    """Runs the experiment. Writes prediction.json, .csv, .pdf and .png into ``out``."""
    rows = run_trials("prediction", trial, [job], out, workers, console)
    row = rows[0]
    summary: dict[str, dict[str, Any]] = {}
    for name, model_row in row["models"].items():
        quantities = {key: value for key, value in model_row.items() if np.isscalar(value)}
        kinds = [kind for kind, value in model_row.items() if isinstance(value, dict) and value]
        shares = {f"{kind}_{k}_sigma": model_row[kind][str(k)] for kind in kinds for k in GAUSSIAN}
        summary[name] = {"scans": job.scans, **quantities, **shares}
    curves = {"angle_rad": row["angle_rad"], "measured_m": row["measured_m"]}
    for name, model_row in row["models"].items():
        curves |= {f"{name} expected m": model_row["expected_m"], f"{name} sigma m": model_row["sigma_m"]}
    x, y, yaw = row["pose"]
    result = results.Result(
        "prediction",
        "Predicted against measured scan",
        job.seed,
        asdict(job),
        summary,
        curves,
        rows,
        [
            f"sample: seed {job.seed}, robot at ({x:.2f}, {y:.2f}) m, heading {np.rad2deg(yaw):.0f}°; drawn at random",
            f"the paper predicts no precision, and does not state Σ_o: here it is {PAPER_SIGMA:g} m² for every beam",
        ],
    )
    result.write(out, draw(result))
    return result


def draw(result: results.Result) -> Figure:
    """The sample scan with both models' predictions, residuals below, and calibration on the right."""
    row = result.trials[0]
    figure = drawing.empty_figure(16, 6.2)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.9, 1), width_ratios=(1, 1, 0.8))
    tops = [drawing.style_axes(figure.add_subplot(grid[0, k])) for k in range(2)]
    bottoms = [drawing.style_axes(figure.add_subplot(grid[1, k], sharex=tops[k])) for k in range(2)]
    angle, measured = np.rad2deg(row["angle_rad"]), np.array(row["measured_m"])
    titles = {"paper": "paper: no predicted precision (Σ_o = 1)", "precise": "precise: predicted ± 2σ of every beam"}
    for name, top, bottom in zip(ESTIMATORS, tops, bottoms, strict=True):
        model_row = row["models"][name]
        expected, sigma = np.array(model_row["expected_m"]), np.array(model_row["sigma_m"])
        top.plot(angle, measured, ".", color=drawing.MEASURED, markersize=3.5, label="measured")
        top.plot(angle, expected, "-", color=drawing.PREDICTED, linewidth=1.1, label="expected")
        bottom.plot(angle, measured - expected, ".", color=drawing.MEASURED, markersize=3.5)
        if name == "precise":
            _band(top, angle, expected, sigma)
            _band(bottom, angle, np.zeros_like(expected), sigma)
        share = float((np.abs(measured - expected) > FAR_RESIDUAL).mean())
        bottom.text(
            0.99, 0.97, f"{share:.1%} of beams > {FAR_RESIDUAL} m off", transform=bottom.transAxes, ha="right", va="top"
        )
        bottom.axhline(0, color=drawing.PREDICTED, linewidth=1)
        bottom.set_yscale("symlog", linthresh=0.1, linscale=1.5)
        limit = 4 * max(1.0, *(np.abs(measured - np.array(m["expected_m"])).max() for m in row["models"].values()))
        bottom.set(xlabel="beam (°)", ylim=(-limit, limit), xticks=range(-135, 136, 45))
        bottom.set_yticks([-1, -0.1, 0, 0.1, 1], ["−1", "−0.1", "0", "0.1", "1"])
        top.set(title=titles[name], ylim=(0, None))
        top.tick_params(labelbottom=False)
    tops[0].set_ylabel("range (m)")
    bottoms[0].set_ylabel("measured − expected (m)")
    tops[1].sharey(tops[0])
    tops[1].legend(fontsize=9, frameon=False, loc="upper right")
    _calibration(
        drawing.style_axes(figure.add_subplot(grid[:, 2])), row["models"]["precise"], result.parameters["scans"]
    )
    figure.suptitle("; ".join(result.notes[:1]), fontsize=10)
    return figure


def _band(axes: Axes, angle: Array, middle: Array, sigma: Array) -> None:
    axes.fill_between(
        angle,
        middle - 2 * sigma,
        middle + 2 * sigma,
        color=drawing.PREDICTED,
        alpha=0.25,
        linewidth=0,
        label="predicted ± 2σ",
    )


def _calibration(axes: Axes, model_row: dict[str, Any], scans: int) -> None:
    """Plots the share of beams within k predicted deviations, and that of a Gaussian."""
    factors = np.array(SIGMA_FACTORS)
    axes.plot(factors, _gaussian(factors), "-", color=drawing.BOUND, label="Gaussian: perfect calibration")
    unsure = f"{model_row['unsure_share']:.1%} of beams: τ > σ"
    for key, colour, mark, label in (
        ("within", drawing.COLOURS["precise"], "o", "all beams, predicted √(σ² + τ²)"),
        ("unsure_within", drawing.GOAL, "^", f"{unsure}, predicted √(σ² + τ²)"),
        ("unsure_within_noise_alone", drawing.COLOURS["particle-filter"], "s", f"{unsure}, σ alone"),
    ):
        if model_row[key]:
            axes.plot(
                factors, [model_row[key][f"{k:g}"] for k in factors], mark, color=colour, markersize=5, label=label
            )
    text = "\n".join(f"± {k}σ: {model_row['within'][str(k)]:.1%}  ({share:.1%})" for k, share in GAUSSIAN.items())
    axes.text(0.98, 0.3, "all beams (Gaussian)\n" + text, transform=axes.transAxes, ha="right", fontsize=10)
    axes.set(xlabel="deviations k", ylabel="share of beams within ± kσ", ylim=(0, 1.03))
    axes.set_title(f"precise: calibration on {scans} test scans")
    axes.legend(fontsize=9, frameon=False, loc="lower right")


def _gaussian(factors: Array | Sequence[float]) -> Array:
    return np.array([math.erf(k / math.sqrt(2)) for k in factors])


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    intervals = (f"within ±{k}σ" for k in GAUSSIAN)
    heads = ("", "range error, median (m)", "mean (m)", "predicted σ, median (m)", *intervals)
    rows = [
        [
            f"{name}",
            *(results.number(row[f"range_error_{which}_m"], 4) for which in ("median", "mean")),
            results.number(row["stated_sigma_median_m"], 4) + (" (Σ_o = 1)" if name == "paper" else ""),
            *(f"{row[f'within_{k}_sigma']:.1%}" for k in GAUSSIAN),
        ]
        for name, row in summary.items()
    ]
    for name, row in summary.items():
        if 0 < row["unsure_share"] < 1:
            shares = (f"{row[f'unsure_within_{k}_sigma']:.1%}" for k in GAUSSIAN)
            rows.append([f"{name}, {row['unsure_share']:.1%} of beams with τ > σ", "", "", "", *shares])
    rows.append(["Gaussian", "", "", "", *(f"{share:.1%}" for share in GAUSSIAN.values())])
    return results.markdown(heads, rows)
