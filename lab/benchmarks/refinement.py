"""`presage bench refinement`."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from common.geometry.ros_map_writer import write_grid
from common.geometry.se2 import Array
from common.geometry.world import World, load_world
from lab.accuracy.runner import provenance
from lab.accuracy.scenes import Scene
from lab.experiments.trials import run_trials
from lab.integrity.buildings import make_building
from lab.integrity.cases import BEAMS, START_DEVIATION
from lab.integrity.maps import noisy_grid
from presage.learning.map_of_log import MapOptions, map_command
from presage.learning.train_drive import TrainDriveOptions, train_from_drive
from presage.logs.log import Reading
from presage.terminal.output import check_file, make_folder, write_json
from services.estimator.factory import EstimatorOptions, Factory, Geometry, prepare

EVERY = 3  # scan of the drive that refines is in its log, as of a scanner with 5 Hz
TEST_SECONDS = 40.0  # length of the other drive
ROUGH_SEED, DRIVE_SEED, TEST_SEED = 5, 6, 7
QUIET = Console(quiet=True)


@dataclass(frozen=True)
class RefinementJob:
    """One rough map and one drive that refines it."""

    world: str  # office, or the seed of a generated building
    rough: Literal["grid", "floor plan"]  # a noisy grid of 5 cm cells, or the walls without furniture
    seed: int
    seconds: float  # length of the drive
    out: str  # folder of the maps, logs and models


def bench_refinement(
    worlds: int, seed: int, seconds: float, out: Path, json_file: Path | None, workers: int, console: Console
) -> int:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given. Returns exit status 0.

    The maps, logs and models are written to ``out``.
    """
    check_file(json_file, "--json")
    make_folder(out, "--out")
    numbers = range(seed, seed + worlds)
    jobs = [
        RefinementJob("office", "grid", seed, seconds, str(out)),
        *(RefinementJob(str(number), "grid", number, seconds, str(out)) for number in numbers),
        *(RefinementJob(str(number), "floor plan", number, seconds, str(out)) for number in numbers),
    ]
    results = run_trials("refinement", refine_and_test, jobs, out, workers, console)
    rows = [row for result in results for row in result["rows"]]
    _print(rows, console)
    write_json(json_file, {"rows": rows, "seconds": seconds, **provenance(seed)})
    return 0


def refine_and_test(job: RefinementJob) -> dict[str, Any]:
    """Errors of another drive in the rough map, in what `presage map --refine` makes of it, and with true poses."""
    world, plan = _world_and_plan(job)
    seed, out = job.seed, Path(job.out) / f"{job.world}-{job.rough}".replace(" ", "-")
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    out.mkdir()
    rough = plan if job.rough == "floor plan" else noisy_grid(Scene.of(world, BEAMS, [seed, ROUGH_SEED]))
    rough_file, log = _write(out, rough), out / f"{rough.name}.npz"
    drive, test = (Scene.of(world, BEAMS, [seed, number]) for number in (DRIVE_SEED, TEST_SEED))
    scanner = drive.scanner
    poses, mount = drive.path(job.seconds)[::EVERY], np.array(scanner.mount)
    ranges = np.array([drive.observe(clean, 0.0).ranges for clean in drive.clean(poses)])
    stamps = np.arange(len(poses)) * EVERY / scanner.rate
    angles, range_max = scanner.angles(), np.array(scanner.range_max)
    np.savez(log, ranges=ranges, angles=angles, range_max=range_max, stamps=stamps, reference=poses)
    reading, refined, true = Reading(mount=mount), out / f"{rough.name}-refined.yaml", out / "true-poses"
    begin = time.perf_counter()
    map_command(MapOptions(log, refined, reading=reading, refine=str(rough_file), models=out), QUIET, QUIET)
    taken = time.perf_counter() - begin
    train_from_drive(TrainDriveOptions(log, str(rough_file), true, reading=reading), QUIET)
    factories = {
        "rough map": EstimatorOptions(str(rough_file), model="exact"),
        "refined": EstimatorOptions(str(refined), models=out),
        "learned at true poses": EstimatorOptions(str(rough_file), models=true),
    }
    path = test.path(TEST_SECONDS)
    clean = test.clean(path)
    errors = np.hypot(*(_read_tum(refined.with_suffix(".tum")) - poses[:, :2]).T)
    start = path[0] + START_DEVIATION * test.rng.standard_normal(3)
    rows = []
    for name, options in factories.items():
        found, tracking = _localise(prepare(options), test, clean, start)
        error = np.hypot(*(found - path)[:, :2].T)
        row = {
            "world": world.name,
            "rough": job.rough,
            "model": name,
            "position_median_m": float(np.median(error)),
            "position_rms_m": float(np.sqrt((error**2).mean())),
            "position_max_m": float(error.max()),
            "tracking": float(tracking.mean()),
        }
        if name == "refined":
            row |= {"trajectory_rms_m": float(np.sqrt((errors**2).mean())), "seconds": taken}
        rows.append(row)
    return {"rows": rows}


def _world_and_plan(job: RefinementJob) -> tuple[World, World]:
    """The world of a job, and its walls without furniture."""
    if job.world == "office":
        world = load_world("office")
        return world, world
    building = make_building(int(job.world))
    plan = World(name=f"{building.name}-plan", boundary=list(building.boundary), obstacles=list(building.walls))
    return building.world, plan


def _write(folder: Path, rough: World) -> Path:
    """Writes a map of the benchmark to a file."""
    if rough.grid is not None:
        return write_grid(folder, rough.name, rough.grid)
    path = folder / f"{rough.name}.yaml"
    path.write_text(yaml.safe_dump(rough.model_dump(mode="json", exclude_defaults=True)), encoding="utf-8")
    return path


def _read_tum(path: Path) -> Array:
    """Positions (N, 2) m of a trajectory in TUM format."""
    return np.asarray(np.loadtxt(path)[:, 1:3])


def _localise(factory: Factory, scene: Scene, clean: Array, start: Array) -> tuple[Array, Array]:
    """Poses (N, 3) of a drive's scans, and whether they are reported as `tracking`."""
    estimator = factory(Geometry.of(scene.scanner))
    estimator.restart(start, np.diag(START_DEVIATION**2))
    found = [estimator.update(scene.observe(ranges, k / scene.scanner.rate)) for k, ranges in enumerate(clean)]
    return np.array([each.pose for each in found]), np.array([each.state == "tracking" for each in found])


def _print(rows: list[dict[str, Any]], console: Console) -> None:
    table = Table(title="Localising another drive, position error in mm")
    for title in ("world", "rough map", "model", "median", "RMS", "maximum", "tracking"):
        table.add_column(title)
    for row in rows:
        numbers = [f"{row[name] * 1e3:.1f}" for name in ("position_median_m", "position_rms_m", "position_max_m")]
        table.add_row(row["world"], row["rough"], row["model"], *numbers, f"{row['tracking']:.1%}")
    console.print(table)
