"""`presage experiment peers`: presage and its particle filter on the scans on which other programs were measured.

Tasks: (a) a standing robot at an unknown pose; (b) drives from a roughly known start with odometry; (c) the same
without. The protocol is the one of those measurements: a trial has converged if the median error of its last ten scans
is below 0.2 m, and errors are of the trials that converged.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from lab.experiments import results
from lab.experiments.trials import run_trials
from lab.integrity.models import field_file
from lab.peers.scans import BUILDING, DRIVES, PLACES, TrialScans, map_file, read_trial_scans
from lab.statistics import bootstrap_interval, median, root_mean_square, wilson_interval
from presage.learning.train_drive import TrainDriveOptions, card_of, rectangle
from presage.terminal.output import make_folder
from services.estimator.factory import EstimatorFactory, EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.drive_learning import learn_drive
from services.estimator.shared.interface import Observation

STANDING, ODOMETRY, LASER = "standing", "odometry", "laser"
TASKS = {
    STANDING: "a: standing at unknown places",
    ODOMETRY: "b: tracking with odometry",
    LASER: "c: tracking without odometry",
}
# The maps: given as polygons or as an occupancy grid, or a field learned from that grid or from scans with known poses.
POLYGONS, CELLS, FIELD, POSED = "polygons", "5 cm map", "learned from 5 cm map", "learned from posed scans"
START_DEVIATION = np.array([0.2, 0.2, 0.1])  # m, m, rad, of the given start of a drive
LAST_SCANS = 10  # of a trial; their median error decides whether it has converged
CONVERGED_M = 0.2  # limit of this median error
SETTLED_SCANS = 50  # of a drive, before its errors count


@dataclass(frozen=True)
class EstimatorWithMap:
    """An estimator, its map, and what it is given that a robot would not know."""

    estimator: str  # preset
    map: str
    knows: str


ESTIMATORS = {
    "presage, polygons": EstimatorWithMap("precise", POLYGONS, "σ, exact map"),
    "presage, 5 cm map": EstimatorWithMap("precise", CELLS, "σ"),
    "presage, learned from 5 cm map": EstimatorWithMap("precise", FIELD, "σ"),
    "presage, learned from posed scans": EstimatorWithMap(
        "precise", POSED, "true poses of other drives; learns σ, drift, base limits"
    ),
    "particle-filter, polygons": EstimatorWithMap("particle-filter", POLYGONS, "exact map"),
    "particle-filter, 5 cm map": EstimatorWithMap("particle-filter", CELLS, "–"),
    "amcl-defaults, 5 cm map": EstimatorWithMap("amcl-defaults", CELLS, "–"),
}


@dataclass(frozen=True)
class PeersJob:
    """One trial of one estimator."""

    folder: str  # of the scans
    models: str  # folder of the learned models
    estimator: str  # its name in `ESTIMATORS`
    task: str
    number: int  # of the place or drive
    seed: int

    @property
    def training_drives(self) -> str:
        """The drives from which the model is learned; the localised drive is never one of them."""
        if self.task == STANDING:
            return "all"
        return "odd" if self.number % 2 == 0 else "even"


def scans_of(folder: Path, task: str) -> TrialScans:
    """All trials of a task."""
    return read_trial_scans(folder / (PLACES if task == STANDING else DRIVES))


def run(
    folder: Path, estimators: Sequence[str], trials: int, seed: int, out: Path, workers: int, console: Console
) -> results.Result:
    """Localises the scans of ``folder``, at most ``trials`` of each task. Writes peers.json into ``out``."""
    map_file(folder)
    models = out / "peers-models"
    make_folder(models)
    jobs = [
        PeersJob(str(folder), str(models), estimator, task, number, seed)
        for estimator in estimators
        for task in TASKS
        for number in range(min(trials, len(scans_of(folder, task).truth)))
    ]
    learned = {_model_file(job): job for job in jobs if _model_file(job)}
    run_trials("learning", learn, list(learned.values()), out, workers, console)
    rows = run_trials("peers", trial, jobs, out, workers, console)
    summary = {
        f"{TASKS[task]}, {name}": summarise([row for row in rows if (row["task"], row["estimator"]) == (task, name)])
        for task in TASKS
        for name in estimators
    }
    parameters = {"trials": trials, "knows": {name: ESTIMATORS[name].knows for name in estimators}}
    result = results.Result("peers", "The scans on which other programs were measured", seed, parameters, summary)
    result.write(out, None)
    return result


def _model_file(job: PeersJob) -> str:
    """The weights that the job's estimator learns; empty if it learns none."""
    kind = ESTIMATORS[job.estimator].map
    if kind == FIELD:
        return str(weights.path_of(Path(job.models), load_world(str(map_file(Path(job.folder)))).name))
    return str(weights.path_of(Path(job.models), f"posed-{job.training_drives}")) if kind == POSED else ""


def learn(job: PeersJob) -> dict[str, Any]:
    """Learns the job's model, unless an interrupted run has: from the map, or from drives on which it is not tested."""
    folder, path = Path(job.folder), Path(_model_file(job))
    if ESTIMATORS[job.estimator].map == FIELD:
        field_file(path.parent, load_world(str(map_file(folder))), scans_of(folder, job.task).scanner)
    elif not path.exists():
        scans = read_trial_scans(folder / DRIVES)
        numbers = range(len(scans.truth))
        drive = scans.drive({"all": numbers, "odd": numbers[1::2], "even": numbers[::2]}[job.training_drives])
        options = TrainDriveOptions(Path(DRIVES))
        began = time.monotonic()
        learned = learn_drive(drive, options.recipe, None, lambda _title, _done: None)
        world = rectangle(drive, options.log)
        card = card_of(options, world, drive, learned, time.monotonic() - began)
        weights.save(path, learned.model, learned.places, card)
    return {"file": str(path)}


@functools.lru_cache(maxsize=4)
def _factory(folder: str, estimator: str, model: str, seed: int) -> EstimatorFactory:
    """Makes estimators of one kind, compiled by a first update; cached per process."""
    chosen = ESTIMATORS[estimator]
    world = str(Path(folder) / BUILDING if chosen.map in (POLYGONS, POSED) else map_file(Path(folder)))
    factory = prepare_factory(EstimatorOptions(world, chosen.estimator, model or "exact", seed=seed))  # type: ignore[arg-type]
    scans = read_trial_scans(Path(folder) / PLACES)
    factory(ScannerGeometry.of(scans.scanner)).update(_observation(scans, 0, 0, None))
    return factory


def _observation(scans: TrialScans, number: int, k: int, odom: Array | None) -> Observation:
    scanner = scans.scanner
    return Observation(scans.ranges[number, k], scanner.angles(), scanner.range_max, float(scans.stamps[k]), odom)


def trial(job: PeersJob) -> dict[str, Any]:
    """Errors, states and processor times of all scans of one trial."""
    scans, number = scans_of(Path(job.folder), job.task), job.number
    estimator = _factory(job.folder, job.estimator, _model_file(job), job.seed)(ScannerGeometry.of(scans.scanner))
    truth = scans.truth[number]
    if job.task != STANDING:
        rng = np.random.default_rng([job.seed, number])
        start = truth[0] + START_DEVIATION * rng.standard_normal(3)
        estimator.restart(start, np.diag(START_DEVIATION**2))
    error, yaw_error, tracking, update_ms = [], [], [], []
    for k, pose in enumerate(truth):
        observation = _observation(scans, number, k, scans.odom[number, k] if job.task == ODOMETRY else None)
        began = time.process_time()
        posterior = estimator.update(observation)
        update_ms.append(1e3 * (time.process_time() - began))
        difference = posterior.pose - pose
        error.append(float(np.hypot(difference[0], difference[1])))
        yaw_error.append(abs(float(se2.wrap(difference[2]))))
        tracking.append(posterior.state == "tracking")
    return {**asdict(job), "error_m": error, "yaw_error_rad": yaw_error, "tracking": tracking, "update_ms": update_ms}


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of one estimator in one task."""
    standing = rows[0]["task"] == STANDING
    converged = [row for row in rows if np.median(row["error_m"][-LAST_SCANS:]) < CONVERGED_M]

    def counted(trials: Sequence[dict[str, Any]], name: str) -> list[Array]:
        return [np.array(row[name][-LAST_SCANS:] if standing else row[name][SETTLED_SCANS:]) for row in trials]

    errors, every = counted(converged, "error_m"), counted(rows, "error_m")
    wrong = [np.array(row["tracking"]) & (np.array(row["error_m"]) > CONVERGED_M) for row in rows]
    pooled = np.concatenate(errors) if errors else np.full(1, np.nan)
    return {
        "trials": len(rows),
        "converged": len(converged),
        "converged_share_95": wilson_interval(len(converged), len(rows)),
        "error_median_m": _finite(np.median(pooled)),
        "error_median_95_m": bootstrap_interval(errors, median),
        "error_mean_m": _finite(pooled.mean()),
        "error_mean_95_m": bootstrap_interval(errors, lambda values: float(values.mean())),
        "error_p95_m": _finite(np.quantile(pooled, 0.95)),
        "all_trials_error_median_m": float(np.median(np.concatenate(every))),
        "all_trials_error_rms_m": root_mean_square(np.concatenate(every)),
        "yaw_error_median_rad": _finite(np.median(np.concatenate(counted(converged, "yaw_error_rad"))))
        if converged
        else None,
        "tracking": int(sum(np.sum(row["tracking"]) for row in rows)),
        "wrong_tracking": int(sum(each.sum() for each in wrong)),
        "scans": int(sum(len(row["error_m"]) for row in rows)),
        "first_update_ms": float(np.median([row["update_ms"][0] for row in rows])),
        "later_update_ms": float(np.median(np.concatenate([row["update_ms"][1:] for row in rows]))),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


HEADS = ("converged", "error, cm: median (95 %) / mean / 95th percentile", "CPU ms: first / later")


def table(summary: dict[str, dict[str, Any]]) -> str:
    """Markdown tables of presage's own estimators, one for each task."""
    return _tables(summary, [])


def table_with_others(folder: Path) -> str:
    """The Markdown tables of docs/peers.md: presage's own estimators, and the other programs as they were measured."""
    return _tables(results.read(folder / "peers.json")["summary"], results.read(folder / "peers-others.json")["rows"])


def _tables(summary: dict[str, dict[str, Any]], others: list[dict[str, Any]]) -> str:
    tables = []
    for task, title in TASKS.items():
        lines = [_cells(name, row) for name, row in summary.items() if name.startswith(title)]
        lines += [
            [row["name"], row["converged"], row["error_cm"], row["cpu_ms"]] for row in others if row["task"] == task
        ]
        tables.append(results.markdown((title, *HEADS), lines))
    return "\n\n".join(tables)


def _cells(name: str, row: dict[str, Any]) -> list[str]:
    return [
        name.partition(", ")[2],
        f"{row['converged']}/{row['trials']}",
        " / ".join(
            [
                f"{_centimetres(row['error_median_m'])}{_interval(row['error_median_95_m'])}",
                _centimetres(row["error_mean_m"]),
                _centimetres(row["error_p95_m"]),
            ]
        ),
        f"{row['first_update_ms']:.0f} / {row['later_update_ms']:.1f}",
    ]


def _centimetres(metres: float | None) -> str:
    return results.number(None if metres is None else 100 * metres, 2)


def _interval(bounds: Sequence[float] | None) -> str:
    return "" if bounds is None else f" ({100 * bounds[0]:.2f} to {100 * bounds[1]:.2f})"
