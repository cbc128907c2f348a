"""`presage bench decoders`: other generative models."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from common.geometry.world import load_world
from common.robot.scanner import SCANNERS
from lab.accuracy.panorama import PanoramaShape, train_panorama
from lab.accuracy.scenes import Scene
from presage.terminal.output import check_file, provenance, write_json
from services.estimator.paper import decoder, training
from services.estimator.paper.decoder import Normalisation
from services.estimator.paper.estimator import PaperGenerativeModel
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.evaluation import evaluate_model
from services.estimator.precise.learning.field_learning import Recipe, learn_field, learn_scales
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.generative_models import GenerativeModel

COLUMNS = ("training s", "parameters", "range median mm", "mean mm", "> 5 cm %", "position median mm", "RMS mm")
PAPER = "the paper's decoder, L1, one heading"
HEADING = np.pi / 2  # rad, of all scans for the paper's decoder, which has no heading input
TEST_SCANS, CALIBRATION_SCANS = 200, 300
Learn = Callable[["TrainingScans"], tuple[GenerativeModel, int]]  # returns the model and its number of parameters


class TrainingScans:
    """Noisy scans for training, and noise-free ones for calibration and testing; the laser is at base_link's origin."""

    def __init__(self, world: str, samples: int, seed: int, heading: float | None = None) -> None:
        """Casts scans at random poses: all with the given ``heading`` (rad), or by default with random headings."""
        self.world, self.seed = load_world(world), seed
        self.scanner = SCANNERS["tim571"].model_copy(update={"mount": (0.0, 0.0, 0.0)})
        scene = Scene(self.world, self.scanner, np.random.default_rng(seed))
        self.angles, self.sigma = scene.scanner.angles(), scene.scanner.sigma
        self.poses, self.calibration, self.test = (
            scene.poses(count) for count in (samples, CALIBRATION_SCANS, TEST_SCANS)
        )
        if heading is not None:
            for poses in (self.poses, self.calibration, self.test):
                poses[:, 2] = heading
        clean = scene.clean(self.poses)
        self.ranges = clean + self.sigma * scene.rng.standard_normal(clean.shape)
        self.calibration_ranges, self.test_ranges = scene.clean(self.calibration), scene.clean(self.test)


def field(resolution: float, share: float = 1.0, sweeps: int = 10) -> Learn:
    """Returns a function that learns a distance field from the given share of the scans."""

    def learn(scans: TrainingScans) -> tuple[GenerativeModel, int]:
        count, mount = int(share * len(scans.poses)), np.zeros(3)
        beams = Beams.of(scans.poses[:count], mount, scans.angles, scans.ranges[:count])
        learned = learn_field(beams, Recipe(resolution=resolution, sweeps=sweeps))
        scales = learn_scales(learned, scans.calibration, mount, scans.angles, scans.calibration_ranges, 0.0)
        return FieldModel(learned, scales), learned.phi.size

    return learn


def panorama(steps: int, **shape: Any) -> Learn:
    """Returns a function that trains a panorama network for ``steps`` batches of 256 scans."""

    def learn(scans: TrainingScans) -> tuple[GenerativeModel, int]:
        model = train_panorama(PanoramaShape(**shape), scans.poses, scans.angles, scans.ranges, steps, 0)
        return model, sum(x.numel() for x in model.network.parameters())

    return learn


def paper(epochs: int) -> Learn:
    """Returns a function that trains the paper's decoder on scans of one heading."""

    def learn(scans: TrainingScans) -> tuple[GenerativeModel, int]:
        norm = Normalisation.of(scans.world.bounds, float(scans.ranges.max()))
        parameters = training.TrainingParameters(epochs=epochs, learning_rate=3e-3)
        data = training.TrainingData(scans.poses, scans.ranges)
        held_out = training.TrainingData(scans.calibration, scans.calibration_ranges)
        trainer = training.Trainer(decoder.DecoderShape(len(scans.angles), 128, 8), norm, parameters, data, held_out)
        model = trainer.run()
        size = sum(x.numel() for x in trainer.decoder.parameters())
        return PaperGenerativeModel(model, scans.scanner, HEADING, trainer.progress.test_l1[-1]), size

    return learn


def bench_decoders(world: str, samples: int, steps: int, seed: int, json_file: Path | None, console: Console) -> None:
    """Trains and evaluates the models, prints a table and writes ``json_file`` if given."""
    check_file(json_file, "--json")
    any_heading, one_heading = TrainingScans(world, samples, seed), TrainingScans(world, samples, seed, HEADING)
    rows = [
        _learn_and_evaluate(name, learn, one_heading if name == PAPER else any_heading)
        for name, learn in track(list(_learners(steps).items()), "learning", console=console, transient=True)
    ]
    console.print(_table(rows, f"{world}, {samples} scans of 811 beams with noise of 0.02 m"))
    console.print(
        "position: error of the pose estimated from noise-free scans, starting at the true pose. Only the model "
        "causes it"
    )
    write_json(json_file, {"rows": rows, "samples": samples, "network_steps": steps, **provenance(seed)})


def _learners(steps: int) -> dict[str, Learn]:
    """The compared models by name."""
    return {
        PAPER: paper(max(1, steps // 50)),
        "panorama, Fourier features, SiLU, L1": panorama(steps, loss="l1"),
        "panorama, Fourier features, SiLU, learned precision": panorama(steps),
        "panorama, Fourier features, ReLU, learned precision": panorama(steps, activation="relu"),
        "panorama, 3 x 1024, learned precision": panorama(steps, width=1024, layers=3),
        "panorama, grids of 2 to 0.25 m, learned precision": panorama(steps, inputs="grid"),
        "distance field, 0.08 m": field(0.08),
        "distance field, 0.04 m, surfaces alone (no sweeps)": field(0.04, sweeps=0),
        "distance field, 0.04 m, a tenth of the scans": field(0.04, share=0.1),
        "distance field, 0.04 m": field(0.04),
        "distance field, 0.02 m": field(0.02),
    }


def _learn_and_evaluate(name: str, learn: Learn, scans: TrainingScans) -> dict[str, Any]:
    """One row of the table."""
    began = time.monotonic()
    model, size = learn(scans)
    took = time.monotonic() - began
    errors = evaluate_model(model, scans.test, np.zeros(3), scans.angles, scans.test_ranges, 25.0, scans.sigma)
    return {
        "decoder": name,
        "learning_s": round(took, 1),
        "numbers": size,
        "range_error_median_m": errors.range_error_median,
        "range_error_mean_m": errors.range_error_mean,
        "share_above_5_cm": errors.share_above_5_cm,
        "position_error_median_m": errors.position_error_median,
        "position_error_rms_m": errors.position_error_rms,
    }


def _table(rows: list[dict[str, Any]], title: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("decoder")
    for column in COLUMNS:
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(
            row["decoder"],
            f"{row['learning_s']:.0f}",
            f"{row['numbers'] / 1e6:.2f} M",
            f"{row['range_error_median_m'] * 1e3:.2f}",
            f"{row['range_error_mean_m'] * 1e3:.1f}",
            f"{row['share_above_5_cm'] * 100:.1f}",
            f"{row['position_error_median_m'] * 1e3:.2f}",
            f"{row['position_error_rms_m'] * 1e3:.2f}",
        )
    return table
