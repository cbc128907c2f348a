"""`presage experiment exploration`.

presage's explorer and a nearest-frontier explorer explore the same buildings from the same random starts, with the same
noise: simulator, mapper and controller in one process, in lockstep, with motion-distorted scans and drifting odometry.
A map is made every second, as in the mapper's service.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from common.geometry.world import World, load_world
from common.robot.robot import Robot
from lab.experiments import results
from lab.experiments.trials import run_trials
from lab.exploration.drive import explore, measure
from lab.exploration.nearest_frontier import nearest_frontier
from lab.integrity.buildings import make_building
from services.controller.policies.exploration import choose_viewpoint

EXPERIMENT_ID = 21  # part of the random seeds
EXPLORERS = {"presage": choose_viewpoint, "nearest frontier": nearest_frontier}
START_CLEARANCE_M = 0.5  # from walls and furniture
MIN_MAPPED_SHARE, MAX_RETURN_ERROR_M = 0.95, 0.02  # an exploration that meets them counts as good


@dataclass(frozen=True)
class ExplorationJob:
    """One exploration."""

    seed: int
    index: int = 0  # of the start
    world: str = "maze"  # a world, or the number of a generated building
    explorer: str = "presage"
    beams: int = 622
    limit: float = 900.0  # s of simulated time


def world_of(name: str) -> World:
    """A world by its name, or the generated building of a number."""
    return make_building(int(name)).world if name.isdigit() else load_world(name)


def trial(job: ExplorationJob) -> dict[str, Any]:
    """Runs one exploration. Returns its statistics."""
    world, robot = world_of(job.world), Robot()
    rng = np.random.default_rng((job.seed, EXPERIMENT_ID, job.index))
    start = world.sample_poses(1, rng, START_CLEARANCE_M)[0]
    run = explore(world, robot, EXPLORERS[job.explorer], start, job.seed + job.index, job.limit, beams=job.beams)
    return {"world": job.world, "start": job.index, "explorer": job.explorer, **measure(run, world, robot)}


def run(
    job: ExplorationJob, starts: int, worlds: Sequence[str], buildings: int, out: Path, workers: int, console: Console
) -> results.Result:
    """Explores each world from ``starts`` places, and ``buildings`` generated ones from one place each.

    Writes exploration.json, .csv and .trials.jsonl into ``out``.
    """
    places = [(world, index) for index in range(starts) for world in worlds]
    places += [(str(100 * job.seed + number), 0) for number in range(buildings)]
    jobs = [replace(job, world=world, index=index, explorer=each) for world, index in places for each in EXPLORERS]
    rows = run_trials("exploration", trial, jobs, out, workers, console)
    result = results.Result(
        "exploration",
        "Exploration",
        job.seed,
        {"beams": job.beams, "limit": job.limit, "starts": starts, "worlds": list(worlds), "buildings": buildings},
        summarise(rows),
        {name: [row[name] for row in rows] for name in rows[0]},
        rows,
        [f"{len(places)} explorations by each explorer; a number is that of a generated building."],
    )
    result.write(out, None)
    return result


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics of each explorer, over all of its trials."""
    by_explorer = {name: [row for row in rows if row["explorer"] == name] for name in EXPLORERS}
    # Paths are compared where both explorers came back.
    came_back = [all(row["phase"] == "finished" for row in pair) for pair in zip(*by_explorer.values(), strict=True)]
    path = {name: np.array([row["path_m"] for row in trials])[came_back] for name, trials in by_explorer.items()}
    found = {}
    for name, trials in by_explorer.items():
        ratio = path[name] / path["nearest frontier"]
        found[name] = {
            "trials": len(trials),
            "finished": sum(row["phase"] == "finished" for row in trials),
            "mapped_95": sum(row["mapped_share"] >= MIN_MAPPED_SHARE for row in trials),
            "least_mapped_share": min(row["mapped_share"] for row in trials),
            "median_mapped_share": float(np.median([row["mapped_share"] for row in trials])),
            "least_mapped_share_tight": min(row["mapped_share_tight"] for row in trials),
            "returned_2cm": sum(row["return_error_m"] <= MAX_RETURN_ERROR_M for row in trials),
            "median_return_error_m": float(np.median([row["return_error_m"] for row in trials])),
            "max_return_error_m": max(row["return_error_m"] for row in trials),
            "trials_with_contact": sum(row["contact_scans"] > 0 for row in trials),
            "compared": len(ratio),
            "total_path_m": float(path[name].sum()),
            "median_path_ratio": float(np.median(ratio)) if len(ratio) else None,
            "max_path_ratio": float(ratio.max()) if len(ratio) else None,
            "total_seconds": float(sum(row["seconds"] for row in trials)),
        }
    return found


def table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The Markdown table of docs/exploration.md."""
    heads = ["explorer", "finished", "95 % mapped", "mapped (%)", "within 2 cm", "return error (mm)", "contacts"]
    heads += ["path (m)", "path / nearest frontier", "time (s)"]
    rows = [
        [
            name,
            f"{row['finished']}/{row['trials']}",
            f"{row['mapped_95']}/{row['trials']}",
            f"{100 * row['median_mapped_share']:.1f}; {100 * row['least_mapped_share']:.1f}",
            f"{row['returned_2cm']}/{row['trials']}",
            f"{1e3 * row['median_return_error_m']:.1f}; {1e3 * row['max_return_error_m']:.1f}",
            str(row["trials_with_contact"]),
            f"{row['total_path_m']:.0f}",
            f"{results.number(row['median_path_ratio'], 2)}; {results.number(row['max_path_ratio'], 2)}",
            f"{row['total_seconds']:.0f}",
        ]
        for name, row in summary.items()
    ]
    return results.markdown(heads, rows)
