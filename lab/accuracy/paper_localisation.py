"""`presage bench localisation`: preset `paper` from the map's centre."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from common.geometry import se2
from common.robot.robot import Robot
from presage.terminal.output import provenance, write_json
from services.estimator.paper import weights
from services.estimator.paper.decoder import use_one_core
from services.estimator.paper.perception import PaperPerception
from services.estimator.paper.training import usable_ranges
from services.estimator.shared.model_folder import SHIPPED

FOUND_DISTANCE = 1.0  # m; an error below it counts as found


def localisation(world: str, beams: int, trials: int, scans: int, seed: int, console: Console) -> dict[str, Any]:
    """Statistics of preset `paper` after ``scans`` scans at each of ``trials`` random places in free space.

    The scans are exact rays with fresh noise; the estimator starts at the map's centre.
    """
    use_one_core()
    model, card = weights.load(weights.find(SHIPPED, world, beams))
    rng, scanner = np.random.default_rng(seed), card.scanner
    places = card.world.sample_free(trials, rng, Robot().radius)
    errors, is_tracking = [], []
    for place in track(places, "localising", console=console, transient=True):
        pose = np.array([*place, card.heading])
        laser = se2.compose(pose, np.array(scanner.mount))
        clean = card.world.ray_distances(laser, scanner.angles())[0]
        start = np.array([*card.world.center(), card.heading])
        estimator = PaperPerception(model, card.test_l1_mean, card.world.bounds, start, metric=model.norm.metric)
        for _ in range(scans):
            noisy = usable_ranges(clean + scanner.sigma * rng.standard_normal(beams), scanner.range_max)
            estimate = estimator.update(noisy)
        errors.append(float(np.hypot(*(estimate.pose - pose)[:2])))
        is_tracking.append(estimate.state == "tracking")
    error, tracking = np.array(errors), np.array(is_tracking)
    found = error[error < FOUND_DISTANCE]
    return {
        "trials": trials,
        "scans": scans,
        "steps_a_scan": estimator.settings.iterations,
        "alpha_m2": estimator.settings.alpha,
        "found_within_1_m": len(found),
        "position_error_median_m": float(np.median(error)),
        "position_error_of_found_mean_m": float(found.mean()) if len(found) else None,
        "position_error_of_found_std_m": float(found.std()) if len(found) else None,
        "claimed_tracking": int(tracking.sum()),
        "claimed_tracking_but_wrong": int((tracking & (error >= FOUND_DISTANCE)).sum()),
        "world": world,
        "beams": beams,
        **provenance(seed),
    }


def bench_localisation(
    world: str, beams: int, trials: int, scans: int, seed: int, json_file: Path | None, console: Console
) -> None:
    """Runs the benchmark, prints the result and writes it to ``json_file`` if given."""
    result = localisation(world, beams, trials, scans, seed, console)
    mean, std = (result[f"position_error_of_found_{k}_m"] for k in ("mean", "std"))
    console.print(
        f"found within {FOUND_DISTANCE:g} m: {result['found_within_1_m']} of {trials}, "
        + (f"with an error of {mean:.3f} ± {std:.3f} m; " if mean is not None else "")
        + f"median error of all trials {result['position_error_median_m']:.3f} m\n"
        f"reported as tracking: {result['claimed_tracking']}, of these wrong: {result['claimed_tracking_but_wrong']}"
    )
    write_json(json_file, result)
