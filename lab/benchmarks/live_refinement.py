"""Measures learning while driving in a rough map: `python -m lab.benchmarks.live_refinement`.

A drive through all rooms learns in a noisy grid of 5 cm; the errors are those of another drive. Learning takes place
between two scans, so that results do not depend on the machine; what it learned is used `DELAY_S` of the drive later.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from common.geometry.se2 import Array
from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import PERIOD_S, building_of, drive_for, make_estimator
from lab.benchmarks.mapping import fitted
from lab.benchmarks.refinement import DRIVE_SEED, ROUGH_SEED, TEST_SECONDS, TEST_SEED
from lab.experiments.results import markdown, millimetres
from lab.integrity.cases import BEAMS, START_DEVIATION
from lab.integrity.maps import noisy_grid
from lab.statistics import root_mean_square
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.factory import EstimatorOptions
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.key_scans import KeyScanCollector
from services.estimator.precise.learning.live_learning import ModelVersion, learn_version

DELAY_S = 15.0  # of the drive, in which a version is learned


def start_estimator(
    options: EstimatorOptions, scene: Scene, start: Array, version: ModelVersion | None = None
) -> PreciseEstimator:
    """An estimator that starts near a pose, with a ``version`` of its model if given."""
    estimator = make_estimator(options, scene.scanner, version)
    estimator.restart(start + START_DEVIATION * scene.rng.standard_normal(3), np.diag(START_DEVIATION**2))
    return estimator


def drive_and_learn(options: EstimatorOptions, scene: Scene, path: Array) -> tuple[dict[str, Any], ModelVersion | None]:
    """Drives along poses (N, 3); returns what was learned when, at what cost, and the last version."""
    estimator = start_estimator(options, scene, path[0])
    original, places = estimator.model, estimator.seeds.places
    keys = KeyScanCollector(scene.scanner.angles(), np.array(scene.scanner.mount), scene.scanner.range_max)
    versions: list[dict[str, Any]] = []
    update_ms: list[tuple[float, float]] = []  # of tracking and of the collection of key scans, CPU time
    version, pending, errors, since = None, None, [], 0.0
    for k, clean in enumerate(scene.clean(path)):
        stamp = k * PERIOD_S
        observation = scene.observe(clean, stamp)
        begin = time.process_time()
        posterior = estimator.update(observation)
        tracked = time.process_time()
        keys.add(posterior, observation)
        update_ms.append((1e3 * (tracked - begin), 1e3 * (time.process_time() - tracked)))
        errors.append(float(np.hypot(*(posterior.pose - path[k])[:2])))
        if pending is not None and stamp >= since + DELAY_S:
            version, pending = pending, None
            estimator.use_model(version.model, version.seeds)
        if pending is None and (drive := keys.take_drive()) is not None:
            begin, since = time.process_time(), stamp
            pending = learn_version(original, places, estimator.model, drive, learned_until=keys.learned_until)
            if pending is not None:
                keys.set_learned(drive.stamps, pending.key_poses)
            versions.append({
                "at_s": stamp,
                "key_scans": len(drive.poses),
                "learning_cpu_s": time.process_time() - begin,
                "accepted": pending is not None,
                "error_median_m": float(np.median(errors[-round(10 / PERIOD_S):])),
            })  # fmt: skip
            print(versions[-1], flush=True)
    version = pending or version  # the robot waits until the last one is learned
    mean, (median, most) = np.mean(update_ms, axis=0), np.quantile(update_ms, (0.5, 0.99), axis=0)
    costs = {
        f"{name}_{kind}_ms": float(values[column])
        for column, name in enumerate(("tracking", "collecting"))
        for kind, values in (("mean", mean), ("median", median), ("p99", most))
    }
    return {
        "versions": versions,
        **costs,
        "key_scans_bytes": key_scan_bytes(keys),
        "version_bytes": 0 if version is None else len(weights.encode(version.model, version.seeds.places)),
    }, version


def key_scan_bytes(keys: KeyScanCollector) -> int:
    """Size of the ranges of all key scans."""
    return sum(key.ranges.nbytes for key in keys.verified.values())


def errors_of_test_drive(
    options: EstimatorOptions, scene: Scene, path: Array, version: ModelVersion | None
) -> dict[str, float]:
    """Position errors of another drive along poses (N, 3), with a version or with the original model.

    For the aligned errors, the estimated path is first moved and turned as a whole to fit the true one best, so that an
    offset of the whole map does not count.
    """
    estimator = start_estimator(options, scene, path[0], version)
    clean = scene.clean(path)
    found = np.array([estimator.update(scene.observe(each, k * PERIOD_S)).pose for k, each in enumerate(clean)])
    errors, aligned = (np.hypot(*(poses - path)[:, :2].T) for poses in (found, fitted(found, path)))
    return {
        "position_median_m": float(np.median(errors)),
        "position_rms_m": root_mean_square(errors),
        "position_max_m": float(errors.max()),
        "aligned_median_m": float(np.median(aligned)),
    }


def refine(name: str, seed: int, seconds: float) -> dict[str, Any]:
    """Results in one world."""
    building = building_of(name)
    world = building.world
    rough = EstimatorOptions(noisy_grid(Scene.of(world, BEAMS, [seed, ROUGH_SEED])), model="exact")
    scene = Scene.of(world, BEAMS, [seed, DRIVE_SEED])
    learned, version = drive_and_learn(rough, scene, drive_for(scene, building, seconds))
    tests = [Scene.of(world, BEAMS, [seed, TEST_SEED]) for _ in range(2)]  # both with the same noise
    before, after = (
        errors_of_test_drive(rough, test, drive_for(test, building, TEST_SECONDS), each)
        for test, each in zip(tests, (None, version), strict=True)
    )
    return {"world": building.name, "rough": before, "after": after, **learned}


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/refinement.md, in mm: median, RMS and maximum; and medians of aligned errors."""
    cells = []
    for row in rows:
        errors = [
            "; ".join(millimetres(row[kind][f"position_{value}_m"]) for value in ("median", "rms", "max"))
            for kind in ("rough", "after")
        ]
        aligned = [millimetres(row[kind]["aligned_median_m"]) for kind in ("rough", "after")]
        cells.append([row["world"], *errors, *aligned])
    return markdown(("world", "rough map", "after learning", "rough map, aligned", "after learning, aligned"), cells)


def main() -> None:
    """Prints the errors before and after, and writes them to a file if one is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--worlds", default="office", help="comma-separated: office, or the seed of a generated building"
    )
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    check_file(args.json, "--json")
    rows = [refine(name, args.seed, args.seconds) for name in args.worlds.split(",")]
    for row in rows:
        print({name: value for name, value in row.items() if name != "versions"})
    print(table(rows))
    print(f"memory of this process: {psutil.Process().memory_info().rss / 1e6:.0f} MB")
    write_json(args.json, {"rows": rows, "seconds": args.seconds, **provenance(args.seed)})


if __name__ == "__main__":
    main()
