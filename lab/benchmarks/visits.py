"""`presage bench visits`: how well a map follows a building whose furniture is moved between visits.

At each visit but the first, furniture is moved and doors are closed. Single scans from unknown poses are then localised
with each of `MODELS`, before and after the map is updated by a drive through the rooms (`presage map --refine`).
"""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from common.geometry.se2 import Array
from common.geometry.shapes import Obstacle
from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import (
    PERIOD_S,
    building_of,
    contains,
    drive_through_rooms,
    errors_of_single_scans,
    found_of,
    learn_at_true_poses,
    write_drive_log,
)
from lab.experiments.results import markdown
from lab.experiments.trials import run_trials
from lab.integrity.buildings import Building, Room
from lab.integrity.cases import BEAMS
from lab.integrity.changes import move_pieces
from lab.statistics import root_mean_square
from presage.learning.map_of_log import MapOptions, map_command
from presage.logs.log import Reading
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.estimator.factory import EstimatorOptions
from services.estimator.precise.learning import weights

ENTERED_SHARE = 0.7  # of the rooms, at each visit but the first; the map cannot follow changes in the others
CLOSED_DOOR_PROBABILITY = 0.3  # for each room that changes
FIRST, BEFORE, AFTER, PRESENT = "first map", "before the update", "after the update", "learned at true poses"
MODELS = (FIRST, BEFORE, AFTER, PRESENT)
# Rooms in the table: whether furniture moves there, and whether the visit's drive entered them; None for either
ROOMS = {
    "all": (None, None),
    "changing, entered": (True, True),
    "changing, not entered": (True, False),
    "unchanging": (False, None),
}
QUIET = Console(quiet=True)


@dataclass(frozen=True)
class VisitsJob:
    """Visits to one building."""

    world: str  # office, or the seed of a generated building
    visits: int
    scans: int  # localised before each update
    seed: int
    out: str  # folder of the maps, logs and models


def bench_visits(
    worlds: int,
    visits: int,
    seed: int,
    scans: int,
    out: Path,
    json_file: Path | None,
    workers: int,
    console: Console,
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    The maps, logs and models are written to ``out``.
    """
    check_file(json_file, "--json")
    make_folder(out)
    names = ["office", *map(str, range(seed, seed + worlds))]
    jobs = [VisitsJob(name, visits, scans, seed, str(out)) for name in names]
    results = run_trials("visits", run_visits, jobs, out, workers, console)
    rows = [row for result in results for row in result["rows"]]
    print(table(rows))
    write_json(json_file, {"rows": rows, "scans": scans, **provenance(seed)})


def run_visits(job: VisitsJob) -> dict[str, Any]:
    """Results of all visits to one building.

    In half of the rooms, all furniture is moved before each visit but the first, and each door may be closed.
    """
    out = Path(job.out) / job.world
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    out.mkdir()
    rng = np.random.default_rng([job.seed, 40])
    building = building_of(job.world)
    rooms = [room for room in building.rooms if room.door is not None]
    changing = [rooms[k] for k in rng.permutation(len(rooms))[: (len(rooms) + 1) // 2]]
    rows = []
    for number in range(1, job.visits + 1):
        closed_doors: list[Obstacle] = []
        if number > 1:
            building = move_furniture_in(building, changing, rng)
            panels = [room.door_panel() for room in changing]
            closed_doors = [panel for panel in panels if panel is not None and rng.random() < CLOSED_DOOR_PROBABILITY]
        scene = Scene.of(building.world_with(closed_doors), BEAMS, [job.seed, number, 41])
        results = _visit(scene, building, changing, number, job.scans, out)
        rows.append({"world": building.name, "visit": number, **results})
    return {"rows": rows}


def _visit(
    scene: Scene, building: Building, changing: list[Room], number: int, count: int, out: Path
) -> dict[str, Any]:
    """Updates the map of the visit before, and localises ``count`` single scans with each model."""
    first, before, after = (out / f"visit-{k}.yaml" for k in (1, number - 1, number))
    poses = scene.poses(count)
    scans = [scene.observe(ranges, float(k)) for k, ranges in enumerate(scene.clean(poses))]
    path = drive_through_rooms(scene, building, 1.0 if number == 1 else ENTERED_SHARE)
    log = after.with_suffix(".npz")
    write_drive_log(scene, path, log)
    options = MapOptions(log, after, reading=Reading(mount=np.array(scene.scanner.mount)), models=after.parent)
    if number == 1:  # built at true poses
        return _map_drive(path, replace(options, poses="reference"))
    row = _map_drive(path, replace(options, refine=str(before)))
    entered = [room for room in building.rooms if contains(room, path[:, :2]).any()]
    row["in_changed_room"], row["in_entered_room"] = (
        np.any([contains(room, poses[:, :2]) for room in rooms], axis=0).tolist() for rooms in (changing, entered)
    )
    for name, file in ((FIRST, first), (BEFORE, before), (AFTER, after)):
        row[name] = errors_of_single_scans(EstimatorOptions(str(file), models=out), scene.scanner, scans, poses)
    present = EstimatorOptions(scene.world, generative_model=learn_at_true_poses(scene))
    row[PRESENT] = errors_of_single_scans(present, scene.scanner, scans, poses)
    return row


def move_furniture_in(building: Building, rooms: list[Room], rng: np.random.Generator) -> Building:
    """The building after all furniture of some rooms was moved to other places of these rooms, if there was room."""
    places = np.array([piece.pose[:2] for piece in building.furniture]).reshape(-1, 2)
    return move_pieces(building, np.any([contains(room, places) for room in rooms], axis=0), rooms, rng)


def _map_drive(path: Array, options: MapOptions) -> dict[str, Any]:
    """Makes a map; returns its size, and the error of the trajectory."""
    begin = time.perf_counter()
    map_command(options, QUIET, QUIET)
    taken = time.perf_counter() - begin
    trajectory = np.loadtxt(options.out.with_suffix(".tum"))
    numbers = np.round(trajectory[:, 0] / PERIOD_S).astype(int)  # scans without a place are left out
    errors = np.hypot(*(trajectory[:, 1:3] - path[numbers, :2]).T)
    return {
        "drive_s": PERIOD_S * len(path),
        "trajectory_rms_m": root_mean_square(errors),
        "update_s": taken,
        "map_bytes": options.out.with_suffix(".pgm").stat().st_size,
        "model_bytes": weights.path_of(options.out.parent, options.out.stem).stat().st_size,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/refinement.md: single scans found of all, and the median error of these in mm.

    Rooms are entered if the visit's drive went there.
    """
    tested = [row for row in rows if PRESENT in row]
    cells = []
    for title, visits in (("second", [row for row in tested if row["visit"] == 2]), ("all", tested)):
        for rooms, (changed, entered) in ROOMS.items():
            cells.append([title, rooms, *(found_of(_errors(visits, name, changed, entered)) for name in MODELS)])
    return markdown(("visits", "rooms", *MODELS), cells)


def _errors(rows: list[dict[str, Any]], model: str, changed: bool | None, entered: bool | None) -> list[float | None]:
    """Errors in m of the single scans in rooms of a kind, as in `ROOMS`."""
    scans = [
        scan for row in rows for scan in zip(row[model], row["in_changed_room"], row["in_entered_room"], strict=True)
    ]
    return [error for error, *room in scans if changed in (None, room[0]) and entered in (None, room[1])]
