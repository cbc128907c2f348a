"""`presage bench refinement`: what one drive makes of a rough map, of a floor plan, and of nothing."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from common.geometry import se2
from common.geometry.ros_map_writer import write_grid
from common.geometry.se2 import Array
from common.geometry.world import World, load_world, save_world
from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import PERIOD_S, building_of, drive_for, write_drive_log
from lab.experiments.results import markdown, millimetres, number
from lab.experiments.trials import run_trials
from lab.integrity.buildings import Building
from lab.integrity.cases import BEAMS, START_DEVIATION
from lab.integrity.maps import noisy_grid
from lab.statistics import root_mean_square
from presage.learning.map_of_log import MapOptions, map_command
from presage.learning.train_drive import TrainDriveOptions, train_from_drive
from presage.logs.log import Reading
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.learning import weights
from services.estimator.shared.generative_models import GenerativeModel, RayCaster

TEST_SECONDS = 40.0  # length of the second drive, on which the map is tested
WALLS_EVERY = 10  # every 10th scan of the first drive is used to compare the walls
GRID, PLAN, NOTHING = "grid", "floor plan", "nothing"  # a noisy grid of 5 cm cells, or the walls without furniture
ROUGH_SEED, DRIVE_SEED, TEST_SEED = 5, 6, 7  # parts of the random seeds: of the rough map, the drive and the test
SAME_FRAME = np.zeros(3)  # frame of a map in the true world, if the two are the same
QUIET = Console(quiet=True)


@dataclass(frozen=True)
class RefinementJob:
    """One world, and one drive that makes or refines its maps."""

    world: str  # office, or the seed of a generated building
    seed: int
    seconds: float  # length of the drive
    out: str  # folder of the maps, logs and models


def bench_refinement(
    worlds: int, seed: int, seconds: float, out: Path, json_file: Path | None, workers: int, console: Console
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    The maps, logs and models are written to ``out``.
    """
    check_file(json_file, "--json")
    make_folder(out)
    names = ["office", *map(str, range(seed, seed + worlds))]
    jobs = [RefinementJob(name, seed, seconds, str(out)) for name in names]
    results = run_trials("refinement", refine_and_test, jobs, out, workers, console)
    rows = [row for result in results for row in result["rows"]]
    print(table(rows))
    write_json(json_file, {"rows": rows, "seconds": seconds, **provenance(seed)})


def refine_and_test(job: RefinementJob) -> dict[str, Any]:
    """Errors of another drive and of the walls: in each rough map, in what a drive makes of it, and with true poses."""
    building = building_of(job.world)
    world, roughs = _world_and_rough_maps(job, building)
    out = Path(job.out) / job.world
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    out.mkdir()
    drive, test = (Scene.of(world, BEAMS, [job.seed, number]) for number in (DRIVE_SEED, TEST_SEED))
    poses, log = drive_for(drive, building, job.seconds), out / "drive.npz"
    reading = Reading(mount=np.array(drive.scanner.mount))
    write_drive_log(drive, poses, log)
    path = drive_for(test, building, TEST_SECONDS)
    check = ModelTest(drive, poses[::WALLS_EVERY], test, path, test.clean(path))
    true = TrainDriveOptions(log, str(_write(out, world)), out / "true-poses", reading=reading)
    at_true_poses = check.learned(train_from_drive(true, QUIET), world, SAME_FRAME)
    rows = []
    for start, rough in roughs.items():
        file = "" if rough is None else str(_write(out, rough))
        made = out / f"{start.replace(' ', '-')}-driven.yaml"
        begin = time.perf_counter()
        map_command(MapOptions(log, made, reading=reading, refine=file, models=out), QUIET, QUIET)
        taken = time.perf_counter() - begin
        placed, truths = _trajectory(made.with_suffix(".tum"), poses)
        frame = se2.alignment(placed, truths)
        aligned = np.hypot(*(se2.compose(frame, placed) - truths)[:, :2].T)
        row = {
            "world": world.name,
            "start": start,
            "seconds": taken,
            "placed": len(placed) / len(poses),
            "trajectory_rms_m": root_mean_square(aligned),
            "frame_error_m": None if rough is None else float(np.hypot(*(placed - truths)[:, :2].mean(axis=0))),
            "rough": None if rough is None else check.rough(rough),
            "after": check.learned(weights.path_of(out, made.stem), load_world(str(made)), frame),
            "at_true_poses": at_true_poses,
        }
        rows.append(row)
    return {"rows": rows}


@dataclass(frozen=True)
class ModelTest:
    """Compares a model with the true world: its walls along one drive, and poses found in it on another one."""

    drive: Scene
    poses: Array  # (N, 3) base_link in the true world, on the drive from which maps are made
    test: Scene
    path: Array  # (M, 3) the same, on the other drive
    clean: Array  # (M, B) m, the ranges there without noise

    def rough(self, world: World) -> dict[str, float]:
        """Errors in a map without learning, whose frame is that of the true world."""
        return self._errors(RayCaster(world), EstimatorOptions(world, model="exact"), SAME_FRAME)

    def learned(self, file: Path, world: World, frame: Array) -> dict[str, float]:
        """Errors with the weights ``file`` of a map, whose ``frame`` (3,) is given in the true world."""
        return self._errors(weights.load(file)[0], EstimatorOptions(world, model=str(file)), frame)

    def _errors(self, model: GenerativeModel, options: EstimatorOptions, frame: Array) -> dict[str, float]:
        found, tracking = self._localise(options, frame)
        errors, in_frame = (np.hypot(*(poses - self.path)[:, :2].T) for poses in (se2.compose(frame, found), found))
        walls = wall_errors(model, se2.compose(se2.inverse(frame), self.poses), self.drive, frame)
        return {
            "position_median_m": float(np.median(errors)),
            "position_rms_m": root_mean_square(errors),
            "position_max_m": float(errors.max()),
            "position_in_frame_median_m": float(np.median(in_frame)),  # the map's frame taken for that of the world
            "position_in_frame_rms_m": root_mean_square(in_frame),
            "tracking": float(tracking.mean()),
            "walls_median_m": float(np.median(walls)),
            "walls_rms_m": root_mean_square(walls),
        }

    def _localise(self, options: EstimatorOptions, frame: Array) -> tuple[Array, Array]:
        """Poses (M, 3) of the other drive's scans in the map, and whether they are reported as `tracking`."""
        rng = np.random.default_rng(0)  # all models get the same scans
        scene = Scene(self.test.world, self.test.scanner, rng)
        estimator = prepare_factory(options)(ScannerGeometry.of(scene.scanner))
        start = self.path[0] + START_DEVIATION * rng.standard_normal(3)
        estimator.restart(se2.compose(se2.inverse(frame), start), np.diag(START_DEVIATION**2))
        scans = (scene.observe(ranges, k * PERIOD_S) for k, ranges in enumerate(self.clean))
        found = [estimator.update(scan) for scan in scans]
        return np.array([each.pose for each in found]), np.array([each.state == "tracking" for each in found])


def wall_errors(model: GenerativeModel, poses: Array, scene: Scene, frame: Array) -> Array:
    """Distances in m from the surfaces that a model predicts along the beams of a drive to those of the true world.

    ``poses`` (N, 3) are those of base_link in the model's map, whose ``frame`` (3,) is given in the true world.
    """
    lasers, angles = se2.compose(poses, np.array(scene.scanner.mount)), scene.scanner.angles()
    expected = model.expect(lasers, angles)
    known = np.isfinite(expected.scale) & (expected.ranges < scene.scanner.range_max)
    row, beam = np.nonzero(known)
    directions = lasers[row, 2] + angles[beam]
    unit = np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    ends = lasers[row, :2] + expected.ranges[known][:, None] * unit
    return np.abs(scene.world.surface_distance(se2.transform(frame, ends)))


def _world_and_rough_maps(job: RefinementJob, building: Building) -> tuple[World, dict[str, World | None]]:
    """The world of a job, and the maps with which its drive begins."""
    world = load_world("office") if job.world == "office" else building.world
    roughs: dict[str, World | None] = {GRID: noisy_grid(Scene.of(world, BEAMS, [job.seed, ROUGH_SEED]))}
    if job.world != "office":
        boundary, walls = list(building.boundary), list(building.walls)
        roughs[PLAN] = World(name=f"{building.name}-plan", boundary=boundary, obstacles=walls)
    return world, {**roughs, NOTHING: None}


def _write(folder: Path, world: World) -> Path:
    """Writes a map of the benchmark to a file."""
    if world.grid is not None:
        return write_grid(folder, world.name, world.grid)
    path = folder / f"{world.name}.yaml"
    path.write_text(save_world(world), encoding="utf-8")
    return path


def _trajectory(tum: Path, poses: Array) -> tuple[Array, Array]:
    """Poses (K, 3) of a trajectory in TUM format, and the true ones of the same scans, of those in ``poses`` (N, 3)."""
    rows = np.loadtxt(tum)
    placed = np.column_stack([rows[:, 1:3], 2 * np.arctan2(rows[:, 6], rows[:, 7])])
    return placed, poses[np.round(rows[:, 0] / PERIOD_S).astype(int)]


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/refinement.md, in mm: medians, and RMS after a semicolon."""

    def pair(errors: dict[str, float] | None, quantity: str) -> str:
        if errors is None:
            return "–"
        return "; ".join(millimetres(errors[f"{quantity}_{kind}_m"]) for kind in ("median", "rms"))

    heads = (
        "world",
        "start",
        "rough map",
        "after the drive",
        "frame aligned",
        "at true poses",
        "ratio",
        "rough walls",
        "walls",
        "trajectory RMS",
        "`tracking`",
    )
    cells = [
        [
            row["world"],
            row["start"],
            pair(row["rough"], "position"),
            "–" if row["rough"] is None else pair(row["after"], "position_in_frame"),
            pair(row["after"], "position"),
            pair(row["at_true_poses"], "position"),
            number(row["after"]["position_median_m"] / row["at_true_poses"]["position_median_m"], 2),
            pair(row["rough"], "walls"),
            pair(row["after"], "walls"),
            millimetres(row["trajectory_rms_m"]),
            f"{row['after']['tracking']:.1%}",
        ]
        for row in rows
    ]
    return markdown(heads, cells)
