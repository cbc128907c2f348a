"""Runs every estimator through every case in every world, in worker processes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from rich.console import Console

from lab.experiments.trials import run_trials
from lab.integrity.cases import CASES, IntegrityTrial, make_trial, map_of, scanner_of
from lab.integrity.logs import LogCase, log_field_file, log_trial
from lab.integrity.models import field_file
from lab.integrity.scoring import Estimates, score_case, score_trial
from services.estimator.factory import (
    EstimatorFactory,
    EstimatorOptions,
    EstimatorPreset,
    ScannerGeometry,
    prepare_factory,
)
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.precise.learning import weights
from services.estimator.shared.interface import PoseEstimator, Posterior

SEEDS_PER_RUN = 1000  # worlds of one run; the next seed of a run has other worlds
# The tuned particle filter that also searches elsewhere after it was given a start pose, which by default it keeps
RECOVERING_FILTER = "particle-filter-recovery"


@dataclass(frozen=True)
class TrialSource:
    """A case in the world of a seed, or in a real log; the values are plain, so that they can be compared."""

    case: str
    seed: int
    seconds: float | None = None  # of a drive; defaults to the case's
    log: LogCase | None = None

    def trial(self) -> IntegrityTrial:
        """The scans."""
        return log_trial(self.log) if self.log else make_trial(CASES[self.case], self.seed, self.seconds)

    @property
    def map_key(self) -> tuple[str, str, int]:
        """What the map depends on."""
        if self.log:
            return "log", self.log.map_name, 0
        return CASES[self.case].building, CASES[self.case].map, self.seed

    def field_file(self, folder: Path) -> Path:
        """The weights of preset `precise` for the map; learned now unless the folder has them."""
        if self.log:
            return log_field_file(folder, self.log)
        case = CASES[self.case]
        return field_file(folder, map_of(case, self.seed), scanner_of(case))


@dataclass(frozen=True)
class IntegrityPlan:
    """What one run of the benchmark measures."""

    worlds: int
    seed: int
    cases: tuple[str, ...]
    estimators: tuple[str, ...]
    model: str = "learned"  # of estimator precise: learned or exact
    seconds: float | None = None  # of a drive; defaults to each case's
    logs: tuple[LogCase, ...] = ()

    def sources(self) -> list[TrialSource]:
        """All trials of one estimator."""
        seeds = [self.seed * SEEDS_PER_RUN + world for world in range(self.worlds)]
        generated = [TrialSource(case, seed, self.seconds) for seed in seeds for case in self.cases]
        return [*generated, *(TrialSource(log.name, self.seed, log=log) for log in self.logs)]


@dataclass(frozen=True)
class IntegrityJob:
    """One trial of one estimator."""

    source: TrialSource
    estimator: str
    model: str
    out: str  # folder of the results

    @property
    def scans_file(self) -> Path:
        """The file with what the estimator reported for every scan."""
        return Path(self.out) / "scans" / f"{self.source.case}-{self.source.seed}-{self.estimator}.npz"

    @property
    def models(self) -> Path:
        """The folder of the weights."""
        return Path(self.out) / "models"


def run(
    plan: IntegrityPlan, out: Path, workers: int, console: Console
) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Scores by estimator and case, and the rows of all trials."""
    jobs = [
        IntegrityJob(source, estimator, plan.model, str(out))
        for source in plan.sources()
        for estimator in plan.estimators
    ]
    (out / "scans").mkdir(parents=True, exist_ok=True)
    if plan.model == "learned":
        maps = {job.source.map_key: job for job in jobs if job.estimator == "precise"}
        run_trials("learning", learn, list(maps.values()), out, workers, console)
    rows = run_trials("integrity", run_trial, jobs, out, workers, console)
    scores = {
        estimator: {
            name: score_case(own, Estimates.joined([Estimates.load(out / row["scans_file"]) for row in own]))
            for name, own in _groups([row for row in rows if row["estimator"] == estimator])
        }
        for estimator in plan.estimators
    }
    return scores, rows


def _groups(rows: list[dict[str, Any]]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """The trials of each case, those whose map is correct, and all."""
    for case in dict.fromkeys(row["case"] for row in rows):
        yield case, [row for row in rows if row["case"] == case]
    if correct := [row for row in rows if row["map_is_correct"]]:
        yield "all with a correct map", correct
    yield "all", rows


def learn(job: IntegrityJob) -> dict[str, Any]:
    """Learns the field of the job's map."""
    return {"file": str(job.source.field_file(job.models))}


def run_trial(job: IntegrityJob) -> dict[str, Any]:
    """Runs the job's estimator, writes what it reported for every scan, and returns the scores of the trial."""
    trial = job.source.trial()
    scans = localise(trial, make_factory(job, trial))
    scans.save(job.scans_file)
    return {
        "case": job.source.case,
        "seed": job.source.seed,
        "estimator": job.estimator,
        "map_is_correct": trial.map_is_correct,
        "scans_file": str(job.scans_file.relative_to(job.out)),
        **score_trial(scans, trial.scanner.rate, trial.kidnappings.tolist(), separate=trial.separate),
    }


def make_factory(job: IntegrityJob, trial: IntegrityTrial) -> EstimatorFactory:
    """The estimators of a trial, made as by the estimator service but for `RECOVERING_FILTER`."""
    model, seed = job.model, job.source.seed
    if job.estimator == RECOVERING_FILTER:
        return _with_recovery(prepare_factory(EstimatorOptions(trial.map_world, "particle-filter", seed=seed)))
    if job.estimator == "precise" and model == "learned":
        model = str(weights.path_of(job.models, trial.map_world.name))  # learned before the trials
    preset = cast("EstimatorPreset", job.estimator)
    return prepare_factory(EstimatorOptions(trial.map_world, preset, model, seed=seed))


def _with_recovery(factory: EstimatorFactory) -> EstimatorFactory:
    """Particle filters that do not keep a start pose at all costs."""

    def make(geometry: ScannerGeometry) -> PoseEstimator:
        estimator = factory(geometry)
        assert isinstance(estimator, ParticleFilter)  # noqa: S101 - for the type checker
        estimator.settings = replace(estimator.settings, keep_initial_pose=False)
        return estimator

    return make


def localise(trial: IntegrityTrial, factory: EstimatorFactory) -> Estimates:
    """What an estimator reports for the scans of a trial."""
    geometry = ScannerGeometry.of(trial.scanner)
    factory(geometry).update(trial.observations[0])  # compiles what is compiled at the first scan
    estimator = factory(geometry)
    estimator.restart(*(trial.start or ()))
    posteriors: list[Posterior] = []
    seconds: list[float] = []
    for observation in trial.observations:
        if trial.separate:
            estimator.restart()
        began = time.process_time()
        posteriors.append(estimator.update(observation))
        seconds.append(time.process_time() - began)
    return Estimates.of(posteriors, trial.truths, seconds)
