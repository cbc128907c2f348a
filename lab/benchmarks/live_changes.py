"""Measures learning while driving where furniture was moved: `python -m lab.benchmarks.live_changes`.

The model was learned before each piece of furniture was moved with probability one half. A drive through all rooms
then learns, as in `live_refinement`. Single scans from unknown poses are localised with the models before and after it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import (
    building_of,
    drive_for,
    errors_of_single_scans,
    found_of,
    learn_at_true_poses,
)
from lab.benchmarks.live_refinement import drive_and_learn
from lab.experiments.results import markdown
from lab.integrity.cases import BEAMS
from lab.integrity.changes import move_furniture
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.factory import EstimatorOptions

MOVED_SHARE = 0.5
MOVED_SEED, BEFORE_SEED, DRIVE_SEED, TEST_SEED, PRESENT_SEED = 50, 51, 52, 53, 54  # parts of the random seeds
BEFORE, AFTER, PRESENT = "before the drive", "after the drive", "learned at true poses"


def follow_changes(name: str, seed: int, seconds: float, scans: int) -> dict[str, Any]:
    """Results in one building: errors in m of single scans, None if not found, and what was learned when."""
    building = building_of(name)
    moved = move_furniture(building, MOVED_SHARE, np.random.default_rng([seed, MOVED_SEED]))
    original = learn_at_true_poses(Scene.of(building.world, BEAMS, [seed, BEFORE_SEED]))
    options = EstimatorOptions(building.world, generative_model=original)
    drive = Scene.of(moved.world, BEAMS, [seed, DRIVE_SEED])
    learned, version = drive_and_learn(options, drive, drive_for(drive, moved, seconds))
    test = Scene.of(moved.world, BEAMS, [seed, TEST_SEED])
    poses = test.poses(scans)
    observed = [test.observe(ranges, float(k)) for k, ranges in enumerate(test.clean(poses))]
    present = learn_at_true_poses(Scene.of(moved.world, BEAMS, [seed, PRESENT_SEED]))
    return {
        "world": building.name,
        BEFORE: errors_of_single_scans(options, test.scanner, observed, poses),
        AFTER: errors_of_single_scans(options, test.scanner, observed, poses, version),
        PRESENT: errors_of_single_scans(
            EstimatorOptions(moved.world, generative_model=present), test.scanner, observed, poses
        ),
        **learned,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/refinement.md: single scans found of all, and the median error of these in mm."""
    models = (BEFORE, AFTER, PRESENT)
    cells = [[row["world"], *(found_of(row[model]) for model in models)] for row in rows]
    return markdown(("world", *models), cells)


def main() -> None:
    """Prints the scans found before and after, and writes the results to a file if one is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--worlds", default="office", help="comma-separated: office, or the seed of a generated building"
    )
    parser.add_argument("--seconds", type=float, default=300.0, help="length of the drive")
    parser.add_argument("--scans", type=int, default=100, help="single scans that are localised")
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    check_file(args.json, "--json")
    rows = [follow_changes(name, args.seed, args.seconds, args.scans) for name in args.worlds.split(",")]
    print(table(rows))
    write_json(args.json, {"rows": rows, "seconds": args.seconds, "scans": args.scans, **provenance(args.seed)})


if __name__ == "__main__":
    main()
