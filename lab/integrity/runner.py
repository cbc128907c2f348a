"""Runs every estimator through every case in every world, in worker processes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from rich.console import Console

from lab.experiments.trials import run_trials
from lab.integrity.cases import CASES, Trial, make_trial, map_of, scanner_of
from lab.integrity.models import field_file
from lab.integrity.scoring import Scans, score_case, score_trial
from services.estimator.factory import EstimatorOptions, Factory, Geometry, Name, prepare
from services.estimator.shared.interface import Posterior

SEEDS_PER_RUN = 1000  # worlds of one run; the next seed of a run has other worlds


@dataclass(frozen=True)
class Plan:
    """What one run of the benchmark measures."""

    worlds: int
    seed: int
    cases: tuple[str, ...]
    estimators: tuple[str, ...]
    model: str = "learned"  # of estimator precise: learned or exact
    seconds: float | None = None  # of a drive; defaults to each case's

    def jobs(self, out: Path) -> list[IntegrityJob]:
        """One job for each world, case and estimator."""
        return [
            IntegrityJob(case, self.seed * SEEDS_PER_RUN + world, estimator, self.model, self.seconds, str(out))
            for world in range(self.worlds)
            for case in self.cases
            for estimator in self.estimators
        ]


@dataclass(frozen=True)
class IntegrityJob:
    """One trial of one estimator; the values are plain, so that jobs can be compared and pickled."""

    case: str
    seed: int  # of the world
    estimator: str
    model: str
    seconds: float | None
    out: str  # folder of the results

    @property
    def scans_file(self) -> Path:
        """The file with what the estimator reported for every scan."""
        return Path(self.out) / "scans" / f"{self.case}-{self.seed}-{self.estimator}.npz"


@dataclass(frozen=True)
class LearningJob:
    """The map of one case in one world, for which a field is learned."""

    case: str
    seed: int
    out: str


def run(
    plan: Plan, out: Path, workers: int, console: Console
) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Scores by estimator and case, and the rows of all trials."""
    jobs = plan.jobs(out)
    (out / "scans").mkdir(parents=True, exist_ok=True)
    if "precise" in plan.estimators and plan.model == "learned":
        maps = {map_key(job.case, job.seed): LearningJob(job.case, job.seed, job.out) for job in jobs}
        run_trials("learning", learn, list(maps.values()), out, workers, console)
    rows = run_trials("integrity", run_trial, jobs, out, workers, console)
    scores = {
        estimator: {
            name: score_case(own, Scans.joined([Scans.load(out / row["scans_file"]) for row in own]))
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


def map_key(case: str, seed: int) -> tuple[str, str, int]:
    """What the map of a case depends on."""
    return CASES[case].building, CASES[case].map, seed


def learn(job: LearningJob) -> dict[str, Any]:
    """Learns the field of a map."""
    case = CASES[job.case]
    return {"file": str(field_file(Path(job.out) / "models", map_of(case, job.seed), scanner_of(case)))}


def run_trial(job: IntegrityJob) -> dict[str, Any]:
    """Runs the job's estimator, writes what it reported for every scan, and returns the scores of the trial."""
    trial = make_trial(CASES[job.case], job.seed, job.seconds)
    scans = localise(trial, make_factory(job, trial))
    scans.save(job.scans_file)
    scores = score_trial(scans, trial.scanner.rate, trial.kidnappings.tolist(), separate=trial.separate)
    return {
        "case": job.case,
        "seed": job.seed,
        "estimator": job.estimator,
        "map_is_correct": trial.map_is_correct,
        "scans_file": str(job.scans_file.relative_to(job.out)),
        **scores,
    }


def make_factory(job: IntegrityJob, trial: Trial) -> Factory:
    """The estimators of a trial, made as by the estimator service."""
    model = job.model
    if job.estimator == "precise" and model == "learned":
        model = str(field_file(Path(job.out) / "models", trial.map_world, trial.scanner))
    return prepare(EstimatorOptions(trial.map_world, cast("Name", job.estimator), model, seed=job.seed))


def localise(trial: Trial, factory: Factory) -> Scans:
    """What an estimator reports for the scans of a trial."""
    geometry = Geometry.of(trial.scanner)
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
    return Scans.of(posteriors, trial.truths, seconds)
