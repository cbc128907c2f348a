"""Runs every estimator through every task."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from common.geometry import se2
from common.geometry.world import World, load_world
from common.robot.robot import Robot
from common.robot.scanner import Scanner
from lab.accuracy import tasks
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS, EstimatorSetup
from lab.accuracy.scenes import TWINS, Scene
from lab.statistics import bootstrap_interval, median, root_mean_square, wilson_interval
from lab.workers import pool
from services.estimator.factory import ScannerGeometry
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.field_learning import Recipe, learn_field, learn_scales
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.interface import PoseEstimator

DEGREES_OF_FREEDOM = 3
TASKS = ("standing", "blocked", "furnished", "kidnapped", "tracking", "odometry", "twins")


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
    """Rows of all jobs, in their order; jobs that differ only in the seed are pooled. Shows a progress bar."""
    if workers == 1:
        measured = [run(job) for job in track(jobs, "measuring", console=console, transient=True)]
    else:
        with pool(workers) as executor:
            done = track(executor.map(run, jobs), "measuring", total=len(jobs), console=console, transient=True)
            measured = list(done)
    shared: dict[tuple[AccuracyJob, str, str], list[tasks.TaskOutcome]] = {}
    for job, outcomes in zip(jobs, measured, strict=True):
        for (world, task), outcome in outcomes.items():
            shared.setdefault((replace(job, seed=0), world, task), []).append(outcome)
    return [_row(job, world, task, tasks.TaskOutcome.joined(parts)) for (job, world, task), parts in shared.items()]


def run(job: AccuracyJob) -> dict[tuple[str, str], tasks.TaskOutcome]:
    """Runs the job's tasks. Returns an outcome for each result, by world and name."""
    world = load_world(job.world)
    estimator = _estimator(job, world)
    outcomes: dict[str, tasks.TaskOutcome] = {}
    for number, task in enumerate((tasks.standing, tasks.blocked, tasks.kidnapped, tasks.furnished)):
        if task.__name__ in job.tasks:
            outcomes |= task(estimator, _scene(job, world, number), job.trials)
    for number, name in enumerate(("tracking", "odometry")):
        if name in job.tasks:
            scene = _scene(job, world, 10 + number)
            outcomes |= tasks.tracking(estimator, scene, job.seconds, odometry=name == "odometry")
    by_world = {(job.world, task): outcome for task, outcome in outcomes.items()}
    if "twins" in job.tasks:
        scene = _scene(job, TWINS, 20)
        outcomes = tasks.twins(_estimator(job, TWINS), scene, job.trials)
        by_world |= {(TWINS.name, task): outcome for task, outcome in outcomes.items()}
    return by_world


def _estimator(job: AccuracyJob, world: World) -> PoseEstimator:
    """The job's estimator; for the world of two identical rooms, trains a field from 2000 scans if it needs one."""
    geometry, compared = ScannerGeometry.of(job.scanner), COMPARED_ESTIMATORS[job.estimator]
    learned = None
    if world is TWINS and compared.learns:
        learned = quick_field(TWINS, geometry, np.random.default_rng(job.seed), limited=True)
    return compared.make(EstimatorSetup(world, geometry, job.seed, learned))


def _scene(job: AccuracyJob, world: World, number: int) -> Scene:
    return Scene.of(world, None, job.seed * 100 + number, job.scanner)


def quick_field(
    world: World, geometry: ScannerGeometry, rng: np.random.Generator, samples: int = 2000, *, limited: bool = False
) -> FieldModel:
    """A distance field trained on exact rays with the scanner's noise, without a simulator.

    With ``limited``, ranges beyond the scanner's maximum count as no return.
    """
    poses = world.sample_poses(samples, rng, Robot().radius)
    clean = world.ray_distances(se2.compose(poses, geometry.mount), geometry.angles)
    split = samples // 10
    noisy = clean[split:] + geometry.likelihood().deviation(clean[split:]) * rng.standard_normal(clean[split:].shape)
    if limited:
        clean, noisy = (np.where(ranges > geometry.range_max, np.inf, ranges) for ranges in (clean, noisy))
    field = learn_field(Beams.of(poses[split:], geometry.mount, geometry.angles, noisy), Recipe(sweeps=6))
    scales = learn_scales(field, poses[:split], geometry.mount, geometry.angles, clean[:split], 0.0)
    return FieldModel(field, scales)


def _row(job: AccuracyJob, world: str, task: str, outcome: tasks.TaskOutcome) -> dict[str, Any]:
    """Row of the report; None where a quantity is not defined for this task."""
    errors = np.array(outcome.errors).reshape(-1, 3)
    position = np.hypot(errors[:, 0], errors[:, 1])
    count, nees = len(position), np.array(outcome.nees)
    groups = [np.array(group) for group in outcome.by_group(position)]
    rms = root_mean_square(position) if count else None
    bound = root_mean_square(np.array(outcome.bounds)) if outcome.bounds else None
    half = 1.96 * np.sqrt(2 * DEGREES_OF_FREEDOM / max(len(nees), 1))
    every = np.array(outcome.all_position_errors)
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
        "position_error_median_95_m": bootstrap_interval(groups, median),
        "position_error_rms_m": rms,
        "position_error_rms_95_m": bootstrap_interval(groups, root_mean_square),
        "position_error_p95_m": float(np.quantile(position, 0.95)) if count else None,
        "position_error_max_m": float(position.max()) if count else None,
        "all_trials_position_error_median_m": float(np.median(every)) if len(every) else None,
        "all_trials_position_error_rms_m": root_mean_square(every) if len(every) else None,
        "heading_error_median_deg": float(np.rad2deg(np.median(np.abs(errors[:, 2])))) if count else None,
        "bound_rms_m": bound,
        "rms_over_bound": rms / bound if rms is not None and bound else None,
        "nees_mean": float(nees.mean()) if len(nees) else None,
        "nees_band": [DEGREES_OF_FREEDOM - half, DEGREES_OF_FREEDOM + half] if len(nees) else None,
        "update_ms_median": float(np.median(outcome.update_ms)) if outcome.update_ms else None,
    }
