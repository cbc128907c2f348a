"""`presage bench visits`: how well a map follows a building whose furniture is moved between visits.

At each visit but the first, furniture is moved and doors are closed. Single scans from unknown poses are then localised
with each of `MODELS`, before and after the map is updated by a drive through the rooms (`presage map --refine`).
"""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.shapes import Obstacle
from common.geometry.world import load_world
from common.robot.scanner import Scanner
from lab.accuracy.furniture import FurniturePiece
from lab.accuracy.scenes import ROBOT, Scene
from lab.accuracy.tasks import is_at
from lab.experiments.results import markdown, millimetres
from lab.experiments.trials import run_trials
from lab.integrity.buildings import Building, Room, make_building, random_place
from lab.integrity.cases import BEAMS
from lab.integrity.changes import MAX_PLACES
from lab.navigation.shortest_path import ShortestPaths
from presage.learning.map_of_log import MapOptions, map_command
from presage.logs.log import Reading
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.field_learning import Recipe, learn_field
from services.estimator.precise.learning.live_learning import ModelVersion
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.interface import Observation

SPEED, TURN_RATE, PERIOD_S = 0.6, 0.5, 0.2  # m/s, rad/s and s between scans of a drive
PLANNING_MARGIN_M = 0.02  # by which the robot is taken to be smaller, because it just fits between some pieces
PLACES_PER_ROOM = 2  # to which a drive goes
ENTERED_SHARE = 0.7  # of the rooms, at each visit but the first; the map cannot follow changes in the others
PRESENT_SCANS = 2000  # from which the model of the present world is learned
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
    moves = [any(contains(room, np.array(piece.pose[:2])[None])[0] for room in rooms) for piece in building.furniture]
    floor, part = building.floor(), replace(building, rooms=tuple(rooms))
    for piece, moved in zip(building.furniture, moves, strict=True):
        if not moved:
            floor.put(piece)
    for piece, moved in zip(building.furniture, moves, strict=True):
        if moved:
            any(floor.put(random_place(part, piece, rng)) for _ in range(MAX_PLACES))
    return building.furnished(floor.pieces)


def contains(room: Room, places: Array) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the places (N, 2) m in map that lie in a room."""
    box = room.box(room.width / 2, room.depth / 2, (room.width, room.depth)).box
    assert box is not None  # noqa: S101 - for the type checker
    return np.asarray((np.abs(places - box.center) < np.array(box.size) / 2).all(axis=1))


def drive_through_rooms(scene: Scene, building: Building, share: float) -> Array:
    """Poses (N, 3), `PERIOD_S` apart, of a drive to some places in each room, or in a ``share`` of the rooms.

    The robot turns all the time.
    """
    paths, rng = ShortestPaths(scene.world, ROBOT.radius - PLANNING_MARGIN_M), scene.rng
    free = scene.world.sample_free(1000, rng, ROBOT.radius)
    corridors = [room for room in building.rooms if room.door is None]
    places = [next(place for place in free if any(contains(room, place[None])[0] for room in corridors))]
    legs = []
    for number in rng.permutation(len(building.rooms)):
        room = building.rooms[number]
        if room.door is not None and rng.random() > share:
            continue
        for place in free[contains(room, free)][-PLACES_PER_ROOM:]:
            leg = paths.path(places[-1], place)
            if len(leg):
                legs += [np.linspace(a, b, 2 + int(np.hypot(*(b - a)) / (SPEED * PERIOD_S))) for a, b in pairwise(leg)]
                places.append(place)
    driven = np.concatenate(legs)
    return np.column_stack([driven, se2.wrap(TURN_RATE * PERIOD_S * np.arange(len(driven)))])


def write_drive_log(scene: Scene, poses: Array, log: Path) -> None:
    """Writes the noisy scans of a drive, `PERIOD_S` apart, with its true poses (N, 3) as reference."""
    np.savez(
        log,
        ranges=np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)]),
        angles=scene.scanner.angles(),
        range_max=np.array(scene.scanner.range_max),
        stamps=PERIOD_S * np.arange(len(poses)),
        reference=poses,
    )


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
        "trajectory_rms_m": float(np.sqrt((errors**2).mean())),
        "update_s": taken,
        "map_bytes": options.out.with_suffix(".pgm").stat().st_size,
        "model_bytes": weights.path_of(options.out.parent, options.out.stem).stat().st_size,
    }


def make_estimator(
    options: EstimatorOptions, scanner: Scanner, version: ModelVersion | None = None
) -> PreciseEstimator:
    """An estimator without a start pose, with a ``version`` of its model if given."""
    estimator = prepare_factory(options)(ScannerGeometry.of(scanner))
    assert isinstance(estimator, PreciseEstimator)  # noqa: S101 - for the type checker
    if version is not None:
        estimator.use_model(version.model, version.seeds)
    return estimator


def errors_of_single_scans(
    options: EstimatorOptions,
    scanner: Scanner,
    scans: list[Observation],
    poses: Array,
    version: ModelVersion | None = None,
) -> list[float | None]:
    """Errors in m of single scans from unknown poses, with a ``version`` of the model if given; None if not found."""
    estimator = make_estimator(options, scanner, version)
    errors: list[float | None] = []
    for scan, pose in zip(scans, poses, strict=True):
        estimator.restart()
        estimate = estimator.update(scan).pose
        errors.append(float(np.hypot(*(estimate - pose)[:2])) if is_at(estimate, pose) else None)
    return errors


def learn_at_true_poses(scene: Scene) -> FieldModel:
    """A field learned from scans with noise at true poses."""
    poses, mount, angles = scene.poses(PRESENT_SCANS), np.array(scene.scanner.mount), scene.scanner.angles()
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    return FieldModel(learn_field(Beams.of(poses, mount, angles, ranges), Recipe(0.05)))


def building_of(name: str) -> Building:
    """The building of `office`, or of the seed in ``name``."""
    return office_building() if name == "office" else make_building(int(name))


def office_building() -> Building:
    """The world `office` as walls, furniture that can be moved, and rooms with a door to the corridor."""
    world = load_world("office")
    furniture, walls = [], []
    for obstacle in world.obstacles:
        if obstacle.box is not None:
            (x, y), yaw = obstacle.box.center, float(np.deg2rad(obstacle.box.yaw_deg))
            furniture.append(FurniturePiece("box", obstacle.box.size, (x, y, yaw)))
        elif obstacle.circle is not None:
            size = 2 * obstacle.circle.radius
            furniture.append(FurniturePiece("disc", (size, size), (*obstacle.circle.center, 0.0)))
        else:
            walls.append(obstacle)
    rooms = (
        Room((0.0, 0.0, 0.0), 4.9, 2.95, 2.2),
        Room((4.95, 0.0, 0.0), 5.7, 2.95, 2.65),
        Room((10.65, 0.0, 0.0), 7.35, 2.95, 2.7),
        Room((7.75, 8.0, np.pi), 7.75, 3.05, 3.35),
        Room((0.0, 2.95, 0.0), 18.0, 2.0),
        Room((7.8, 5.0, 0.0), 10.2, 3.0),
    )
    return Building("office", tuple(world.boundary), tuple(walls), rooms, tuple(furniture))


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


def found_of(errors: list[float | None]) -> str:
    """Single scans found of all, and the median error of these in mm."""
    found = [error for error in errors if error is not None]
    return f"{len(found)}/{len(errors)}; {millimetres(float(np.median(found)) if found else None)}"
