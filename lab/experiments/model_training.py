"""Trains models in memory from exact rays."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from common.versions import commit, versions
from lab.accuracy.scenes import Scene
from services.estimator.paper import training
from services.estimator.paper.decoder import DecoderShape, Normalisation, PaperModel, use_one_core
from services.estimator.paper.estimator import PaperEstimator
from services.estimator.paper.perception import Descent
from services.estimator.paper.training import TrainingData, usable_ranges
from services.estimator.paper.weights import ModelCard
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import Seeds
from services.estimator.precise.learning.field_learning import (
    Recipe,
    learn_field,
    learn_scales,
    seed_places,
)
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.precise.likelihood import Likelihood

# Values of the shipped weights. 520 steps are 20 epochs of 13 000 samples in batches of 500: our interpretation of the
# paper's "20 batches of 500 samples", which literally means 20 steps.
HIDDEN_UNITS, CHANNELS, BATCH_SIZE, LEARNING_RATE, GRADIENT_STEPS = 128, 8, 500, 3e-3, 520
CURVE_SCANS = 50  # noise-free scans for the learning curve, evaluated after each epoch
TEST_SCANS = 500  # noise-free scans for the decoder's error
CALIBRATION_DIVISOR = 10  # one scan in ten calibrates the field's precision; the others train the field


@dataclass(frozen=True)
class TrainedDecoder:
    """The paper's generative model, trained in memory."""

    model: PaperModel
    card: ModelCard

    def estimator(self, descent: Descent) -> PaperEstimator:
        """A new estimator that starts at the map's centre."""
        return PaperEstimator(self.model, self.card, descent)


@dataclass(frozen=True)
class TrainedField:
    """The generative model of preset `precise` and the seeds of its global search, trained in memory."""

    model: FieldModel
    seeds: Seeds
    learning_s: float  # processor time; wall time would depend on the trials running in parallel

    def estimator(self, scene: Scene) -> PreciseEstimator:
        """A new estimator without a start pose."""
        scanner = scene.scanner
        return PreciseEstimator(self.model, self.seeds, np.array(scanner.mount), Likelihood(scanner.sigma))


def sample_scans(scene: Scene, count: int, heading: float | None, *, noise: bool = True) -> TrainingData:
    """Scans (count, B) from random places where the robot fits, at the given heading (rad) or at random headings.

    Ranges are in m: +inf means no return, -inf too close.
    """
    poses = scene.poses(count)
    if heading is not None:
        poses[:, 2] = heading
    ranges = scene.clean(poses)
    if noise:
        ranges += scene.scanner.sigma * scene.rng.standard_normal(ranges.shape)
    return TrainingData(poses, scene.scanner.limit(ranges))


def train_paper(scene: Scene, heading: float, samples: int, steps: int, seed: int) -> TrainedDecoder:
    """Trains the paper's decoder on ``samples`` scans of one heading, with ``steps`` gradient steps.

    The steps are rounded up to whole epochs. The learning rate decays to zero within them whatever the number of
    samples, so that experiments compare amounts of data and not training times.
    """
    use_one_core()  # floating-point sums depend on the number of threads
    train = _usable(sample_scans(scene, samples, heading), scene)
    test = _usable(sample_scans(scene, TEST_SCANS, heading, noise=False), scene)
    curve = TrainingData(test.poses[:CURVE_SCANS], test.ranges[:CURVE_SCANS])
    parameters = training.TrainingParameters(
        max(1, -(-steps // -(-samples // BATCH_SIZE))), BATCH_SIZE, LEARNING_RATE, seed
    )
    norm = Normalisation.of(scene.world.bounds, float(train.ranges.max()))
    began = time.process_time()
    trainer = training.Trainer(
        DecoderShape(scene.scanner.beams, HIDDEN_UNITS, CHANNELS), norm, parameters, train, curve
    )
    model = trainer.run()
    took = time.process_time() - began
    error = np.abs(model.ranges(test.poses) - test.ranges)
    card = ModelCard(
        preset="paper",
        world=scene.world,
        scanner=scene.scanner,
        heading=heading,
        samples=samples,
        epochs=parameters.epochs,
        batch=BATCH_SIZE,
        learning_rate=LEARNING_RATE,
        seed=seed,
        hidden=HIDDEN_UNITS,
        channels=CHANNELS,
        center=norm.center,
        half_size=norm.half_size,
        range_scale=norm.range_scale,
        test_samples=TEST_SCANS,
        test_l1_mean=float(error.mean()),
        test_l1_median=float(np.median(error)),
        curve_train_l1=trainer.progress.train_l1,
        curve_test_l1=trainer.progress.test_l1,
        training_s=took,
        commit=commit(),
        command="",
        versions=versions(),
    )
    return TrainedDecoder(model, card)


def learn_precise(scene: Scene, samples: int) -> TrainedField:
    """Trains the distance field on ``samples`` noisy scans at random headings; a tenth of them calibrates precision."""
    scanner, recipe = scene.scanner, Recipe()
    mount, angles = np.array(scanner.mount), scanner.angles()
    data = sample_scans(scene, samples, None)
    split = max(1, samples // CALIBRATION_DIVISOR)
    began = time.process_time()
    field = learn_field(Beams.of(data.poses[split:], mount, angles, data.ranges[split:]), recipe)
    held, scans = data.poses[:split], data.ranges[:split]
    model = FieldModel(field, learn_scales(field, held, mount, angles, scans, scanner.sigma))
    visited = se2.compose(data.poses, mount)[:, :2]
    places = seed_places(field, visited)
    return TrainedField(model, Seeds.at(model, places), time.process_time() - began)


def steps_of(card: ModelCard) -> int:
    """Number of gradient steps of the training."""
    return card.epochs * -(-card.samples // card.batch)


def range_errors(model: PaperModel | FieldModel, scene: Scene, data: TrainingData) -> Array:
    """Absolute errors (N, B), m, of the ranges that a model predicts; NaN where a return is missing in either."""
    if isinstance(model, PaperModel):
        return np.asarray(np.abs(model.ranges(data.poses) - usable_ranges(data.ranges, scene.scanner.range_max)))
    expected = model.expect(se2.compose(data.poses, np.array(scene.scanner.mount)), scene.scanner.angles()).ranges
    both = np.isfinite(expected) & np.isfinite(data.ranges)
    error = np.subtract(expected, data.ranges, out=np.full(expected.shape, np.nan), where=both)
    return np.asarray(np.abs(error))


def _usable(data: TrainingData, scene: Scene) -> TrainingData:
    return TrainingData(data.poses, usable_ranges(data.ranges, scene.scanner.range_max))
