"""`presage train --preset paper`: trains the decoder on simulated scans."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from common.bus.bus import Link
from common.geometry.world import World, load_world
from common.robot.robot import Robot
from common.robot.scanner import Scanner
from common.versions import commit, presage_command, versions
from presage.learning.simulated_scans import collect, scanner_on_bus
from presage.plotting.style import empty_figure, save_figure
from services.estimator.paper import training, weights
from services.estimator.paper.checkpoint import Checkpoint
from services.estimator.paper.decoder import DecoderShape, Normalisation, PaperModel
from services.estimator.paper.training import Trainer, TrainingData, TrainingParameters, usable_ranges

TEST_SAMPLES = 1000
HIDDEN, CHANNELS = 128, 8  # size of the shipped networks, see DecoderShape


@dataclass(frozen=True)
class TrainPaperOptions:
    """Options of `presage train` for preset paper."""

    world: str
    preset: str
    scanner: Scanner
    simulator_arguments: tuple[str, ...]  # that select the scanner
    out: Path
    samples: int
    parameters: TrainingParameters


def train(options: TrainPaperOptions, link: Link, console: Console) -> Path:
    """Trains the decoder of preset paper, saves it, and returns the path of the weights.

    An interrupted training with the same options is resumed. Raises UserError if the scanner cannot be sampled.
    """
    world, scanner = load_world(options.world), options.scanner
    path = weights.path_of(options.out, world.name, scanner.beams)
    described = {
        "world": world.model_dump(mode="json"),
        "scanner": scanner.model_dump(mode="json"),
        "n": options.samples,
    }
    checkpoint = Checkpoint(options.out / f".{path.stem}.unfinished", {**described, **asdict(options.parameters)})
    heading = float(world.start_pose(Robot().radius)[2])
    rng = np.random.default_rng(options.parameters.seed)
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console
    ) as bar:
        data = {}
        for name, count in (("train", options.samples), ("test", TEST_SAMPLES)):
            poses = np.column_stack([world.sample_free(count, rng, Robot().radius), np.full(count, heading)])
            samples = checkpoint.load_samples(name)
            if samples is None:
                with scanner_on_bus(link, options.world, options.simulator_arguments, world, scanner, console) as bus:
                    noise_seed = options.parameters.seed if name == "train" else None  # test scans have no noise
                    ranges = collect(bus, poses, scanner, noise_seed, bar, f"{name} samples")
                samples = TrainingData(poses, usable_ranges(ranges, scanner.range_max))
                checkpoint.save_samples(name, samples)
            data[name] = samples
        trainer, seconds = _fit(options, world, scanner, data, checkpoint, bar)
    _save(options, world, scanner, heading, data, trainer, seconds, path)
    checkpoint.finish()
    _warn_if_nothing_learned(data, trainer, console)
    card = weights.load(path)[1]
    console.print(
        f"{path}: {path.stat().st_size / 1e6:.2f} MB; test error mean {card.test_l1_mean:.3f} m, "
        f"median {card.test_l1_median:.3f} m; {seconds:.0f} s"
    )
    return path


def _fit(
    options: TrainPaperOptions,
    world: World,
    scanner: Scanner,
    data: dict[str, TrainingData],
    checkpoint: Checkpoint,
    bar: Progress,
) -> tuple[Trainer, float]:
    norm = Normalisation.of(world.bounds, float(data["train"].ranges.max()))
    shape = DecoderShape(scanner.beams, HIDDEN, CHANNELS)
    trainer = Trainer(shape, norm, options.parameters, data["train"], data["test"])
    if checkpoint.restore_state(trainer):
        bar.console.print(f"resuming an interrupted run after epoch {trainer.progress.epoch}")
    task = bar.add_task("epochs", total=options.parameters.epochs, completed=trainer.progress.epoch)
    start = time.monotonic()

    def report(progress: training.Progress) -> None:
        checkpoint.save_state(trainer)
        test = progress.test_l1[-1]
        bar.update(task, completed=progress.epoch, description=f"epochs, test error {test:.3f} m")

    trainer.run(report)
    return trainer, time.monotonic() - start


def _warn_if_nothing_learned(data: dict[str, TrainingData], trainer: Trainer, console: Console) -> None:
    """Prints a warning if the network predicts the same scan everywhere, as with ReLUs that are never active."""
    constant = float(np.abs(data["test"].ranges - np.median(data["train"].ranges, axis=0)).mean())
    if trainer.progress.test_l1[-1] > 0.9 * constant:
        console.print(
            "[bold red]nothing was learned[/]: predicting the same scan everywhere is as accurate "
            f"({constant:.3f} m). Try another --seed, or in section train of --config a smaller "
            "learning_rate or more epochs."
        )


def _save(
    options: TrainPaperOptions,
    world: World,
    scanner: Scanner,
    heading: float,
    data: dict[str, TrainingData],
    trainer: Trainer,
    seconds: float,
    path: Path,
) -> None:
    """Saves the weights in half precision, with a model card and a figure; the errors are those in half precision."""
    model_state = {name: tensor.half().float() for name, tensor in trainer.decoder.state_dict().items()}
    trainer.decoder.load_state_dict(model_state)
    predicted = PaperModel(trainer.decoder, trainer.norm).ranges(data["test"].poses)
    error = np.abs(predicted - data["test"].ranges)
    parameters = options.parameters
    card = weights.ModelCard(
        preset=options.preset,
        world=world,
        scanner=scanner,
        heading=heading,
        samples=options.samples,
        epochs=parameters.epochs,
        batch=parameters.batch,
        learning_rate=parameters.learning_rate,
        seed=parameters.seed,
        hidden=HIDDEN,
        channels=CHANNELS,
        center=trainer.norm.center,
        half_size=trainer.norm.half_size,
        range_scale=trainer.norm.range_scale,
        test_samples=TEST_SAMPLES,
        test_l1_mean=float(error.mean()),
        test_l1_median=float(np.median(error)),
        curve_train_l1=[round(v, 5) for v in trainer.progress.train_l1],
        curve_test_l1=[round(v, 5) for v in trainer.progress.test_l1],
        training_s=round(seconds, 1),
        commit=commit(),
        command=presage_command(),
        versions=versions(),
    )
    weights.save(path, trainer.decoder, card)
    _draw_curve(card, path.with_suffix(".png"))


def _draw_curve(card: weights.ModelCard, png: Path) -> None:
    figure = empty_figure(6, 4)
    axes = figure.add_subplot()
    epochs = np.arange(1, len(card.curve_test_l1) + 1)
    axes.plot(epochs, card.curve_train_l1, color="#0072B2", label=f"{card.samples} training samples")
    axes.plot(epochs, card.curve_test_l1, color="#D55E00", label=f"{card.test_samples} test samples")
    axes.set(
        xlabel="epoch",
        ylabel="L1 error (m, mean over beams)",
        yscale="log",
        title=f"{card.preset} in {card.world.name}, {card.scanner.beams} beams",
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    save_figure(figure, png, dpi=120)
