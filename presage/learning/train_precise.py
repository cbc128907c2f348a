"""`presage train`: trains the distance field of preset precise on simulated scans."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from common.bus.bus import Link
from common.geometry import se2
from common.geometry.world import World, load_world
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS, Scanner
from common.versions import commit, presage_command, versions
from presage.learning.field_figure import draw_model
from presage.learning.simulated_scans import collect, scanner_on_bus
from services.estimator.factory import MIN_SIGMA_M
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.evaluation import ModelErrors, evaluate_model
from services.estimator.precise.learning.field_learning import (
    Recipe,
    learn_field,
    learn_scales,
    seed_places,
)
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.model_folder import training_folder
from services.estimator.shared.seen_cells import SeenCells

CALIBRATION_SAMPLES, TEST_SAMPLES = 250, 250  # scans without noise, for the standard deviations and the errors
MIN_SAMPLES, SAMPLES_PER_M2 = 5000, 10  # training scans; the error depends on the number of beams that meet a surface
MIN_BEAMS_PER_SAMPLE = 400  # of a training scan, on average, in each step of learning


@dataclass(frozen=True)
class TrainPreciseOptions:
    """Options of `presage train` for preset precise."""

    world: str
    scanner: Scanner = SCANNERS["tim571"]
    simulator_arguments: tuple[str, ...] = ()  # that select the scanner
    out: Path = field(default_factory=training_folder)
    samples: int | None = None  # defaults to `default_samples`
    recipe: Recipe = Recipe()  # noqa: RUF009 - frozen
    force: bool = False  # replace the weights of another world of the same name


def default_samples(world: World) -> int:
    """Number of training scans, in proportion to the free area: large worlds are learned as exactly as small ones."""
    return max(MIN_SAMPLES, round(SAMPLES_PER_M2 * world.free_area))


def train_precise(options: TrainPreciseOptions, link: Link, console: Console) -> Path:
    """Trains the distance field of a world, saves and draws it, and returns the path of the weights.

    Raises UserError if the scanner cannot be sampled or the weights cannot be saved.
    """
    world, scanner = load_world(options.world), options.scanner
    path = weights.path_of(options.out, world.name)
    weights.refuse_to_overwrite(path, world, force=options.force)
    rng = np.random.default_rng(options.recipe.seed)
    counts = {"train": options.samples or default_samples(world), "held out": CALIBRATION_SAMPLES + TEST_SAMPLES}
    poses = {name: world.sample_poses(count, rng, Robot().radius) for name, count in counts.items()}
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        with scanner_on_bus(link, options.world, options.simulator_arguments, world, scanner, console) as bus:
            train = collect(bus, poses["train"], scanner, options.recipe.seed, bar, "training scans")
            held_out = collect(bus, poses["held out"], scanner, None, bar, "test scans")
        card = learn_and_save(path, options, world, poses, {"train": train, "held out": held_out}, bar)
    draw_model(weights.load(path)[0], card, path.with_suffix(".png"))
    position_error_m = card.test_position_error_rms_m
    assert position_error_m is not None  # noqa: S101 - it was just measured
    console.print(
        f"{path}: {path.stat().st_size / 1e6:.2f} MB, trained in {card.learning_s:.0f} s; range error median "
        f"{card.test_range_error_median_m * 1e3:.2f} mm, {card.test_share_above_5_cm:.2%} above 5 cm; "
        f"position error from scans without noise {position_error_m * 1e3:.2f} mm RMS"
    )
    return path


def learn_and_save(
    path: Path,
    options: TrainPreciseOptions,
    world: World,
    poses: dict[str, se2.Array],
    scans: dict[str, se2.Array],
    bar: Progress,
) -> weights.FieldCard:
    """Learns from the `train` scans at their poses, saves the weights with their errors on the scans `held out`.

    Those have no noise. Returns the model card.
    """
    start = time.monotonic()
    model, errors = _train(options, world, poses, scans, bar)
    seconds = time.monotonic() - start
    visited = se2.compose(poses["train"], np.array(options.scanner.mount))[:, :2]
    places = seed_places(model.field, visited, model.seen)
    card = _card(options, world, len(poses["train"]), model, errors, seconds)
    weights.save(path, model, places, card)
    return card


def _train(
    options: TrainPreciseOptions, world: World, poses: dict[str, se2.Array], scans: dict[str, se2.Array], bar: Progress
) -> tuple[FieldModel, ModelErrors]:
    scanner = options.scanner
    mount, angles = np.array(scanner.mount), scanner.angles()
    task: TaskID = bar.add_task("training", total=1.0)

    def report(title: str, done: float) -> None:
        bar.update(task, description=f"training: {title}", completed=0.9 * done)

    beams_per_sweep = max(options.recipe.beams_per_sweep, MIN_BEAMS_PER_SAMPLE * len(scans["train"]))
    recipe = replace(options.recipe, beams_per_sweep=beams_per_sweep)
    # The beams are not kept here: in large buildings, they are most of the memory.
    learned = learn_field(
        Beams.of(poses["train"], mount, angles, scans["train"]), recipe, report, threads=os.cpu_count() or 1
    ).as_stored()
    report("standard deviations", 1.0)
    count = CALIBRATION_SAMPLES
    scales = learn_scales(learned, poses["held out"][:count], mount, angles, scans["held out"][:count], 0.0)
    model = FieldModel(learned, scales, SeenCells.of_world(world))
    errors = evaluate_model(
        model,
        poses["held out"][count:],
        mount,
        angles,
        scans["held out"][count:],
        scanner.range_max,
        max(scanner.sigma, MIN_SIGMA_M),
        scanner.sigma_relative,
    )
    bar.update(task, description="trained", completed=1.0)
    return model, errors


def _card(
    options: TrainPreciseOptions, world: World, samples: int, model: FieldModel, errors: ModelErrors, seconds: float
) -> weights.FieldCard:
    return weights.FieldCard(
        world=world,
        scanner=options.scanner,
        samples=samples,
        seed=options.recipe.seed,
        resolution=options.recipe.resolution,
        origin=model.field.origin,
        sweeps=options.recipe.sweeps,
        inflation=round(errors.inflation, 3),
        test_samples=TEST_SAMPLES,
        test_range_error_median_m=errors.range_error_median,
        test_range_error_mean_m=errors.range_error_mean,
        test_share_above_5_cm=errors.share_above_5_cm,
        test_position_error_rms_m=errors.position_error_rms,
        learning_s=round(seconds, 1),
        commit=commit(),
        command=presage_command(),
        versions=versions(),
    )
