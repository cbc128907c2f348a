"""`presage experiment navigation`.

The real processes (router, simulator, estimator, controller) run in lockstep over zenoh. A trial ends when the
controller says that the goal is reached, and is reached if that is true; or refused, or given up at the limit. The same
number is the same start, goal and heading with every drive and every option.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.geometry.world import load_world
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from lab.experiments import results
from lab.experiments.journeys import Journey
from lab.experiments.lockstep import LockstepRun, session
from lab.experiments.lockstep import run as run_in_lockstep
from lab.experiments.trials import run_trials
from lab.navigation import figure as driving_figure
from lab.navigation.drive import MAX_REACHED_DISTANCE, TOLERANCE, measure
from lab.navigation.shortest_path import MIN_TRIP_LENGTH, START_GOAL_MARGIN, WALL_GAP, draw_trip, load_ways

EXPERIMENT_ID = 7  # of the experiment, in its seeds
WORLDS, DRIVES = ("maze", "office"), ("holonomic", "differential")
OPTION_VALUES = {
    "drives": DRIVES, "start": ("known", "unknown"), "estimator": ("precise", "particle-filter"),
    "prior": ("motion", "odometry"),
}  # fmt: skip
WORST_TRIALS = 5  # trials named in the summary
QUANTITIES = {  # of reached trials; others by name in `worst`
    "path_over_shortest": ("median", "max"), "time_over_least": ("median", "max"), "seconds": ("median", "max"),
    "time_over_bound": ("median", "max"), "untracked_s": ("median", "max"), "claimed_error_max_m": ("max",),
    "error_median_m": ("median",), "error_max_m": ("max",), "tracking_s": ("median", "max"),
    "replans": ("median", "max"),
}  # fmt: skip
STATISTICS: dict[str, Callable[[Any], Any]] = {"median": np.median, "max": np.max, "min": np.min}


@dataclass(frozen=True)
class Job:
    """One start and goal in one world, with one drive."""

    index: int
    seed: int
    world: str = "maze"
    drive: str = "holonomic"
    start: str = "known"
    people: int = 0
    people_speed: float = 1.0  # m/s
    estimator: str = "precise"
    prior: str = "motion"
    epistemic: bool = True
    beams: int = 622
    limit: float = 120.0  # s of simulated time

    @property
    def group(self) -> str:
        """As the table has it."""
        return f"{Path(self.world).stem}, {self.drive}"

    def lockstep_run(self, journey: Journey, yaw: float) -> LockstepRun:
        """For `lockstep.run`."""
        seeks = "--epistemic" if self.epistemic else "--no-epistemic"
        people = ("--people", str(self.people), "--people-speed", repr(self.people_speed)) if self.people else ()
        return LockstepRun(
            journey, yaw, self.world, self.beams, (self.seed * 100_003 + self.index) % 2**31,
            ("--estimator", self.estimator, "--prior", self.prior),
            round(self.limit * SCANNERS["tim571"].rate),
            controller=("--preset", "geodesic", "--drive", self.drive, seeks),
            simulator=("--drive", self.drive, *people),
            start_known=self.start == "known",
            ends_with_status=True,
        )  # fmt: skip


def check(job: Job, worlds: Sequence[str], drives: Sequence[str]) -> None:
    """Raises UserError for a world or a choice that there is not, before anything runs."""
    for world in worlds:
        load_world(world)
    asked = {"drives": drives, "start": (job.start,), "estimator": (job.estimator,), "prior": (job.prior,)}
    for option, values in asked.items():
        for value in values:
            if value not in OPTION_VALUES[option]:
                raise UserError(f"--{option} {value!r}: choose from {', '.join(OPTION_VALUES[option])}")
    for option, these in (("worlds", worlds), ("drives", drives)):
        if not these or len(set(these)) < len(these):
            raise UserError(f"--{option} {','.join(these)!r}: give each once, and one at least")
    if len({Path(world).stem for world in worlds}) < len(worlds):
        raise UserError("--worlds: two files have one name; rename one of them")


def result_name(job: Job, worlds: Sequence[str], drives: Sequence[str]) -> str:
    """`navigation`, and whatever is not as by default, so that no result overwrites that of another question."""
    parts = [
        *([] if tuple(worlds) == WORLDS else [Path(world).stem for world in worlds]),
        *([] if tuple(drives) == DRIVES else drives),
        *(["unknown"] if job.start == "unknown" else []),
        *([f"people{job.people}"] if job.people else []),
        *([f"{job.people_speed:g}mps"] if job.people and job.people_speed != Job.people_speed else []),
        *([job.estimator] if job.estimator != Job.estimator else []),
        *([job.prior] if job.prior != Job.prior else []),
        *([] if job.epistemic else ["no-epistemic"]),
        *([f"beams{job.beams}"] if job.beams != Job.beams else []),
    ]
    return "-".join(["navigation", *parts])


def trial(job: Job) -> dict[str, Any]:
    """One drive; what became of it."""
    robot = Robot.model_validate({"drive": job.drive})
    trip = draw_trip(job.world, np.random.default_rng((job.seed, EXPERIMENT_ID, job.index)), robot)
    with session() as stack:
        trace = run_in_lockstep(job.lockstep_run(Journey(trip.start[:2], trip.goal), trip.start[2]), stack)
    world, _ = load_ways(job.world, robot.radius)
    about = {"group": job.group, "trial": job.index, **asdict(trip)}
    return about | measure(trace, trip, world, robot)


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of one world and drive; ways and times are of trials that were reached, safety is of all."""
    reached = [row for row in rows if row["reached"]]
    counted = {
        "trials": len(rows),
        "reached": len(reached),
        **{
            f"trials_{outcome.replace(' ', '_')}": sum(row["outcome"] == outcome for row in rows)
            for outcome in ("claimed elsewhere", "refused", "too late", "failed")
        },
        "trials_with_contact_moving": sum(row["contacts_moving"] > 0 for row in rows),
        "trials_with_contact_standing": sum(row["contacts_standing"] > 0 for row in rows),
        "scans_held_back": sum(row["held_back"] for row in rows),
        "seconds_blocked": round(sum(row["state_s"].get("blocked", 0.0) for row in rows), 3),
    }
    for quantity, statistics in QUANTITIES.items():
        for statistic in statistics:
            counted[f"{statistic}_{quantity}"] = _statistic(reached, quantity, statistic)
    for quantity in ("clearance_m", "clearance_to_people_m"):
        counted[f"min_{quantity}"] = _statistic(rows, quantity, "min")
    counted["median_step_mean_ms"] = _statistic(rows, "step_mean_ms", "median")
    counted["max_step_max_ms"] = _statistic(rows, "step_max_ms", "max")
    return counted | {"reasons_s": _reasons(rows), "worst": worst(rows)}


def _statistic(rows: Sequence[dict[str, Any]], quantity: str, statistic: str) -> float | None:
    values = [row[quantity] for row in rows if row[quantity] is not None]
    return float(STATISTICS[statistic](values)) if values else None


def _reasons(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Seconds over all trials, the longest first."""
    names = {reason for row in rows for reason in row["reason_s"] if not reason.startswith("reached")}
    total = {name: round(sum(row["reason_s"].get(name, 0.0) for row in rows), 3) for name in names}
    return dict(sorted(total.items(), key=lambda pair: (-pair[1], pair[0]))[:10])


def worst(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The numbers of those not reached, then of those that touched something moving or standing, then the slowest."""
    order = sorted(
        rows, key=lambda r: (r["reached"], -r["contacts_moving"], -r["contacts_standing"], -r["time_over_least"])
    )
    return [{"trial": row["trial"], "outcome": row["outcome"], "why": _why(row)} for row in order[:WORST_TRIALS]]


def _why(row: dict[str, Any]) -> str:
    parts = [row["why"]] if row["why"] else []
    if touched := row["contacts_moving"] + row["contacts_standing"]:
        first = row["contact_at"][0]
        where = f"{first['s']:g} s, ({first['x']:.2f}, {first['y']:.2f}), {first['speed']:.2f} m/s"
        parts.append(f"touched something in {touched} scans, first at {where}")
    if row["reached"]:
        parts.append(f"{row['time_over_least']:.2f} times the least time, {row['path_over_shortest']:.2f} the way")
        said = {reason: s for reason, s in row["reason_s"].items() if not reason.startswith("reached")}
        if said:
            longest = max(said, key=lambda reason: said[reason])
            parts.append(f"{said[longest]:.1f} s {longest}")
    return "; ".join(parts)


def run(
    job: Job, trials: int, out: Path, workers: int, console: Console, *, worlds: Sequence[str] = WORLDS,
    drives: Sequence[str] = DRIVES,
) -> results.Result:  # fmt: skip
    """All trials of all worlds and drives; writes NAME.json, .csv, .trials.jsonl, .pdf and .png into ``out``."""
    check(job, worlds, drives)
    name = result_name(job, worlds, drives)
    groups = [replace(job, world=world, drive=drive) for world in worlds for drive in drives]
    # The first of each before the second of any: a run cut short says something of all.
    jobs = [replace(group, index=index) for index in range(trials) for group in groups]
    rows = run_trials(name, trial, jobs, out, workers, console)
    by_group = {group.group: [row for row in rows if row["group"] == group.group] for group in groups}
    common = {key: value for key, value in asdict(job).items() if key not in ("index", "world", "drive", "seed")}
    parameters = common | {
        "worlds": list(worlds), "drives": list(drives), "trials": trials, "tolerance_m": TOLERANCE, "truly_m": MAX_REACHED_DISTANCE,
        "apart_m": MIN_TRIP_LENGTH, "spare_m": START_GOAL_MARGIN, "gap_m": WALL_GAP, "robot": Robot().model_dump(exclude={"drive"}),
    }  # fmt: skip
    result = results.Result(
        name, f"Navigation: {driving_figure.describe(job)}", job.seed, parameters,
        {group: summarise(of) for group, of in by_group.items()}, columns(rows), rows, [_note(job, trials)],
    )  # fmt: skip
    result.write(out, driving_figure.draw(by_group, {group.group: group.world for group in groups}, result.title))
    return result


def _note(job: Job, trials: int) -> str:
    return f"{trials} pairs at random in each world, the same for every drive; {driving_figure.describe(job)}."


def columns(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """One row a trial, of what is one value."""
    names = [name for name, value in rows[0].items() if not isinstance(value, (list, tuple, dict))]
    return {name: [row[name] for row in rows] for name in names}


table = driving_figure.table
