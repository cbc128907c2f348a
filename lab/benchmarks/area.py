"""`presage bench area`: how a search from one scan depends on the area of the map.

Generated office buildings stand side by side in one map.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.robot import Robot
from lab.accuracy.runner import quick_field
from lab.accuracy.scenes import TIM571, Scene
from lab.accuracy.tasks import is_at
from lab.experiments.results import markdown
from lab.integrity import changes
from lab.integrity.buildings import Building, make_building
from lab.workers import pool
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.estimator.factory import ScannerGeometry
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import DistanceField, FieldModel
from services.estimator.precise.global_seeds import Seeds
from services.estimator.precise.learning.field_learning import seed_places
from services.estimator.shared.interface import Observation

SCANNER = TIM571.with_beams(622)
SCANS = 300  # from which the field of each building is learned
CELL_M = 0.04
TYPICAL_BUILDING_M2 = 150.0
GAP_CELLS = 10  # between buildings


@dataclass(frozen=True)
class LearnedBuilding:
    """One building of a site: its learned field, where the laser can be, and its free area."""

    seed: int
    phi: np.ndarray[tuple[int, ...], np.dtype[np.float32]]  # (ny, nx) m, distance to the nearest surface
    origin: Array  # (2,) m, of node (0, 0)
    scales: Array  # m, see `FieldModel`
    places: Array  # (S, 2) m
    area: float  # m²


@dataclass(frozen=True)
class Site:
    """Buildings side by side, in one map."""

    buildings: list[LearnedBuilding]
    offsets: Array  # (K, 2) m in map, of each building's own origin
    model: FieldModel
    seeds: Seeds

    @property
    def area(self) -> float:
        """Free area in m²."""
        return sum(building.area for building in self.buildings)


class SearchOutcome(NamedTuple):
    """Result of a search from one scan."""

    found: bool
    wrongly_tracking: bool
    ambiguous: bool
    seconds: float  # processor time


def bench_area(
    areas: str, places: int, moved: float, seed: int, out: Path, workers: int, json_file: Path | None, console: Console
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    make_folder(out)
    wanted = sorted(float(area) for area in areas.split(","))
    buildings = _learn_buildings(wanted[-1], seed, out, workers, console)
    rows = []
    for area in wanted:
        count = int(np.searchsorted(np.cumsum([building.area for building in buildings]), area)) + 1
        site = join_buildings(buildings[:count])
        rows += [_measure(site, places, fraction, seed, console) for fraction in dict.fromkeys((0.0, moved))]
    printed = Table(title=f"one scan of {SCANNER.beams} beams, {places} places, processor time", title_justify="left")
    for name in rows[0]:
        printed.add_column(name, justify="right")
    for row in rows:
        printed.add_row(*(f"{value:.4g}" for value in row.values()))
    console.print(printed)
    write_json(json_file, {"rows": rows, **provenance(seed)})


def _learn_buildings(area: float, seed: int, out: Path, workers: int, console: Console) -> list[LearnedBuilding]:
    """Buildings with at least ``area`` m² in sum: those in the folder ``out``, and the others learned now."""
    buildings: list[LearnedBuilding] = []
    with pool(workers) as executor:
        while (missing := area - sum(building.area for building in buildings)) > 0:
            first, count = seed * 1000 + len(buildings), max(1, int(missing / TYPICAL_BUILDING_M2))
            learned = executor.map(partial(_learn_building, out), range(first, first + count))
            buildings += track(learned, "learning", total=count, console=console, transient=True)
    return buildings


@lru_cache(maxsize=1000)
def _building(seed: int) -> Building:
    """Caches `make_building`: each trial needs a building, and furnishing one takes a second."""
    return make_building(seed)


def _learn_building(out: Path, seed: int) -> LearnedBuilding:
    file = out / f"building-{seed}.npz"
    if not file.exists():
        world, rng, geometry = _building(seed).world, np.random.default_rng(seed), ScannerGeometry.of(SCANNER)
        model = quick_field(world, geometry, rng, SCANS)
        visited = se2.compose(world.sample_poses(SCANS, rng, Robot().radius), geometry.mount)[:, :2]
        places = seed_places(model.field, visited)
        field = model.field.with_solids(places)
        np.savez(
            file,
            phi=field.phi,
            origin=field.origin,
            scales=model.scales,
            places=places,
            area=world.free_area,
        )
    with np.load(file) as data:
        values = dict(data)
    return LearnedBuilding(seed=seed, **values | {"area": float(values["area"])})


def join_buildings(buildings: list[LearnedBuilding]) -> Site:
    """Places the buildings in rows."""
    width = max(
        *(building.phi.shape[1] for building in buildings),
        int(np.sqrt(sum(building.phi.size for building in buildings))),
    )
    corners, row, column, height = [], 0, 0, 0
    for building in buildings:
        if column + building.phi.shape[1] > width:
            row, column, height = row + height + GAP_CELLS, 0, 0
        corners.append((row, column))
        column, height = column + building.phi.shape[1] + GAP_CELLS, max(height, building.phi.shape[0])
    phi = np.full((row + height, width + GAP_CELLS), -1.0, np.float32)  # solid between the buildings
    for building, (i, j) in zip(buildings, corners, strict=True):
        phi[i : i + building.phi.shape[0], j : j + building.phi.shape[1]] = building.phi
    offsets = np.array(corners)[:, ::-1] * CELL_M - [building.origin for building in buildings]
    scales = np.sqrt(np.mean([building.scales**2 for building in buildings], axis=0))
    model = FieldModel(DistanceField(phi, (0.0, 0.0), CELL_M), scales)
    places = np.concatenate([building.places + offset for building, offset in zip(buildings, offsets, strict=True)])
    return Site(buildings, offsets, model, Seeds.at(model, places))


def _measure(site: Site, places: int, moved: float, seed: int, console: Console) -> dict[str, Any]:
    """One row of the table."""
    rng = np.random.default_rng([seed, len(site.buildings), round(100 * moved)])
    estimator = PreciseEstimator(
        site.model, site.seeds, np.array(SCANNER.mount), ScannerGeometry.of(SCANNER).likelihood()
    )
    _search(estimator, *_scan(site, moved, rng))  # a warm-up, as numba compiles now
    title = f"{site.area:.0f} m², {moved:.0%} moved"
    outcomes = [
        _search(estimator, *_scan(site, moved, rng))
        for _ in track(range(places), title, console=console, transient=True)
    ]
    milliseconds = [1e3 * outcome.seconds for outcome in outcomes]
    return {
        "area_m2": round(site.area),
        "moved": moved,
        "found": float(np.mean([outcome.found for outcome in outcomes])),
        "wrongly_tracking": float(np.mean([outcome.wrongly_tracking for outcome in outcomes])),
        "ambiguous": float(np.mean([outcome.ambiguous for outcome in outcomes])),
        "ms_median": float(np.median(milliseconds)),
        "ms_p95": float(np.quantile(milliseconds, 0.95)),
        "seeds": len(site.seeds.places),
        "model_mb": sum(each.nbytes for each in (site.model.field.phi, site.seeds.places, site.seeds.panoramas)) / 1e6,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/maps.md."""
    cells = [
        [
            f"{row['area_m2']}",
            f"{row['moved']:.0%}",
            *(f"{row[share]:.1%}" for share in ("found", "wrongly_tracking")),
            f"{row['ms_median']:.0f}, {row['ms_p95']:.0f}",
            f"{row['model_mb']:.0f}",
        ]
        for row in rows
    ]
    return markdown(
        ("m²", "furniture moved", "found", "wrongly `tracking`", "ms: median, 95 %", "model in memory (MB)"), cells
    )


def _scan(site: Site, moved: float, rng: np.random.Generator) -> tuple[Observation, Array]:
    """A scan at a random place, and the pose (3,) in map."""
    areas = np.array([building.area for building in site.buildings])
    k = int(rng.choice(len(areas), p=areas / areas.sum()))
    building = _building(site.buildings[k].seed)
    if moved:
        building = changes.move_furniture(building, moved, rng)
    scene = Scene(building.world, SCANNER, rng)
    pose = scene.poses(1)[0]
    return scene.observe(scene.clean(pose[None])[0], 0.0), pose + np.append(site.offsets[k], 0.0)


def _search(estimator: PreciseEstimator, observation: Observation, truth: Array) -> SearchOutcome:
    """Localises one scan without a start pose."""
    estimator.restart()
    began = time.process_time()
    posterior = estimator.update(observation)
    seconds = time.process_time() - began
    found = is_at(posterior.pose, truth)
    return SearchOutcome(
        found=found,
        wrongly_tracking=posterior.state == "tracking" and not found,
        ambiguous=posterior.state == "ambiguous",
        seconds=seconds,
    )
