"""Fields of preset `precise` for the maps of the benchmark, learned as by `presage train` and kept in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from common.geometry.world import World
from common.robot.scanner import Scanner
from lab.accuracy.scenes import Scene
from presage.learning.train_precise import (
    CALIBRATION_SAMPLES,
    TEST_SAMPLES,
    TrainPreciseOptions,
    default_samples,
    learn_and_save,
)
from services.estimator.precise.learning import weights


def field_file(folder: Path, world: World, scanner: Scanner) -> Path:
    """The weights of the map's field, learned now unless the folder has them."""
    path = weights.path_of(folder, world.name)
    if not path.exists():
        _learn(path, world, scanner)
    return path


def _learn(path: Path, world: World, scanner: Scanner) -> None:
    options = TrainPreciseOptions(world.name, scanner, out=path.parent)
    rng = np.random.default_rng(options.recipe.seed)
    scene = Scene(world, scanner, rng)
    counts = {"train": default_samples(world), "held out": CALIBRATION_SAMPLES + TEST_SAMPLES}
    poses = {name: scene.poses(count) for name, count in counts.items()}
    clean = {name: scene.clean(places) for name, places in poses.items()}
    scans = {"train": scanner.add_noise(clean["train"], rng), "held out": clean["held out"]}
    with Progress(console=Console(quiet=True), disable=True) as bar:
        learn_and_save(path, options, world, poses, {name: scanner.limit(each) for name, each in scans.items()}, bar)
