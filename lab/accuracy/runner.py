"""Runs every estimator through every task."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World, load_world
from common.robot.scanner import Scanner
from common.versions import commit, versions
from lab.accuracy import tasks
from lab.accuracy.scenes import TWINS, Scene
from lab.workers import pool
from services.estimator.factory import EstimatorOptions, Geometry, Name, prepare
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.settings import Settings as ParticleSettings
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import SEED_SPACING_M, Seeds, thin_places
from services.estimator.precise.learning.field_learning import Recipe, learn_field, learn_scales, measure_ripple
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Estimator

# Estimator and generative model by the name that users give; "exact" casts rays in the world itself.
ESTIMATORS: dict[str, tuple[Name, str]] = {
    "precise": ("precise", "learned"),
    "precise-exact": ("precise", "exact"),
    "particle-filter": ("particle-filter", "learned"),
    "amcl-defaults": ("amcl-defaults", "learned"),
}
DEGREES_OF_FREEDOM = 3
TASKS = ("standing", "blocked", "kidnapped", "tracking", "odometry", "twins")


@dataclass(frozen=True)
class AccuracyJob:
    """One estimator in one world with one scanner."""

    estimator: str
    world: str
    scanner: Scanner
    trials: int
    seconds: float
    seed: int
    tasks: tuple[str, ...] = TASKS


def run_all(jobs: list[AccuracyJob], workers: int, console: Console) -> list[dict[str, Any]]:
    """Rows of all jobs, in the order of the jobs; shows a progress bar."""
    if workers == 1:
        return [row for job in track(jobs, "measuring", console=console, transient=True) for row in run(job)]
    with pool(workers) as executor:
        done = track(executor.map(run, jobs), "measuring", total=len(jobs), console=console, transient=True)
        return [row for rows in done for row in rows]


def run(job: AccuracyJob) -> list[dict[str, Any]]:
    """Runs the job's tasks. Returns one row for each result."""
    world = load_world(job.world)
    geometry = Geometry.of(job.scanner)
    name, model = ESTIMATORS[job.estimator]
    estimator = prepare(EstimatorOptions(job.world, name, model, seed=job.seed))(geometry)
    outcomes: dict[str, tasks.TaskOutcome] = {}
    for number, task in enumerate((tasks.standing, tasks.blocked, tasks.kidnapped)):
        if task.__name__ in job.tasks:
            outcomes |= task(estimator, _scene(job, world, number), job.trials, _no_progress)
    for number, name_of_task in enumerate(("tracking", "odometry")):
        if name_of_task in job.tasks:
            scene = _scene(job, world, 10 + number)
            outcomes |= tasks.tracking(estimator, scene, job.seconds, _no_progress, odometry=name_of_task == "odometry")
    rows = [_row(job, job.world, task, outcome) for task, outcome in outcomes.items()]
    if "twins" not in job.tasks:
        return rows
    scene = _scene(job, TWINS, 20)
    outcomes = tasks.twins(_estimator_for_twins(job, geometry), scene, job.trials, _no_progress)
    return rows + [_row(job, TWINS.name, task, outcome) for task, outcome in outcomes.items()]


def _no_progress(poses: Iterable[Array]) -> Iterator[Array]:
    return iter(poses)


def _scene(job: AccuracyJob, world: World, number: int) -> Scene:
    return Scene.of(world, None, job.seed * 100 + number, job.scanner)


def _estimator_for_twins(job: AccuracyJob, geometry: Geometry) -> Estimator:
    """The job's estimator for the world of two identical rooms; trains its field from 2000 scans if it needs one."""
    name, model = ESTIMATORS[job.estimator]
    mount = (float(geometry.mount[0]), float(geometry.mount[1]), float(geometry.mount[2]))
    if name == "amcl-defaults":
        return ParticleFilter(TWINS, ParticleSettings(), mount, job.seed)
    if name == "particle-filter":
        return ParticleFilter(TWINS, ParticleSettings.tuned(), mount, job.seed)
    rng = np.random.default_rng(job.seed)
    places = thin_places(TWINS.sample_free(6000, rng, 0.05), SEED_SPACING_M)
    if model == "exact":
        exact = RayCaster(TWINS)
        return PreciseEstimator(exact, Seeds.at(exact, places), geometry.mount, geometry.likelihood())
    learned = quick_field(TWINS, geometry, rng, limited=True)
    return PreciseEstimator(learned, Seeds.at(learned, places), geometry.mount, geometry.likelihood())


def quick_field(
    world: World, geometry: Geometry, rng: np.random.Generator, samples: int = 2000, *, limited: bool = False
) -> FieldModel:
    """A distance field trained on exact rays with the scanner's noise, without a simulator.

    With ``limited``, ranges beyond the scanner's maximum count as no return.
    """
    poses = world.sample_poses(samples, rng, 0.27)
    clean = world.ray_distances(se2.compose(poses, geometry.mount), geometry.angles)
    split = samples // 10
    noisy = clean[split:] + geometry.likelihood().deviation(clean[split:]) * rng.standard_normal(clean[split:].shape)
    if limited:
        clean, noisy = (np.where(ranges > geometry.range_max, np.inf, ranges) for ranges in (clean, noisy))
    field = learn_field(Beams.of(poses[split:], geometry.mount, geometry.angles, noisy), Recipe(sweeps=6))
    scales = learn_scales(field, poses[:split], geometry.mount, geometry.angles, clean[:split], 0.0)
    ripple = measure_ripple(field, se2.compose(poses[:split], geometry.mount), geometry.angles)
    return FieldModel(field, scales, ripple)


def _row(job: AccuracyJob, world: str, task: str, outcome: tasks.TaskOutcome) -> dict[str, Any]:
    """Row of the report; None where a quantity is not defined for this task."""
    errors = np.array(outcome.errors).reshape(-1, 3)
    position = np.hypot(errors[:, 0], errors[:, 1])
    count, nees = len(position), np.array(outcome.nees)
    rms = float(np.sqrt(np.mean(position**2))) if count else None
    limit = float(np.sqrt(np.mean(np.square(outcome.bounds)))) if outcome.bounds else None
    half = 1.96 * np.sqrt(2 * DEGREES_OF_FREEDOM / max(len(nees), 1))
    return {
        "world": world,
        "scanner": job.scanner.name,
        "beams": job.scanner.beams,
        "estimator": job.estimator,
        "task": task,
        "of": outcome.total,
        "found": outcome.found,
        "tracking_but_wrong": outcome.wrong,
        "found_share_95": wilson_interval(outcome.found, outcome.total) if outcome.independent else None,
        "tracking_but_wrong_share_95": wilson_interval(outcome.wrong, outcome.total) if outcome.independent else None,
        "position_error_median_m": float(np.median(position)) if count else None,
        "position_error_rms_m": rms,
        "position_error_p95_m": float(np.quantile(position, 0.95)) if count else None,
        "position_error_max_m": float(position.max()) if count else None,
        "heading_error_median_deg": float(np.rad2deg(np.median(np.abs(errors[:, 2])))) if count else None,
        "bound_rms_m": limit,
        "rms_over_bound": rms / limit if rms is not None and limit else None,
        "nees_mean": float(nees.mean()) if len(nees) else None,
        "nees_band": [DEGREES_OF_FREEDOM - half, DEGREES_OF_FREEDOM + half] if len(nees) else None,
        "update_ms_median": float(np.median(outcome.update_ms)) if outcome.update_ms else None,
    }


def wilson_interval(count: int, of: int) -> list[float]:
    """Wilson's 95 % interval for the probability of an event that happened ``count`` times in ``of`` trials."""
    z2 = 1.96**2
    middle, half = count + z2 / 2, 1.96 * np.sqrt(count * (of - count) / of + z2 / 4)
    return [float(np.clip((middle + side * half) / (of + z2), 0, 1)) for side in (-1, 1)]


def provenance(seed: int) -> dict[str, Any]:
    """The information needed to reproduce a result: seed, commit, versions and command-line arguments."""
    return {"seed": seed, "commit": commit(), "versions": versions(), "arguments": sys.argv[1:]}
