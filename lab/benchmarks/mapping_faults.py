"""`presage bench mapping-faults`: drives that could deceive the mapper.

Errors are measured in the frame in which the part of the drive before the disturbance fits best.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from common.geometry import se2
from common.geometry.occupancy_grid import OCCUPIED
from common.geometry.ray_casting import cast_rays
from common.geometry.se2 import Array
from common.geometry.world import World
from lab.accuracy.scenes import TWINS, Scene
from lab.accuracy.tasks import is_at
from lab.experiments.results import markdown, millimetres, number
from lab.integrity.buildings import make_building
from lab.integrity.cases import BEAMS
from lab.integrity.changes import KidnappingPlaces, crowd
from lab.statistics import root_mean_square
from presage.terminal.output import check_file, provenance, write_json
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.grid import grid_of_scans
from services.mapper.slam.trajectory import build_trajectory
from services.simulator.odometry import Odometer, OdometryNoise

CELL_M = 0.05
FALSE_WALL_M = 0.15  # an occupied cell farther than this in front of all surfaces is no surface
PEOPLE_PER_M2 = 0.08

ChoosePlace = Callable[[Scene, Array], Array]  # returns the pose (3,) to which the robot is carried after a path (N, 3)


@dataclass(frozen=True)
class MappingFault:
    """What could deceive the mapper in a drive."""

    world: Literal["office", "symmetric", "twins"] = "office"
    kidnapping: ChoosePlace | None = None  # in the middle of the drive
    crowd: bool = False


def to_mapped_place(scene: Scene, path: Array) -> Array:
    """A pose of the first third of the path, far from its end, turned at random."""
    first = path[: len(path) // 3]
    place = first[np.argmax(np.hypot(*(first - path[-1])[:, :2].T))]
    return np.array([*place[:2], scene.rng.uniform(-np.pi, np.pi)])


def to_unmapped_place(scene: Scene, path: Array) -> Array:
    """The pose, of 200 random ones, farthest from the path."""
    poses = scene.poses(200)
    distance = np.hypot(*(poses[:, None, :2] - path[None, ::10, :2]).transpose(2, 0, 1)).min(axis=1)
    return np.asarray(poses[np.argmax(distance)])


def to_similar_place(scene: Scene, path: Array) -> Array:
    """Another place that looks like the last one."""
    return KidnappingPlaces(scene, "similar").after(path[-1])


def to_nearby(scene: Scene, path: Array) -> Array:
    """A place within 2 m of the last one."""
    return KidnappingPlaces(scene, "nearby").after(path[-1])


CASES = {
    "undisturbed": MappingFault(),
    "crowd": MappingFault(crowd=True),
    "carried to a mapped place": MappingFault(kidnapping=to_mapped_place),
    "carried to an unmapped place": MappingFault(kidnapping=to_unmapped_place),
    "carried to a similar place": MappingFault(kidnapping=to_similar_place),
    "carried nearby": MappingFault(kidnapping=to_nearby),
    "carried in a crowd": MappingFault(kidnapping=to_mapped_place, crowd=True),
    "look-alike rooms": MappingFault("symmetric"),
    "carried among look-alike rooms": MappingFault("symmetric", to_unmapped_place),
    "twins": MappingFault("twins"),
    "carried between twins": MappingFault("twins", to_similar_place),
}


@dataclass(frozen=True)
class DisturbedDrive:
    """A drive with odometry, and where it really was."""

    drive: RawDrive
    truth: Array  # (N, 3)
    world: World
    undisturbed: int  # number of scans before the robot is kidnapped


def make_drive(case: str, seed: int, seconds: float) -> DisturbedDrive:
    """A drive in the building of a seed."""
    fault = CASES[case]
    world = TWINS if fault.world == "twins" else make_building(seed, fault.world).world
    scene = Scene.of(world, BEAMS, [seed, 30])
    scanner = scene.scanner
    if fault.kidnapping is None:
        parts = [scene.path(seconds)]
    else:
        before = scene.path(seconds / 2)
        parts = [before, scene.path(seconds / 2, start=fault.kidnapping(scene, before))]
    truth, odom = np.concatenate(parts), _odometry(parts, scene.rng)
    clean = _ranges_in_crowd(scene, truth) if fault.crowd else scene.clean(truth)
    ranges = np.array([scene.observe(each, 0.0).ranges for each in clean])
    laser = Laser(scanner.angles(), np.array(scanner.mount), scanner.range_max)
    drive = RawDrive(np.arange(len(truth)) / scanner.rate, ranges, laser, odom)
    return DisturbedDrive(drive, truth, world, len(parts[0]))


def _odometry(parts: list[Array], rng: np.random.Generator) -> Array:
    """Poses (N, 3) in odom; between the parts of the drive the robot is carried, and its wheels do not turn."""
    odometer, poses = Odometer(OdometryNoise(), rng), []
    for part in parts:
        poses.append(odometer.pose)
        for before, after in pairwise(part):
            odometer.move(before, after)
            poses.append(odometer.pose)
    return np.array(poses)


def _ranges_in_crowd(scene: Scene, truth: Array) -> Array:
    """Noise-free ranges (N, B) m among people that walk around."""
    world, scanner = scene.world, scene.scanner
    lasers = se2.compose(truth, np.array(scanner.mount))
    people = crowd(world, truth, scanner.rate, round(PEOPLE_PER_M2 * world.free_area), scene.rng)
    return np.concatenate(
        [cast_rays(world, laser, scanner.angles(), each) for laser, each in zip(lasers, people, strict=True)]
    )


def bench_mapping_faults(worlds: int, seed: int, seconds: float, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    rows = []
    for case in CASES:
        for building in range(seed, seed + worlds):
            drive = make_drive(case, building, seconds)
            for odometry in (True, False):
                with console.status(f"{case}, building {building}"):
                    rows.append({"case": case, "seed": building, "odometry": odometry, **map_drive(drive, odometry)})
    print(table(rows))
    write_json(json_file, {"rows": rows, "seconds": seconds, **provenance(seed)})


def map_drive(disturbed: DisturbedDrive, odometry: bool) -> dict[str, Any]:
    """Errors of the map of a drive."""
    drive = disturbed.drive
    begin = time.perf_counter()
    built = build_trajectory(drive if odometry else replace(drive, odom=None))
    taken = time.perf_counter() - begin
    known = np.asarray(np.isfinite(built.poses).all(axis=1))
    poses, truth = built.poses[known], disturbed.truth[known]
    before = np.flatnonzero(known) < disturbed.undisturbed
    reference = before if before.any() else ~before  # the map may be the part after it
    placed = se2.compose(se2.alignment(poses[reference], truth[reference]), poses)
    right = np.array([is_at(*pair) for pair in zip(placed, truth, strict=True)])
    errors = np.hypot(*(placed - truth)[right, :2].T)
    return {
        "placed": float(known.mean()),
        "wrong_place": float(np.count_nonzero(~right) / len(built.poses)),
        "position_rms_m": root_mean_square(errors),  # of scans that are not at a wrong place
        "position_max_m": float(errors.max()),
        "false_walls": false_walls(placed, drive.ranges[known], drive.laser, disturbed.world),
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


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/mapping.md: the smallest and the largest value of all drives of a case."""
    cells = []
    for case in CASES:
        of_case = [row for row in rows if row["case"] == case]
        cells.append(
            [
                case,
                _extremes([number(100 * row["placed"], 0) for row in of_case]),
                _extremes([number(100 * row["wrong_place"], 0) for row in of_case]),
                _extremes([millimetres(row["position_rms_m"]) for row in of_case]),
                _extremes([number(100 * row["false_walls"], 1) for row in of_case]),
            ]
        )
    return markdown(("", "scans placed, %", "at a wrong place, %", "position RMS, mm", "false walls, %"), cells)


def _extremes(numbers: list[str]) -> str:
    low, high = (limit(numbers, key=float) for limit in (min, max))
    return low if low == high else f"{low} to {high}"
