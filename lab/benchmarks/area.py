"""`presage bench area`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.geometry import se2
from common.geometry.se2 import Array
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
GAP_CELLS = 10  # between buildings
SHARES = ("found", "wrongly_tracking", "ambiguous")


@dataclass(frozen=True)
class Part:
    """One building of a site: its learned field, where the laser can be, and its free area."""

    seed: int
    phi: np.ndarray[tuple[int, ...], np.dtype[np.float32]]  # (ny, nx) m
    origin: Array  # (2,) m, of node (0, 0)
    scales: Array
    places: Array  # (S, 2) m
    area: float  # m²


@dataclass(frozen=True)
class Site:
    """Buildings side by side, in one map."""

    parts: list[Part]
    offsets: Array  # (K, 2) m in map, of each building's own origin
    model: FieldModel
    seeds: Seeds

    @property
    def area(self) -> float:
        """Free area in m²."""
        return sum(part.area for part in self.parts)


def bench_area(
    areas: str, places: int, moved: float, seed: int, out: Path, workers: int, json_file: Path | None, console: Console
) -> int:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given. Returns exit status 0."""
    check_file(json_file, "--json")
    make_folder(out)
    wanted = sorted(float(area) for area in areas.split(","))
    parts = _parts(wanted[-1], seed, out, workers, console)
    rows = []
    for area in wanted:
        count = int(np.searchsorted(np.cumsum([part.area for part in parts]), area)) + 1
        site = site_of(parts[:count])
        rows += [_measure(site, places, share, seed, console) for share in dict.fromkeys((0.0, moved))]
    table = Table(title=f"one scan of {SCANNER.beams} beams, {places} places, processor time", title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(f"{value:.4g}" for value in row.values()))
    console.print(table)
    write_json(json_file, {"rows": rows, **provenance(seed)})
    return 0


def _parts(area: float, seed: int, out: Path, workers: int, console: Console) -> list[Part]:
    """Buildings with at least ``area`` m²; learned now, unless the folder has them."""
    parts: list[Part] = []
    with pool(workers) as executor:
        while (missing := area - sum(part.area for part in parts)) > 0:
            numbers = range(seed * 1000 + len(parts), seed * 1000 + len(parts) + max(1, int(missing / 150)))
            learned = executor.map(partial(_part, out), numbers)
            parts += track(learned, "learning", total=len(numbers), console=console, transient=True)
    return parts


@lru_cache(maxsize=1000)
def _building(seed: int) -> Building:
    """`make_building`, kept because every place needs one, and to furnish it takes a second."""
    return make_building(seed)


def _part(out: Path, seed: int) -> Part:
    file = out / f"building-{seed}.npz"
    if not file.exists():
        world, rng, geometry = _building(seed).world, np.random.default_rng(seed), ScannerGeometry.of(SCANNER)
        model = quick_field(world, geometry, rng, SCANS)
        visited = se2.compose(world.sample_poses(SCANS, rng, 0.27), geometry.mount)[:, :2]
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
    return Part(seed=seed, **values | {"area": float(values["area"])})


def site_of(parts: list[Part]) -> Site:
    """Places the buildings in rows."""
    width = max(*(part.phi.shape[1] for part in parts), int(np.sqrt(sum(part.phi.size for part in parts))))
    corners, row, column, height = [], 0, 0, 0
    for part in parts:
        if column + part.phi.shape[1] > width:
            row, column, height = row + height + GAP_CELLS, 0, 0
        corners.append((row, column))
        column, height = column + part.phi.shape[1] + GAP_CELLS, max(height, part.phi.shape[0])
    phi = np.full((row + height, width + GAP_CELLS), -1.0, np.float32)
    for part, (i, j) in zip(parts, corners, strict=True):
        phi[i : i + part.phi.shape[0], j : j + part.phi.shape[1]] = part.phi
    offsets = np.array(corners)[:, ::-1] * CELL_M - [part.origin for part in parts]
    scales = np.sqrt(np.mean([part.scales**2 for part in parts], axis=0))
    model = FieldModel(DistanceField(phi, (0.0, 0.0), CELL_M), scales)
    places = np.concatenate([part.places + offset for part, offset in zip(parts, offsets, strict=True)])
    return Site(parts, offsets, model, Seeds.at(model, places))


def _measure(site: Site, places: int, moved: float, seed: int, console: Console) -> dict[str, Any]:
    """One row of the table."""
    rng = np.random.default_rng([seed, len(site.parts), round(100 * moved)])
    estimator = PreciseEstimator(
        site.model, site.seeds, np.array(SCANNER.mount), ScannerGeometry.of(SCANNER).likelihood()
    )
    _trial(estimator, *_scan(site, moved, rng))  # compiles
    title = f"{site.area:.0f} m², {moved:.0%} moved"
    trials = [
        _trial(estimator, *_scan(site, moved, rng))
        for _ in track(range(places), title, console=console, transient=True)
    ]
    values = np.array(trials)
    milliseconds = values[:, 3] * 1e3
    return {
        "area_m2": round(site.area),
        "moved": moved,
        **dict(zip(SHARES, values[:, :3].mean(axis=0).tolist(), strict=True)),
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
    areas = np.array([part.area for part in site.parts])
    k = int(rng.choice(len(areas), p=areas / areas.sum()))
    building = _building(site.parts[k].seed)
    if moved:
        building = changes.move_furniture(building, moved, rng)
    scene = Scene(building.world, SCANNER, rng)
    pose = scene.poses(1)[0]
    return scene.observe(scene.clean(pose[None])[0], 0.0), pose + np.append(site.offsets[k], 0.0)


def _trial(estimator: PreciseEstimator, observation: Observation, truth: Array) -> tuple[float, ...]:
    """Found, wrongly tracking and ambiguous (0 or 1), and seconds of the update."""
    estimator.restart()
    began = time.process_time()
    posterior = estimator.update(observation)
    seconds = time.process_time() - began
    found = is_at(posterior.pose, truth)
    return found, posterior.state == "tracking" and not found, posterior.state == "ambiguous", seconds
