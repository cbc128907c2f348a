"""`presage experiment docking`.

The robot drives to a goal that asks for 3 mm, 0.5 degrees and an approach direction, with a base that is not ideal:
latency, a dead band, and wheels that slip. As in `experiment`, the real processes run in lockstep over zenoh. The
errors are those of the true pose, 1 s after the controller has reported that the goal is reached.

Goals have room for the robot along the whole approach, more than the obstacle stop keeps around it. In every second
trial the robot docks backwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Goal, Pose
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from lab.experiments import results
from lab.experiments.lockstep import LockstepRun, RunTrace, session
from lab.experiments.lockstep import run as run_in_lockstep
from lab.experiments.start_and_goal import StartAndGoal
from lab.experiments.trials import run_trials
from lab.navigation.experiment import DRIVES, WORLDS, columns
from lab.navigation.in_process import SCANS_TO_STAND
from lab.navigation.shortest_path import MAX_DRAWS, NavigationTask, draw_task, load_shortest_paths
from lab.statistics import wilson_interval
from presage.plotting import style as drawing
from services.controller.docking import Docking

EXPERIMENT_ID = 12  # part of the random seeds
TOLERANCE_M, YAW_TOLERANCE_RAD = 0.003, float(np.deg2rad(0.5))
LINE_CLEARANCE_M = 0.13  # beside the footprint: the obstacle stop's gap and five times the scanner's noise


@dataclass(frozen=True)
class DockingJob:
    """One start and goal in one world, with one drive."""

    index: int
    seed: int
    world: str = "maze"
    drive: str = "holonomic"
    slip: float = 0.05
    dead_band: float = 0.02  # m/s
    turn_dead_band: float = 0.05  # rad/s
    latency: float = 0.05  # s
    beams: int = 622
    limit: float = 120.0  # s of simulated time

    def goal(self, task: NavigationTask, approach: float) -> Goal:
        """The goal of a task, approached in the direction ``approach`` rad."""
        yaw = float(se2.wrap(approach + np.pi * (self.index % 2)))
        pose = Pose(x=task.goal[0], y=task.goal[1], yaw=yaw)
        return Goal(
            stamp_ns=0, seq=1, pose=pose, tolerance=TOLERANCE_M, yaw_tolerance=YAW_TOLERANCE_RAD, approach=approach
        )

    def lockstep_run(self, task: NavigationTask, approach: float) -> LockstepRun:
        """Parameters for `lockstep.run`."""
        dead_bands = ("--dead-band", repr(self.dead_band), "--turn-dead-band", repr(self.turn_dead_band))
        base = ("--drive", self.drive, "--latency", repr(self.latency), *dead_bands)
        return LockstepRun(
            StartAndGoal(task.start[:2], task.goal),
            task.start[2],
            self.world,
            self.beams,
            (self.seed * 100_003 + self.index) % 2**31,
            ("--estimator", "precise"),
            round(self.limit * SCANNERS["tim571"].rate),
            controller=base,
            simulator=(*base, "--slip", repr(self.slip)),
            sweep=True,
            ends_with_status=True,
            scans_after_end=SCANS_TO_STAND,
            goal=self.goal(task, approach),
        )


def draw_docking(job: DockingJob) -> tuple[NavigationTask, float]:
    """A random task and approach direction in rad. Raises UserError if the world has no such place."""
    robot, rng = Robot.model_validate({"drive": job.drive}), np.random.default_rng((job.seed, EXPERIMENT_ID, job.index))
    world, _ = load_shortest_paths(job.world, robot.radius)
    for _ in range(MAX_DRAWS):
        task, approach = draw_task(job.world, rng, robot), round(float(rng.uniform(-np.pi, np.pi)), 4)
        line = Docking(job.goal(task, approach), robot).line()
        if (world.clearance(line) >= robot.radius + LINE_CLEARANCE_M).all():
            return task, approach
    raise UserError(f"world {world.name!r}: no place for the robot to dock")


def trial(job: DockingJob) -> dict[str, Any]:
    """Runs one drive. Returns its statistics."""
    task, approach = draw_docking(job)
    with session() as stack:
        trace = run_in_lockstep(job.lockstep_run(task, approach), stack)
    identity = {"drive": job.drive, "world": job.world, "trial": job.index, **asdict(task), "approach": approach}
    return identity | measure(trace, job.goal(task, approach))


def measure(trace: RunTrace, goal: Goal) -> dict[str, Any]:
    """Statistics of one drive; errors are of the last true pose, along and across the approach."""
    pose, target = trace.path()[-1], goal.pose.array()
    along, across = (float(each) for each in se2.rotate(-(goal.approach or 0.0), pose[:2] - target[:2]))
    position, heading = float(np.hypot(along, across)), abs(float(se2.wrap(pose[2] - target[2])))
    last = trace.last_status
    reached = not trace.failure and last is not None and last.state == "reached"
    last_status = f"{last.state}: {last.reason}" if last is not None else "no status"
    counters = trace.health.counters if trace.health is not None else {}
    return {
        "reached": reached,
        "docked": bool(reached and position <= TOLERANCE_M and heading <= YAW_TOLERANCE_RAD),
        "why": "" if reached else trace.failure or last_status,
        "along_m": along,
        "across_m": across,
        "position_m": position,
        "heading_deg": float(np.rad2deg(heading)),
        "seconds": trace.seconds,
        "contacts": sum(truth.contact for truth in trace.truths),
        "step_mean_ms": counters["step_us"] / counters["steps"] * 1e-3 if counters.get("steps") else None,
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics of one drive type, over all of its trials."""
    docked = sum(row["docked"] for row in rows)
    found: dict[str, Any] = {
        "trials": len(rows),
        "reached": sum(row["reached"] for row in rows),
        "docked": docked,
        "docked_share_95": wilson_interval(docked, len(rows)),
        "trials_with_contact": sum(row["contacts"] > 0 for row in rows),
    }
    for quantity in ("position_m", "heading_deg", "seconds"):
        values = [row[quantity] for row in rows]
        found |= {f"{name}_{quantity}": float(np.percentile(values, at)) for name, at in PERCENTILES.items()}
    return found | {"failures": [f"trial {row['trial']}: {row['why']}" for row in rows if not row["reached"]]}


PERCENTILES = {"median": 50, "p95": 95, "max": 100}


def run(job: DockingJob, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """Runs ``trials`` drives with each drive type, half of them in each of the two worlds.

    Writes docking.json, .csv, .trials.jsonl, .pdf and .png into ``out``.
    """
    # Two trials, forwards and backwards, in each world before the next one.
    jobs = [
        replace(job, index=index, drive=drive, world=WORLDS[index // 2 % len(WORLDS)])
        for index in range(trials)
        for drive in DRIVES
    ]
    rows = run_trials("docking", trial, jobs, out, workers, console)
    by_drive = {drive: [row for row in rows if row["drive"] == drive] for drive in DRIVES}
    parameters = {name: value for name, value in asdict(job).items() if name not in ("index", "seed", "world", "drive")}
    result = results.Result(
        "docking",
        "Docking",
        job.seed,
        parameters | {"worlds": list(WORLDS), "tolerance_m": TOLERANCE_M, "yaw_tolerance_rad": YAW_TOLERANCE_RAD},
        {drive: summarise(of_drive) for drive, of_drive in by_drive.items()},
        columns(rows),
        rows,
        [f"{trials} random starts and docks with each drive, in {' and '.join(WORLDS)}, every second one backwards."],
    )
    result.write(out, _figure(by_drive))
    return result


def _figure(by_drive: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """The final positions in the frame of the approach."""
    figure = drawing.empty_figure(8.0, 4.2)
    circle = np.linspace(0, 2 * np.pi, 100)
    for number, (drive, rows) in enumerate(by_drive.items(), start=1):
        axes = drawing.style_axes(figure.add_subplot(1, len(by_drive), number))
        axes.plot(1e3 * TOLERANCE_M * np.cos(circle), 1e3 * TOLERANCE_M * np.sin(circle), color=drawing.GOAL)
        axes.plot([1e3 * row["along_m"] for row in rows], [1e3 * row["across_m"] for row in rows], "k.", markersize=4)
        axes.set(xlabel="error along the approach (mm)", ylabel="across (mm)", aspect="equal", title=drive)
    return figure


def table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The Markdown table of docs/navigation.md. Triples are median, 95th percentile and maximum."""
    heads = ["drive", "within 3 mm and 0.5°", "95 % interval", "position (mm)", "heading (°)", "time (s)", "contacts"]
    rows = [
        [
            drive,
            f"{row['docked']}/{row['trials']}",
            " to ".join(f"{100 * share:.0f} %" for share in row["docked_share_95"]),
            _triple(row, "position_m", 1e3, 2),
            _triple(row, "heading_deg", 1, 2),
            _triple(row, "seconds", 1, 1),
            str(row["trials_with_contact"]),
        ]
        for drive, row in summary.items()
    ]
    failures = [f"- {drive}, {failure}" for drive, row in summary.items() for failure in row["failures"]]
    return "\n\n".join([results.markdown(heads, rows), *(["\n".join(failures)] if failures else [])])


def _triple(row: Mapping[str, Any], quantity: str, factor: float, digits: int) -> str:
    return "; ".join(results.number(factor * row[f"{name}_{quantity}"], digits) for name in PERCENTILES)
