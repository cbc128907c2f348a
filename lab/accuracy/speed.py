"""`presage bench speed`."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.geometry.world import load_world
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS, EstimatorSetup
from lab.accuracy.scenes import Scene
from lab.workers import pool
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.factory import ScannerGeometry

LIMITS = {"tracking": 5.0, "from nothing": 500.0}  # ms per update, the requirement for preset precise
ESTIMATORS = ("precise", "precise-exact", "particle-filter", "amcl-defaults", "correlative")
TRACKING_UPDATES = 300
SKIPPED_UPDATES = 5  # at the start of the path, while caches warm up


def bench_speed(world: str, beams: str, seed: int, json_file: Path | None, console: Console) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given."""
    check_file(json_file, "--json")
    load_world(world)
    jobs = [(name, world, int(count), seed) for count in beams.split(",") for name in ESTIMATORS]
    rows = []
    for job in track(jobs, "measuring", console=console, transient=True):
        with pool(1) as executor:
            rows.append(executor.submit(measure, *job).result())
    table = Table(title=f"{world}, one core", title_justify="left")
    for column in ["estimator", "beams", "tracking ms", "p95", "from nothing ms", "p95", "ready s", "memory MB"]:
        table.add_column(column, justify="left" if column == "estimator" else "right")
    for row in rows:
        table.add_row(
            row["estimator"],
            str(row["beams"]),
            f"{row['tracking_ms']:.2f}",
            f"{row['tracking_p95_ms']:.2f}",
            f"{row['global_ms']:.0f}",
            f"{row['global_p95_ms']:.0f}",
            f"{row['ready_s']:.1f}",
            f"{row['memory_mb']:.0f}",
        )
    console.print(table)
    console.print(
        f"required of precise: {LIMITS['tracking']:g} ms tracking, {LIMITS['from nothing']:g} ms for a global search"
    )
    write_json(json_file, {"rows": rows, "limits_ms": LIMITS, **provenance(seed)})


def measure(estimator: str, world_name: str, beams: int, seed: int) -> dict[str, Any]:
    """Times one estimator: 20 global searches, then tracking along a path."""
    scene = Scene.of(load_world(world_name), beams, seed)
    began = time.perf_counter()
    geometry = ScannerGeometry.of(scene.scanner)
    estimator_under_test = COMPARED_ESTIMATORS[estimator].make(EstimatorSetup(scene.world, geometry, seed))
    ready = time.perf_counter() - began
    searches = []
    for clean in scene.clean(scene.poses(20)):
        estimator_under_test.restart()
        observation = scene.observe(clean, 0.0)
        began = time.perf_counter()
        estimator_under_test.update(observation)
        searches.append((time.perf_counter() - began) * 1e3)
    path = scene.path(TRACKING_UPDATES / scene.scanner.rate)
    estimator_under_test.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    updates = []
    for k, clean in enumerate(scene.clean(path)):
        observation = scene.observe(clean, k / scene.scanner.rate)
        began = time.perf_counter()
        estimator_under_test.update(observation)
        updates.append((time.perf_counter() - began) * 1e3)
    updates = updates[SKIPPED_UPDATES:]
    return {
        "estimator": estimator,
        "beams": beams,
        "tracking_ms": float(np.median(updates)),
        "tracking_p95_ms": float(np.quantile(updates, 0.95)),
        "global_ms": float(np.median(searches)),
        "global_p95_ms": float(np.quantile(searches, 0.95)),
        "ready_s": ready,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
