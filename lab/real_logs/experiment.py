"""`presage experiment real`.

Tasks: (a) tracking with odometry, (b) tracking without, (c) global localisation, (d) kidnapping. Errors are relative to
the log's reference poses and therefore include the errors of those poses.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from common.errors import UserError
from common.geometry.world import load_world
from lab.experiments import results
from lab.experiments.trials import run_key, run_trials
from lab.real_logs.drive import (
    ESTIMATORS,
    FILTERS,
    GLOBAL,
    KIDNAPPED,
    LASER,
    MAX_SEARCH_SCANS,
    ODOMETRY,
    SCANS_BEFORE_KIDNAPPING,
    StretchJob,
    trial,
)
from lab.real_logs.figure import draw
from lab.real_logs.filter_tuning import ParameterValues, TunedSettings, starting_point, tune
from lab.real_logs.scoring import (
    CORRECT_DISTANCE_M,
    CORRECT_YAW_RAD,
    counted,
    is_correct,
    is_tracking,
    longest_wrong_s,
    scans_until_found,
)
from lab.statistics import root_mean_square
from presage.learning.train_drive import TrainDriveOptions, card_of
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.drive_learning import learn_drive
from services.estimator.precise.learning.field_learning import Recipe

TASKS = {
    ODOMETRY: "tracking with odometry",
    LASER: "tracking without",
    GLOBAL: "global localisation",
    KIDNAPPED: "kidnapped",
}
LETTERS = {ODOMETRY: "a", LASER: "b", GLOBAL: "c", KIDNAPPED: "d"}  # of the tasks
MIN_FREE_SHARE = 0.5  # of the reference poses in free space; the map may lack places that the drive saw
QUICK_SCANS = 120  # scans of (a) and (b) with --quick


@dataclass(frozen=True)
class RealLogJob:
    """Parameters of the experiment."""

    log: Path
    map: str
    mount: tuple[float, float, float] | None = None  # pose of the laser in base_link; None for the log's own
    every: int = 50  # number of scans between the starts of (c) and (d)
    quick: bool = False
    seed: int = 1
    name: str = ""  # the result is named real-NAME
    exchange: bool = False  # train on the second half, localise on the first

    @property
    def result(self) -> str:
        """Name of the result and its files."""
        stem = re.sub(r"[^A-Za-z0-9_]", "_", self.log.stem) + "_exchanged" * self.exchange
        return f"real-{self.name or stem}"


def run(job: RealLogJob, out: Path, workers: int, console: Console) -> results.Result:
    """Trains, tunes and localises. Writes real-NAME.json, .csv, .trials.jsonl, .pdf and .png into ``out``."""
    template = StretchJob(
        str(job.log), job.map, job.mount, "precise", ODOMETRY, 0, seed=job.seed, exchanged=job.exchange
    )
    drive, half = template.drive, template.learned
    _print_drive(job, drive, console)
    _check_drive(job, drive, half)
    model, card, tuned = _train_and_tune(job, template, half, out, console)
    template = replace(template, first=half, model=str(model))
    jobs = [
        replace(each, estimator=name, particles=_settings(tuned[name], each.task) if name in tuned else ())
        for each in stretches(template, half, len(drive.ranges), job, odometry=drive.odom is not None)
        for name in ESTIMATORS
    ]
    rows = run_trials(job.result, trial, jobs, out, workers, console)
    summary = {
        f"{LETTERS[task]}: {title}, {name}": summarise([r for r in rows if (r["task"], r["estimator"]) == (task, name)])
        for task, title in TASKS.items()
        for name in ESTIMATORS
        if any(r["task"] == task for r in rows)
    }
    result = results.Result(
        job.result,
        f"A real drive: {job.log.name}",
        job.seed,
        {
            **{k: str(v) if isinstance(v, Path) else v for k, v in asdict(job).items()},
            "scans": len(drive.ranges),
            "particle_filters": {name: _as_json(each) for name, each in tuned.items()},
            "calibration": asdict(card.calibration) if card.calibration else None,
        },
        summary,
        curves_of(rows),
        rows,
        notes(job, card, tuned),
    )
    result.write(out, draw(card.calibration, rows, TASKS))
    return result


def _print_drive(job: RealLogJob, drive: ReferenceDrive, console: Console) -> None:
    x, y, yaw = drive.mount
    console.print(
        f"{job.log.name}: {len(drive.ranges)} posed scans, the laser at {x:g} m, {y:g} m, {np.rad2deg(yaw):g} deg in "
        f"base_link{'' if job.mount else ' (change with --mount)'}; localising the "
        f"{'first' if job.exchange else 'second'} half"
    )


def _check_drive(job: RealLogJob, drive: ReferenceDrive, half: int) -> None:
    """Raises UserError if the training half's poses are mostly outside the map's free space, or scans are too few."""
    free = float((load_world(job.map).clearance(drive.poses[:half, :2]) > 0).mean())
    if free < MIN_FREE_SHARE:
        raise UserError(
            f"only {free:.0%} of the reference poses of the training half are in free space of {job.map}: "
            "is it a map of this place, in the frame of these poses?"
        )
    if len(drive.ranges) < 4 * MAX_SEARCH_SCANS:
        raise UserError(
            f"{job.log}: {len(drive.ranges)} posed scans; at least {4 * MAX_SEARCH_SCANS} are needed, that is scans "
            "with a reference pose"
        )


def _train_and_tune(
    job: RealLogJob, stretch: StretchJob, half: int, out: Path, console: Console
) -> tuple[Path, weights.FieldCard, dict[str, TunedSettings]]:
    """The model trained on the training half, and the settings of each of the `FILTERS` tuned on it.

    An interrupted run's model and settings are reused if the command, its files and the checkout are the same.
    """
    world = load_world(job.map)
    path = out / f".{job.result}" / "model.safetensors"
    kept = path.with_name("tuned.json")
    key = run_key([job])
    with suppress(OSError, ValueError, KeyError, TypeError, UserError):  # no usable files of an interrupted run
        before = json.loads(kept.read_text(encoding="utf-8"))
        if before["key"] == key:
            return path, weights.load(path)[2], {name: _from_json(before[name]) for name in FILTERS}
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("learning", total=1.0)

        def report(title: str, done: float) -> None:
            bar.update(task, description=title, completed=done)

        first = stretch.drive.part(np.arange(half))
        training = TrainDriveOptions(job.log, share=0.5, recipe=Recipe(resolution=0.05, seed=job.seed))
        learned = learn_drive(first, training.recipe, None, report)
        card = card_of(training, world, first, learned, 0.0)
        weights.save(path, learned.model, learned.places, card)
        start = starting_point(learned.calibration.motion)
        tuned = {
            name: TunedSettings(start, start, (*start, ("keep_initial_pose", 0.0)), [])
            if job.quick
            else tune(replace(stretch, estimator=name), half, start, path.parent, report)
            for name in FILTERS
        }
    stored = {"key": key, **{name: _as_json(each) for name, each in tuned.items()}}
    kept.write_text(json.dumps(stored) + "\n", encoding="utf-8")
    return path, card, tuned


def _settings(tuned: TunedSettings, task: str) -> ParameterValues:
    return _settings_by_task(tuned).get(task, tuned.finding)


def _settings_by_task(tuned: TunedSettings) -> dict[str, ParameterValues]:
    return {ODOMETRY: tuned.odometry, LASER: tuned.laser, "finding": tuned.finding}


def _as_json(tuned: TunedSettings) -> dict[str, Any]:
    return {**{name: dict(each) for name, each in _settings_by_task(tuned).items()}, "tried": tuned.tried}


def _from_json(stored: dict[str, Any]) -> TunedSettings:
    odometry, laser, finding = (tuple(stored[what].items()) for what in (ODOMETRY, LASER, "finding"))
    return TunedSettings(odometry, laser, finding, stored["tried"])


def stretches(template: StretchJob, half: int, count: int, job: RealLogJob, *, odometry: bool) -> list[StretchJob]:
    """The trials of one estimator, the longest first."""
    length = min(QUICK_SCANS, count - half) if job.quick else count - half
    whole = [replace(template, task=task, count=length) for task in ((ODOMETRY, LASER) if odometry else (LASER,))]
    starts = list(range(half, count - MAX_SEARCH_SCANS, job.every * (4 if job.quick else 1)))
    kidnappings = [
        replace(template, task=KIDNAPPED, first=first, to=to)
        for first, to in ((first, _kidnapped_to(first, half, count)) for first in starts)
        if to is not None
    ]
    return [*whole, *kidnappings, *(replace(template, task=GLOBAL, first=first) for first in starts)]


def _kidnapped_to(first: int, half: int, count: int) -> int | None:
    """Index of the scan half a drive away from ``first``; None if scans from there on overlap those before."""
    to = half + (first - half + (count - half) // 2) % (count - half - MAX_SEARCH_SCANS)
    overlaps = first - MAX_SEARCH_SCANS < to <= first + SCANS_BEFORE_KIDNAPPING
    return None if overlaps else to


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of one estimator in one task."""
    error, yaw, ms, nees = (
        np.concatenate([counted(row, name) for row in rows]) for name in ("error_m", "yaw_error_rad", "ms", "nees")
    )
    correct = np.concatenate([is_correct(row) for row in rows])
    tracking = np.concatenate([is_tracking(row) for row in rows])
    found = [k for k in map(scans_until_found, rows) if k is not None]
    known = np.array([value for value in nees[correct & tracking] if value is not None], float)
    return {
        "task": rows[0]["task"],
        "estimator": rows[0]["estimator"],
        "trials": len(rows),
        "scans": len(error),
        "error_median_m": float(np.median(error)),
        "error_rms_m": root_mean_square(error),
        "error_95_m": float(np.quantile(error, 0.95)),
        "correct_error_rms_m": root_mean_square(error[correct]) if correct.any() else None,
        "yaw_error_median_rad": float(np.median(yaw)),
        "correct": int(correct.sum()),
        "tracking": int(tracking.sum()),
        "wrong": int((tracking & ~correct).sum()),
        "longest_wrong_s": max(map(longest_wrong_s, rows)),
        "found": len(found),
        "scans_until_found_median": float(np.median(found)) if found else None,
        "scans_until_found_mean": float(np.mean(found)) if found else None,
        "nees_median": float(np.median(known)) if len(known) else None,
        "ms_median": float(np.median(ms)),
        "ms_95": float(np.quantile(ms, 0.95)),
    }


def curves_of(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """CSV columns: errors of (a) and (b) at every scan."""
    curves: dict[str, list[Any]] = {}
    for row in rows:
        if row["task"] in (ODOMETRY, LASER):
            curves.setdefault("stamp_s", row["stamp_s"])
            curves[f"{row['estimator']}, {row['task']} m"] = row["error_m"]
    return curves


def notes(job: RealLogJob, card: weights.FieldCard, tuned: dict[str, TunedSettings]) -> list[str]:
    """Notes below the table: definitions, tuned settings and calibration."""
    found, learned = card.calibration, "second" if job.exchange else "first"
    lines = [
        (
            f"correct: within {CORRECT_DISTANCE_M} m and {np.rad2deg(CORRECT_YAW_RAD):.0f} deg of the reference pose, "
            f"whose error adds to the errors; found: state `tracking` there within {MAX_SEARCH_SCANS} scans"
        ),
        *(
            f"{name}, tuned on the {learned} half, {what}: {_format_settings(each)}"
            for name, settings in tuned.items()
            for what, each in (("a", settings.odometry), ("b", settings.laser), ("c and d", settings.finding))
            if not job.quick
        ),
    ]
    if found is not None:
        shares = found.likelihood
        lines.append(
            f"held out of the {learned} half, {found.scans} scans: {found.log_likelihood:.2f} nats per beam; "
            f"{shares.short:.1%} of the beams end early, {shares.random:.1%} anywhere; pose within "
            f"{found.floor_position * 1e3:.0f} mm and {np.rad2deg(found.floor_heading):.2f} deg of the reference "
            f"beyond the scan's covariance; NEES "
            f"{found.nees_median:.2f} median (ideal 2.37), {found.nees_mean:.1f} mean (3)"
        )
    if job.quick:
        lines.append("quick run: few scans, and the particle filters are not tuned except for their motion noise")
    return lines


def _format_settings(settings: ParameterValues) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in settings)


def wrong_share_of_tracking(row: dict[str, Any]) -> float | None:
    """Share of the scans in state `tracking` whose pose is wrong; None if no scan is in that state."""
    return row["wrong"] / row["tracking"] if row["tracking"] else None


def _tracking_text(row: dict[str, Any]) -> str:
    share, wrong_share = row["tracking"] / row["scans"], wrong_share_of_tracking(row) or 0.0
    return f"{share:.1%}, {wrong_share:.1%}; {row['longest_wrong_s']:.1f}"


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/real_logs.md."""
    heads = (
        "task, estimator",
        "median (mm)",
        "correct",
        "`tracking`, wrong of these; longest (s)",
        "found",
        "NEES, median",
    )
    rows = [
        [
            f"{LETTERS[row['task']]}, {row['estimator']}",
            results.millimetres(row["error_median_m"]),
            f"{row['correct'] / row['scans']:.1%}",
            _tracking_text(row),
            f"{row['found']}/{row['trials']}" if row["task"] in (GLOBAL, KIDNAPPED) else "–",
            results.number(row["nees_median"], 2),
        ]
        for row in summary.values()
    ]
    return results.markdown(heads, rows)
