"""Similar objects.

Three worlds: the corridor with its four different objects, for comparison; the same hall with four equal, evenly spaced
boxes; and two identical rooms, at places where the scans of both rooms are the same.
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
from common.geometry.world import World, load_world
from lab.accuracy.scenes import ROBOT, TWIN_OFFSET, TWINS, Scene, alike, twin_of
from lab.experiments import model_training as learning
from lab.experiments import results
from lab.experiments.estimators import PAPER_DESCENT
from lab.experiments.trials import run_trials
from lab.paper.e1_localisation import CLOSE_DISTANCE, FOUND_DISTANCE
from presage.plotting import style as drawing
from services.estimator.paper.perception import Descent
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.shared.interface import PoseEstimator, Posterior

EXPERIMENT_ID = 5  # part of the random seeds
PLACES_SEED, LEARNING_SEED, SCANS_SEED = 0, 1, 2  # parts of the random seeds
HEADING = float(np.pi / 2)  # rad, of all places; only the paper's estimator knows it
ALIKE = World(
    name="alike",
    boundary=[(0, 0), (18, 0), (18, 4.5), (0, 4.5)],
    obstacles=[{"box": {"center": (x, 3.9), "size": (0.7, 0.7)}} for x in (3.6, 7.2, 10.8, 14.4)],
)
TITLES = {
    "corridor": "corridor: four different objects",
    "alike": "alike: four equal boxes",
    "twins": "twins: two rooms alike",
}
ESTIMATORS = ("paper", "precise", "particle-filter")
MOMENTS = (1, 10, 50)  # numbers of scans after which the results are evaluated


@dataclass(frozen=True)
class AliasingJob:
    """One estimator in one world, at all places."""

    seed: int
    world: str = "alike"
    estimator: str = "paper"
    places: int = 50
    iterations: int = 50
    beams: int = 622
    samples: int = 13_000  # training scans of the paper's decoder
    steps: int = learning.GRADIENT_STEPS
    scans: int = 2000  # training scans of the distance field
    descent: Descent = PAPER_DESCENT


def world_of(name: str) -> World:
    """One of the experiment's worlds, by name."""
    return {"alike": ALIKE, "twins": TWINS}.get(name) or load_world(name)


def scene_of(job: AliasingJob, *seed: int) -> Scene:
    """The job's world with random numbers that do not depend on the estimator."""
    return Scene.of(world_of(job.world), job.beams, (job.seed, EXPERIMENT_ID, list(TITLES).index(job.world), *seed))


def sample_places(scene: Scene, count: int) -> Array:
    """Random poses (count, 3) with `HEADING`.

    In the world of two rooms only poses whose scan is the same in the other room.
    """
    if scene.world.name != TWINS.name:
        poses = scene.poses(count)
        poses[:, 2] = HEADING
        return poses
    accepted: list[Array] = []
    while sum(map(len, accepted)) < count:
        poses = np.column_stack([scene.rng.uniform([0, 0], [TWIN_OFFSET, 4.0], (500, 2)), np.full(500, HEADING)])
        poses = poses[scene.world.clearance(poses[:, :2]) > ROBOT.radius]
        accepted.append(poses[alike(scene, poses)])
    poses = np.concatenate(accepted)[:count]
    poses[:, 0] += TWIN_OFFSET * scene.rng.integers(2, size=count)
    return np.asarray(poses)


def trial(job: AliasingJob) -> dict[str, Any]:
    """Trains the job's estimator, then runs it at each place."""
    make = _estimator_factory(job)
    rows = []
    for number, pose in enumerate(sample_places(scene_of(job, PLACES_SEED), job.places)):
        scene = scene_of(job, SCANS_SEED, number)
        clean = scene.clean(pose[None])[0]
        estimator = make(number)
        posteriors = [estimator.update(scene.observe(clean, k / scene.scanner.rate)) for k in range(job.iterations)]
        rows.append(_row(pose, posteriors, twins=job.world == TWINS.name))
    return {"world": job.world, "estimator": job.estimator, "places": rows}


def _estimator_factory(job: AliasingJob) -> Callable[[int], PoseEstimator]:
    """Trains the model. Returns a function that makes a new estimator, without start pose, for a place's number."""
    scene = scene_of(job, LEARNING_SEED, ESTIMATORS.index(job.estimator))
    if job.estimator == "paper":
        decoder = learning.train_paper(scene, HEADING, job.samples, job.steps, job.seed)
        return lambda _: decoder.estimator(job.descent)
    if job.estimator == "precise":
        field = learning.learn_precise(scene, job.scans)
        return lambda _: field.estimator(scene)
    settings, mount = ParticleFilterSettings.tuned(), scene.scanner.mount
    return lambda number: ParticleFilter(scene.world, settings, mount, job.seed * 100_003 + number)


def _row(pose: Array, posteriors: Sequence[Posterior], *, twins: bool) -> dict[str, Any]:
    """Results at one place: the error, and whether the state was wrongly `tracking`, after every scan.

    With ``twins`` also whether the last belief contains both of the two indistinguishable places.
    """
    errors = [round(float(np.hypot(*(p.pose - pose)[:2])), 6) for p in posteriors]
    wrong = [int(p.state == "tracking" and error > FOUND_DISTANCE) for p, error in zip(posteriors, errors, strict=True)]
    last = posteriors[-1]
    statistics = {
        "pose": pose.tolist(),
        "believed": last.pose.tolist(),
        "error_m": errors,
        "wrong": wrong,
        "claim": last.state,
    }
    if not twins:
        return statistics
    twin = twin_of(pose)
    near = [any(np.hypot(*(h.pose - place)[:2]) < CLOSE_DISTANCE for h in last.hypotheses) for place in (pose, twin)]
    either = min(errors[-1], float(np.hypot(*(last.pose - twin)[:2])))
    return {**statistics, "both_kept": int(last.state == "ambiguous" and all(near)), "either_error_m": round(either, 6)}


def summarise(row: dict[str, Any]) -> dict[str, Any]:
    """Statistics of one estimator in one world."""
    places = row["places"]
    errors, wrong = (np.array([place[name] for place in places]) for name in ("error_m", "wrong"))
    moments = [k for k in MOMENTS if k <= errors.shape[1]]
    statistics: dict[str, Any] = {"world": row["world"], "estimator": row["estimator"], "places": len(places)}
    statistics |= {f"within_0.2_m_after_{k}": int((errors[:, k - 1] < CLOSE_DISTANCE).sum()) for k in moments}
    statistics |= {f"tracking_but_wrong_after_{k}": int(wrong[:, k - 1].sum()) for k in moments}
    statistics |= {
        "tracking_but_wrong_ever": int(wrong.any(axis=1).sum()),
        "final_error_median_m": float(np.median(errors[:, -1])),
        "final_error_mean_m": float(errors[:, -1].mean()),
        "claims": {claim: sum(p["claim"] == claim for p in places) for claim in sorted({p["claim"] for p in places})},
    }
    if "both_kept" in places[0]:
        either = np.array([place["either_error_m"] for place in places])
        statistics["both_kept"] = sum(place["both_kept"] for place in places)
        statistics["at_either_within_0.2_m"] = int((either < CLOSE_DISTANCE).sum())
    return statistics


def _moments(statistics: dict[str, Any]) -> list[int]:
    """The numbers of scans after which these statistics of one estimator were evaluated."""
    return [k for k in MOMENTS if f"within_0.2_m_after_{k}" in statistics]


def run(
    job: AliasingJob, out: Path, workers: int, console: Console, worlds: Sequence[str] = tuple(TITLES)
) -> results.Result:
    """Runs every estimator in every world. Writes aliasing.json, .csv, .pdf and .png into ``out``."""
    # The longest jobs first: the training of the paper's decoders.
    jobs = [replace(job, world=world, estimator=name) for name in ESTIMATORS for world in worlds]
    rows = run_trials("aliasing", trial, jobs, out, workers, console)
    rows = [row for world in worlds for row in rows if row["world"] == world]
    curves: dict[str, list[Any]] = {"iteration": list(range(1, job.iterations + 1))}
    for row in rows:
        errors = np.array([place["error_m"] for place in row["places"]])
        key = f"{row['world']}, {row['estimator']}"
        curves[f"{key} median m"] = np.median(errors, axis=0).tolist()
        curves[f"{key} share within 0.2 m"] = (errors < CLOSE_DISTANCE).mean(axis=0).tolist()
    summary = {f"{row['world']}, {row['estimator']}": summarise(row) for row in rows}
    result = results.Result(
        "aliasing",
        "Similar objects",
        job.seed,
        asdict(job) | {"worlds": list(worlds)},
        summary,
        curves,
        rows,
        ["twins: only places whose scans are the same in both rooms, so that an estimator can only guess the room"],
    )
    result.write(out, draw(rows, summary))
    return result


def draw(rows: Sequence[dict[str, Any]], summary: dict[str, dict[str, Any]]) -> Figure:
    """One row per world: a map with the final beliefs of the paper's estimator, and bars with shares of places."""
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    figure = drawing.empty_figure(14, 3.5 * len(worlds))
    panels = figure.subplots(len(worlds), 2, squeeze=False, width_ratios=(1.15, 1))
    for name, (left, right) in zip(worlds, panels, strict=True):
        own = {row["estimator"]: row for row in rows if row["world"] == name}
        _map(left, world_of(name), own["paper"]["places"])
        left.set_title(TITLES[name])
        _bars(drawing.style_axes(right), {each: summary[f"{name}, {each}"] for each in own})
    panels[0][1].set_title(f"belief within {CLOSE_DISTANCE} m of the truth | claims at the end")
    drawing.legend_below(figure, *panels[0])
    return figure


def _map(axes: Axes, world: World, places: Sequence[dict[str, Any]]) -> None:
    """Draws the world, the true places, and lines to the final beliefs that are wrong."""
    drawing.world_map(axes, world)
    true, believed = (np.array([place[key] for place in places])[:, :2] for key in ("pose", "believed"))
    is_wrong = np.hypot(*(believed - true).T) > FOUND_DISTANCE
    for a, b in zip(true[is_wrong], believed[is_wrong], strict=True):
        axes.plot(*np.array([a, b]).T, color=drawing.COLOURS["paper"], linewidth=1)
    axes.plot(*true.T, ".", color="#222222", markersize=5, label="true place")
    axes.plot(
        *believed[is_wrong].T, "x", color=drawing.COLOURS["paper"], markersize=6, label="paper's belief, > 0.5 m off"
    )
    x0, y0, x1, y1 = world.bounds
    axes.set(xticks=np.arange(x0, x1 + 1, 3), yticks=[y0, y1])
    axes.spines[:].set_visible(False)


def _bars(axes: Axes, summary: dict[str, dict[str, Any]]) -> None:
    """Draws bars of the shares of places, in groups of one bar per estimator."""
    one = next(iter(summary.values()))
    moments = _moments(one)
    groups = [(f"after {k}\nscan{'s' * (k != 1)}", f"within_0.2_m_after_{k}") for k in moments]
    good = len(groups)
    groups.append((f"`tracking`, but\n> {FOUND_DISTANCE} m off", f"tracking_but_wrong_after_{moments[-1]}"))
    if "both_kept" in one:
        groups.append(("both places\nkept", "both_kept"))
    positions, width = np.arange(len(groups)) + 0.35 * (np.arange(len(groups)) >= good), 0.8 / len(summary)
    for number, (name, row) in enumerate(summary.items()):
        shares = [row[quantity] / row["places"] for _, quantity in groups]
        x = positions + (number - (len(summary) - 1) / 2) * width
        bars = axes.bar(x, shares, 0.92 * width, color=drawing.COLOURS[name], label=name)
        axes.bar_label(bars, [f"{row[quantity]}" for _, quantity in groups], fontsize=9, padding=1)
    axes.set_xticks(positions, [label for label, _ in groups])
    axes.grid(visible=False, axis="x")
    axes.axvline(good - 0.5 + 0.17, color="#AAAAAA", linewidth=0.8)
    if "both_kept" in one:
        edges = (-0.45, good - 0.55)
        axes.plot(edges, (0.5, 0.5), "--", color=drawing.BOUND, linewidth=1)
        axes.text(edges[0], 0.52, "chance: one room in two", fontsize=9, color=drawing.BOUND)
    axes.set(ylim=(0, 1.12), ylabel="share of places")


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    moments = _moments(next(iter(summary.values())))
    scans = "; ".join(map(str, moments))
    heads = (
        "world",
        "estimator",
        f"within 0.2 m after {scans} scans",
        "median error (m)",
        "wrong `tracking`, at the end; ever",
        "both places kept",
    )
    rows = []
    for row in summary.values():
        wrong = row[f"tracking_but_wrong_after_{moments[-1]}"]
        rows.append(
            [
                row["world"],
                row["estimator"],
                "; ".join(f"{row[f'within_0.2_m_after_{k}']}/{row['places']}" for k in moments),
                results.number(row["final_error_median_m"], 4),
                f"{wrong}; {row['tracking_but_wrong_ever']}",
                f"{row['both_kept']}/{row['places']}" if "both_kept" in row else "",
            ]
        )
    return results.markdown(heads, rows)
