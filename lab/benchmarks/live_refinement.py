"""Measures learning while driving in a rough map: `python -m lab.benchmarks.live_refinement`.

A drive learns in a noisy grid of 5 cm; the errors are those of another drive. Learning takes place between two scans,
so that results do not depend on the machine; what it learned is used `DELAY_S` of the drive later.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import psutil

from common.geometry.se2 import Array
from common.geometry.world import World, load_world
from lab.accuracy.scenes import Scene
from lab.integrity.buildings import make_building
from lab.integrity.cases import BEAMS, START_DEVIATION
from lab.integrity.maps import noisy_grid
from services.estimator.factory import EstimatorOptions, Geometry, prepare
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.key_scans import KeyScans
from services.estimator.precise.learning.live_learning import Version, learn_version

DELAY_S = 15.0  # of the drive, in which a version is learned
TEST_SECONDS = 40.0
ROUGH_SEED, DRIVE_SEED, TEST_SEED = 5, 6, 7


def start_estimator(rough: World, scene: Scene, start: Array) -> PreciseEstimator:
    """An estimator in the rough map, near a pose."""
    made = prepare(EstimatorOptions(rough, model="exact"))(Geometry.of(scene.scanner))
    assert isinstance(made, PreciseEstimator)  # noqa: S101 - for the type checker
    made.restart(start + START_DEVIATION * scene.rng.standard_normal(3), np.diag(START_DEVIATION**2))
    return made


def drive_and_learn(rough: World, scene: Scene, path: Array) -> tuple[list[dict[str, Any]], Version | None]:
    """Drives along poses (N, 3); returns what each version is like, and the last one."""
    estimator = start_estimator(rough, scene, path[0])
    former, places = estimator.model, estimator.seeds.places
    keys = KeyScans(scene.scanner.angles(), np.array(scene.scanner.mount), scene.scanner.range_max)
    rows: list[dict[str, Any]] = []
    update_ms: list[tuple[float, float]] = []  # of tracking and of the collection of key scans, CPU time
    version, pending, errors, since = None, None, [], 0.0
    for k, clean in enumerate(scene.clean(path)):
        stamp = k / scene.scanner.rate
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
            pending = learn_version(former, places, estimator.model, drive)
            rows.append({
                "at_s": stamp,
                "key_scans": len(drive.poses),
                "learning_cpu_s": time.process_time() - begin,
                "accepted": pending is not None,
                "error_median_m": float(np.median(errors[-int(10 * scene.scanner.rate):])),
            })  # fmt: skip
            print(rows[-1], flush=True)
    for quantile in (0.5, 0.99):
        tracking, collecting = np.quantile(update_ms, quantile, axis=0)
        print(f"update, quantile {quantile:g}: tracking {tracking:.1f} ms, collecting key scans {collecting:.2f} ms")
    if version is not None:
        size = len(weights.encode(version.model, version.seeds.places))
        print(f"key scans {key_scan_bytes(keys) / 1e6:.1f} MB; a version, as published, {size / 1e3:.0f} kB")
    return rows, version


def key_scan_bytes(keys: KeyScans) -> int:
    """Size of the ranges of all key scans."""
    return sum(key.ranges.nbytes for key in keys.verified.values())


def test_errors(rough: World, scene: Scene, version: Version | None) -> Array:
    """Position errors (N,) in m of another drive, with a version or with the rough map."""
    path = scene.path(TEST_SECONDS)
    estimator = start_estimator(rough, scene, path[0])
    if version is not None:
        estimator.use_model(version.model, version.seeds)
    clean = scene.clean(path)
    found = [estimator.update(scene.observe(each, k / scene.scanner.rate)).pose for k, each in enumerate(clean)]
    return np.asarray(np.hypot(*(np.array(found) - path)[:, :2].T))


def main() -> None:
    """Prints the errors before and after."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="office", help="office, or the seed of a generated building")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--seed", type=int, default=5000)
    args = parser.parse_args()
    world = load_world("office") if args.world == "office" else make_building(int(args.world)).world
    rough = noisy_grid(Scene.of(world, BEAMS, [args.seed, ROUGH_SEED]))
    scene = Scene.of(world, BEAMS, [args.seed, DRIVE_SEED])
    _, version = drive_and_learn(rough, scene, scene.path(args.seconds))
    for name, each in (("rough map", None), ("learned while driving", version)):
        errors = test_errors(rough, Scene.of(world, BEAMS, [args.seed, TEST_SEED]), each) * 1e3
        rms, most = np.sqrt((errors**2).mean()), errors.max()
        print(f"{name}: position error median {np.median(errors):.1f}, RMS {rms:.1f}, maximum {most:.1f} mm")
    print(f"memory of this process: {psutil.Process().memory_info().rss / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
