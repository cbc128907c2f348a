"""`presage experiment navigation`.

Simulator, estimator and controller run in lockstep in one process. A trial ends when the controller reports that the
goal is reached or refused, or at the time limit. It counts as reached only if the robot truly is at the goal. A trial
number always has the same world, start, goal and heading, whatever the drive and the options.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.messages.definitions import GOAL_TOLERANCE_M
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS, Scanner
from lab.experiments import results
from lab.experiments.trials import run_trials
from lab.navigation import figure as driving_figure
from lab.navigation.drive import MAX_REACHED_DISTANCE, measure
from lab.navigation.in_process import NavigationRun
from lab.navigation.in_process import run as run_in_process
from lab.navigation.shortest_path import START_GOAL_MARGIN, WALL_GAP, NavigationTask, draw_task, load_shortest_paths
from lab.navigation.worlds import GENERATED, seed_of, world_of
from lab.statistics import bootstrap_interval, median, wilson_interval
from services.estimator.factory import EstimatorOptions, EstimatorPreset
from services.simulator.simulation import SimulationSetup

EXPERIMENT_ID = 7  # part of the random seeds
WORLDS, DRIVES = ("maze", "office"), ("holonomic", "differential")
OPTION_VALUES = {
    "drives": DRIVES,
    "start": ("known", "unknown"),
    "estimator": ("precise", "particle-filter"),
    "prior": ("motion", "odometry"),
}
WORST_TRIALS = 5  # trials named in the summary
QUANTITIES = {  # statistics over the trials that reached the goal; the other trials are listed under `worst`
    "path_over_shortest": ("median", "max"),
    "left_m": ("median", "max"),
    "seconds": ("median", "max"),
    "time_over_bound": ("median", "max"),
    "untracked_s": ("median", "max"),
    "claimed_error_max_m": ("max",),
    "error_median_m": ("median",),
    "error_max_m": ("max",),
    "tracking_s": ("median", "max"),
    "replans": ("median", "max"),
}
STATISTICS: dict[str, Callable[[Any], Any]] = {"median": np.median, "max": np.max, "min": np.min}
BOOTSTRAPPED = ("path_over_shortest", "time_over_bound")  # whose medians get an interval


@dataclass(frozen=True)
class NavigationJob:
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
    sweep: bool = False  # whether motion distorts the scans
    slip: float = 0.0  # mean share of its motion that a wheel loses
    beams: int = 622
    range_max: float = SCANNERS["tim571"].range_max  # m
    limit: float = 120.0  # s of simulated time

    @property
    def group(self) -> str:
        """Name of the trial's group in the table, by world and drive."""
        return f"{Path(self.world).stem}, {self.drive}"

    @property
    def world_seed(self) -> int:
        """Seed of the trial's world, if it is generated."""
        return seed_of(self.world, self.seed, self.index)

    @property
    def robot(self) -> Robot:
        """The robot."""
        return Robot.model_validate({"drive": self.drive})

    def task(self) -> NavigationTask:
        """Start and goal."""
        rng = np.random.default_rng((self.seed, EXPERIMENT_ID, self.index))
        return draw_task(self.world, rng, self.robot, self.world_seed)

    def navigation_run(self, task: NavigationTask) -> NavigationRun:
        """Parameters of the drive. In a generated world the estimator predicts scans by casting rays in it."""
        world, seed = world_of(self.world, self.world_seed), (self.seed * 100_003 + self.index) % 2**31
        scanner = {**SCANNERS["tim571"].with_beams(self.beams).model_dump(), "range_max": self.range_max}
        setup = SimulationSetup(
            world,
            Scanner.model_validate(scanner),
            self.robot,
            task.start,
            seed,
            slip=self.slip,
            sweep=self.sweep,
            people=self.people,
            people_speed=self.people_speed,
        )
        start = np.array(task.start) if self.start == "known" else None
        model = "exact" if self.world in GENERATED else "learned"
        estimator = EstimatorOptions(
            world, cast("EstimatorPreset", self.estimator), model, seed=seed, initial_pose=start
        )
        limit = round(self.limit * setup.scanner.rate)
        return NavigationRun(setup, estimator, task.goal, self.prior == "odometry", self.epistemic, limit)


def check(job: NavigationJob, worlds: Sequence[str], drives: Sequence[str]) -> None:
    """Checks the options before anything runs. Raises UserError for unknown or repeated values."""
    for world in worlds:
        world_of(world)
    given = {"drives": drives, "start": (job.start,), "estimator": (job.estimator,), "prior": (job.prior,)}
    for option, values in given.items():
        for value in values:
            if value not in OPTION_VALUES[option]:
                raise UserError(f"--{option} {value!r}: choose from {', '.join(OPTION_VALUES[option])}")
    for option, names in (("worlds", worlds), ("drives", drives)):
        if not names or len(set(names)) < len(names):
            raise UserError(f"--{option} {','.join(names)!r}: give at least one value, and each only once")
    if len({Path(world).stem for world in worlds}) < len(worlds):
        raise UserError("--worlds: two of the files have the same name; rename one, because results are named after it")


def result_name(job: NavigationJob, worlds: Sequence[str], drives: Sequence[str]) -> str:
    """Name of the result: `navigation` and the options that differ from the defaults.

    Results of different options therefore do not overwrite each other.
    """
    parts = [
        *([] if tuple(worlds) == WORLDS else [Path(world).stem for world in worlds]),
        *([] if tuple(drives) == DRIVES else drives),
        *(["unknown"] if job.start == "unknown" else []),
        *([f"people{job.people}"] if job.people else []),
        *([job.estimator] if job.estimator != NavigationJob.estimator else []),
        *([job.prior] if job.prior != NavigationJob.prior else []),
        *([] if job.epistemic else ["no-epistemic"]),
        *(["sweep"] if job.sweep else []),
        *([f"slip{job.slip:g}"] if job.slip else []),
        *([f"beams{job.beams}"] if job.beams != NavigationJob.beams else []),
        *([f"range{job.range_max:g}"] if job.range_max != NavigationJob.range_max else []),
    ]
    return "-".join(["navigation", *parts])


def trial(job: NavigationJob) -> dict[str, Any]:
    """Runs one drive. Returns its statistics."""
    task, robot = job.task(), job.robot
    trace = run_in_process(job.navigation_run(task))
    world, _ = load_shortest_paths(job.world, robot.radius, job.world_seed)
    identity = {"group": job.group, "trial": job.index, "world_seed": job.world_seed, **asdict(task)}
    return identity | measure(trace, task, world, robot)


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of one world and drive. Paths and times are of trials that reached the goal, safety is of all."""
    reached = [row for row in rows if row["reached"]]
    counted = {
        "trials": len(rows),
        "reached": len(reached),
        "reached_share_95": wilson_interval(len(reached), len(rows)),
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
    for quantity in BOOTSTRAPPED:
        counted[f"median_{quantity}_95"] = bootstrap_interval([np.array([row[quantity]]) for row in reached], median)
    for statistic in ("median", "max"):  # of all trials
        counted[f"{statistic}_longest_untracked_s"] = _statistic(rows, "longest_untracked_s", statistic)
    for quantity in ("clearance_m", "clearance_to_people_m"):
        counted[f"min_{quantity}"] = _statistic(rows, quantity, "min")
    counted["median_step_mean_ms"] = _statistic(rows, "step_mean_ms", "median")
    counted["max_step_max_ms"] = _statistic(rows, "step_max_ms", "max")
    return counted | {"reasons_s": _reasons(rows), "worst": worst(rows)}


def _statistic(rows: Sequence[dict[str, Any]], quantity: str, statistic: str) -> float | None:
    values = [row[quantity] for row in rows if row[quantity] is not None]
    return float(STATISTICS[statistic](values)) if values else None


def _reasons(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Seconds for each reason over all trials: the ten longest, longest first."""
    names = {reason for row in rows for reason in row["reason_s"] if not reason.startswith("reached")}
    total = {name: round(sum(row["reason_s"].get(name, 0.0) for row in rows), 3) for name in names}
    return dict(sorted(total.items(), key=lambda pair: (-pair[1], pair[0]))[:10])


def worst(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The worst trials: first those that did not reach the goal, then those with contacts, then the slowest."""
    order = sorted(
        rows, key=lambda r: (r["reached"], -r["contacts_moving"], -r["contacts_standing"], -r["time_over_bound"])
    )
    return [
        {"trial": row["trial"], "outcome": row["outcome"], "why": _describe_trial(row)} for row in order[:WORST_TRIALS]
    ]


def _describe_trial(row: dict[str, Any]) -> str:
    parts = [row["why"]] if row["why"] else []
    if touched := row["contacts_moving"] + row["contacts_standing"]:
        first = row["contact_at"][0]
        where = f"{first['s']:g} s, ({first['x']:.2f}, {first['y']:.2f}), {first['speed']:.2f} m/s"
        parts.append(f"touched something in {touched} scans, first at {where}")
    if row["reached"]:
        parts.append(f"{row['time_over_bound']:.2f} times the least time, {row['path_over_shortest']:.2f} the way")
        seconds_by_reason = {reason: s for reason, s in row["reason_s"].items() if not reason.startswith("reached")}
        if seconds_by_reason:
            longest = max(seconds_by_reason, key=lambda reason: seconds_by_reason[reason])
            parts.append(f"{seconds_by_reason[longest]:.1f} s {longest}")
    return "; ".join(parts)


def run(
    job: NavigationJob,
    trials: int,
    out: Path,
    workers: int,
    console: Console,
    *,
    worlds: Sequence[str] = WORLDS,
    drives: Sequence[str] = DRIVES,
) -> results.Result:
    """Runs all trials of all worlds and drives. Writes NAME.json, .csv, .trials.jsonl, .pdf and .png into ``out``."""
    check(job, worlds, drives)
    name = result_name(job, worlds, drives)
    groups = [replace(job, world=world, drive=drive) for world in worlds for drive in drives]
    # The first trial of every group before the second of any, so that an interrupted run has results for all groups.
    jobs = [replace(group, index=index) for index in range(trials) for group in groups]
    rows = run_trials(name, trial, jobs, out, workers, console)
    by_group = {group.group: [row for row in rows if row["group"] == group.group] for group in groups}
    common = {key: value for key, value in asdict(job).items() if key not in ("index", "world", "drive", "seed")}
    parameters = common | {
        "worlds": list(worlds),
        "drives": list(drives),
        "trials": trials,
        "tolerance_m": GOAL_TOLERANCE_M,
        "truly_m": MAX_REACHED_DISTANCE,
        "spare_m": START_GOAL_MARGIN,
        "gap_m": WALL_GAP,
        "robot": Robot().model_dump(exclude={"drive"}),
    }
    result = results.Result(
        name,
        f"Navigation: {driving_figure.describe(job)}",
        job.seed,
        parameters,
        {group: summarise(group_rows) for group, group_rows in by_group.items()},
        columns(rows),
        rows,
        [_note(job, trials)],
    )
    result.write(out, driving_figure.draw(by_group, {group.group: group.world for group in groups}, result.title))
    return result


def _note(job: NavigationJob, trials: int) -> str:
    return f"{trials} pairs at random in each world, the same for every drive; {driving_figure.describe(job)}."


def columns(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """CSV columns: the single-valued quantities, one row per trial."""
    names = [name for name, value in rows[0].items() if not isinstance(value, (list, tuple, dict))]
    return {name: [row[name] for row in rows] for name in names}


table = driving_figure.table
