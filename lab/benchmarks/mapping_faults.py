"""`presage bench mapping-faults`: drives that could deceive the mapper."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from common.geometry import se2
from common.geometry.occupancy_grid import OCCUPIED
from common.geometry.ray_casting import cast_rays
from common.geometry.se2 import Array
from common.geometry.world import World
from lab.accuracy.runner import provenance
from lab.accuracy.scenes import TWINS, Scene
from lab.benchmarks.mapping import fitted, trajectory_errors
from lab.integrity.buildings import make_building
from lab.integrity.cases import BEAMS
from lab.integrity.changes import KidnappingPlaces, crowd
from presage.terminal.output import check_file, write_json
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.grid import grid_of_scans
from services.mapper.slam.trajectory import build_trajectory
from services.simulator.odometry import Drift, Odometer

CELL_M = 0.05
FALSE_WALL_M = 0.15  # an occupied cell farther than this in front of all surfaces is no surface
PEOPLE_PER_M2 = 0.08

Carry = Callable[[Scene, Array], Array]  # the pose (3,) to which a robot is carried after poses (N, 3)


def to_known(scene: Scene, path: Array) -> Array:
    """A pose of the first third of the path, far from its end, turned at random."""
    first = path[: len(path) // 3]
    place = first[np.argmax(np.hypot(*(first - path[-1])[:, :2].T))]
    return np.array([*place[:2], scene.rng.uniform(-np.pi, np.pi)])


def to_unknown(scene: Scene, path: Array) -> Array:
    """The pose, of 200 random ones, farthest from the path."""
    poses = scene.poses(200)
    distance = np.hypot(*(poses[:, None, :2] - path[None, ::10, :2]).transpose(2, 0, 1)).min(axis=1)
    return np.asarray(poses[np.argmax(distance)])


def to_similar(scene: Scene, path: Array) -> Array:
    """Another place that looks like the last one."""
    return KidnappingPlaces(scene, "similar").after(path[-1])


def to_nearby(scene: Scene, path: Array) -> Array:
    """A place within 2 m of the last one."""
    return KidnappingPlaces(scene, "nearby").after(path[-1])


CASES: dict[str, tuple[str, Carry | None, bool]] = {  # world, how the robot is carried off, crowd
    "undisturbed": ("office", None, False),
    "crowd": ("office", None, True),
    "carried to a mapped place": ("office", to_known, False),
    "carried to an unmapped place": ("office", to_unknown, False),
    "carried to a similar place": ("office", to_similar, False),
    "carried nearby": ("office", to_nearby, False),
    "carried in a crowd": ("office", to_known, True),
    "look-alike rooms": ("symmetric", None, False),
    "carried among look-alike rooms": ("symmetric", to_unknown, False),
    "twins": ("twins", None, False),
    "carried between twins": ("twins", to_similar, False),
}


def make_drive(case: str, seed: int, seconds: float) -> tuple[RawDrive, Array, World]:
    """A drive with odometry, its true poses (N, 3), and its world; the robot is carried off in the middle."""
    kind, carry, people = CASES[case]
    world = TWINS if kind == "twins" else make_building(seed, "symmetric" if kind == "symmetric" else "office").world
    scene = Scene.of(world, BEAMS, [seed, 30])
    parts = [scene.path(seconds if carry is None else seconds / 2)]
    if carry is not None:
        parts.append(scene.path(seconds / 2, start=carry(scene, parts[0])))
    scanner, truth, odom = scene.scanner, np.concatenate(parts), []
    odometer = Odometer(Drift(), scene.rng)
    for part in parts:
        odom.append(odometer.pose)  # wheels do not turn while the robot is carried
        for before, after in pairwise(part):
            odometer.move(before, after)
            odom.append(odometer.pose)
    lasers = se2.compose(truth, np.array(scanner.mount))
    if people:
        discs = crowd(world, truth, scanner.rate, round(PEOPLE_PER_M2 * world.free_area), scene.rng)
        clean = np.concatenate(
            [cast_rays(world, laser, scanner.angles(), each) for laser, each in zip(lasers, discs, strict=True)]
        )
    else:
        clean = scene.clean(truth)
    ranges = np.array([scene.observe(each, 0.0).ranges for each in clean])
    laser = Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max)
    return RawDrive(np.arange(len(truth)) / scanner.rate, ranges, laser, np.array(odom)), truth, world


def bench_mapping_faults(worlds: int, seed: int, seconds: float, json_file: Path | None, console: Console) -> int:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given. Returns exit status 0."""
    check_file(json_file, "--json")
    rows = []
    for case in CASES:
        for number in range(seed, seed + worlds):
            drive, truth, world = make_drive(case, number, seconds)
            for odometry in (True, False):
                with console.status(f"{case}, building {number}"):
                    used = drive if odometry else replace(drive, odom=None)
                    rows.append({"case": case, "seed": number, "odometry": odometry, **map_drive(used, truth, world)})
    _print(rows, console)
    write_json(json_file, {"rows": rows, "seconds": seconds, **provenance(seed)})
    return 0


def map_drive(drive: RawDrive, truth: Array, world: World) -> dict[str, Any]:
    """Errors of the map of a drive."""
    begin = time.perf_counter()
    built = build_trajectory(drive)
    taken = time.perf_counter() - begin
    known = np.isfinite(built.poses).all(axis=1)
    position, _ = trajectory_errors(built.poses[known], truth[known])
    placed = fitted(built.poses[known], truth[known])
    return {
        "placed": float(known.mean()),
        "position_rms_m": float(np.sqrt((position**2).mean())),
        "position_max_m": float(position.max()),
        "false_walls": false_walls(placed, drive.ranges[known], drive.laser, world),
        "closures": len(built.closures),
        "lost": built.unmatched,
        "seconds": taken,
    }


def false_walls(poses: Array, ranges: Array, laser: Laser, world: World) -> float:
    """Share of the occupied cells of a map that are no surfaces of the world."""
    grid = grid_of_scans(poses, ranges, laser, CELL_M)
    row, column = np.nonzero(grid.values == OCCUPIED)
    x, y = grid.corners()[0]
    centres = np.column_stack([x + (column + 0.5) * CELL_M, y + (row + 0.5) * CELL_M])
    return float((world.clearance(centres) > FALSE_WALL_M).mean())


def _print(rows: list[dict[str, Any]], console: Console) -> None:
    table = Table(title="Mapping drives that could deceive")
    for title in ("case", "odometry", "placed", "position RMS, mm", "worst (mm)", "false walls (%)", "time (s)"):
        table.add_column(title)
    for case in CASES:
        for odometry in (True, False):
            of_case = [row for row in rows if row["case"] == case and row["odometry"] == odometry]
            table.add_row(
                case,
                "yes" if odometry else "no",
                " ".join(f"{row['placed']:.0%}" for row in of_case),
                " ".join(f"{row['position_rms_m'] * 1e3:.0f}" for row in of_case),
                f"{max(row['position_max_m'] for row in of_case) * 1e3:.0f}",
                " ".join(f"{row['false_walls'] * 100:.1f}" for row in of_case),
                f"{max(row['seconds'] for row in of_case):.0f}",
            )
    console.print(table)
