"""Trains models in memory from exact rays."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from common.versions import commit, versions
from lab.accuracy.scenes import Scene
from services.estimator.paper import training
from services.estimator.paper.decoder import Normalisation, PaperModel, Shape, use_one_core
from services.estimator.paper.estimator import PaperPerception
from services.estimator.paper.perception import Descent
from services.estimator.paper.training import Data, usable_ranges
from services.estimator.paper.weights import ModelCard
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import SPACING, Seeds, thin_places
from services.estimator.precise.learning.field_learning import (
    Recipe,
    learn_field,
    learn_ripple,
    learn_scales,
    reachable,
)
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.precise.likelihood import Likelihood

# Of the shipped weights. 520 steps are 20 epochs of 13 000 samples in batches of 500: our reading of the paper's "20
# batches of 500 samples", which to the letter are 20 steps.
HIDDEN, CHANNELS, BATCH, RATE, STEPS = 128, 8, 500, 3e-3, 520
WATCHED = 50  # clean scans on which the curve of learning is drawn, after each pass over the samples
JUDGED = 500  # clean scans on which the decoder's own error is measured
CALIBRATED = 10  # one scan in so many gives the field's precision, the others the field


@dataclass(frozen=True)
class Decoder:
    """The paper's generative model."""

    model: PaperModel
    card: ModelCard

    def estimator(self, descent: Descent) -> PaperPerception:
        """One that begins at the map's centre."""
        return PaperPerception(self.model, self.card, descent)


@dataclass(frozen=True)
class Field:
    """The generative model of preset `precise`, and where a search may begin."""

    model: FieldModel
    seeds: Seeds
    learning_s: float  # of one core, not of the wall's clock: trials run side by side

    def estimator(self, scene: Scene) -> PreciseEstimator:
        """One that knows nothing of where it is."""
        scanner = scene.scanner
        return PreciseEstimator(self.model, self.seeds, np.array(scanner.mount), Likelihood(scanner.sigma))


def posed(scene: Scene, count: int, heading: float | None, *, noise: bool = True) -> Data:
    """Scans (count, B) from where the robot fits, at one heading (rad) or any; no return is +inf, too close -inf."""
    poses = scene.poses(count)
    if heading is not None:
        poses[:, 2] = heading
    ranges = scene.clean(poses)
    if noise:
        ranges += scene.scanner.sigma * scene.rng.standard_normal(ranges.shape)
    return Data(poses, scene.scanner.limit(ranges))


def train_paper(scene: Scene, heading: float, samples: int, steps: int, seed: int) -> Decoder:
    """The paper's decoder from so many samples at one heading, by ``steps`` gradient steps (whole epochs, rounded up).

    Learning falls to rate zero within those steps, whatever the number of samples: data differs, not time.
    """
    use_one_core()  # the sums of two threads are others
    train = _usable(posed(scene, samples, heading), scene)
    judge = _usable(posed(scene, JUDGED, heading, noise=False), scene)
    watch = Data(judge.poses[:WATCHED], judge.ranges[:WATCHED])
    recipe = training.Recipe(max(1, -(-steps // -(-samples // BATCH))), BATCH, RATE, seed)
    norm = Normalisation.of(scene.world.bounds, float(train.ranges.max()))
    began = time.process_time()
    trainer = training.Trainer(Shape(scene.scanner.beams, HIDDEN, CHANNELS), norm, recipe, train, watch)
    model = trainer.run()
    took = time.process_time() - began
    error = np.abs(model.ranges(judge.poses) - judge.ranges)
    card = ModelCard(
        preset="paper", world=scene.world, scanner=scene.scanner, heading=heading, samples=samples,
        epochs=recipe.epochs, batch=BATCH, learning_rate=RATE, seed=seed, hidden=HIDDEN, channels=CHANNELS,
        center=norm.center, half_size=norm.half_size, range_scale=norm.range_scale, test_samples=JUDGED,
        test_l1_mean=float(error.mean()), test_l1_median=float(np.median(error)),
        curve_train_l1=trainer.progress.train_l1, curve_test_l1=trainer.progress.test_l1, training_s=took,
        commit=commit(), command="", versions=versions(),
    )  # fmt: skip
    return Decoder(model, card)


def learn_precise(scene: Scene, samples: int, recipe: Recipe | None = None) -> Field:
    """The distance field from so many scans at any heading, a tenth of them for its precision; all with noise."""
    scanner, recipe = scene.scanner, recipe or Recipe()
    mount, angles = np.array(scanner.mount), scanner.angles()
    data = posed(scene, samples, None)
    split = max(1, samples // CALIBRATED)
    began = time.process_time()
    field = learn_field(Beams.of(data.poses[split:], mount, angles, data.ranges[split:]), recipe)
    held, scans = data.poses[:split], data.ranges[:split]
    model = FieldModel(field, learn_scales(field, held, mount, angles, scans, scanner.sigma))
    model = replace(model, ripple=learn_ripple(field, se2.compose(held, mount), angles))
    visited = se2.compose(data.poses, mount)[:, :2]
    places = thin_places(np.concatenate([visited, reachable(field, visited)]), SPACING)
    return Field(model, Seeds.at(model, places), time.process_time() - began)


def steps_of(card: ModelCard) -> int:
    """Gradient steps that were made."""
    return card.epochs * -(-card.samples // card.batch)


def range_errors(model: PaperModel | FieldModel, scene: Scene, data: Data) -> Array:
    """(N, B) m, absolute, of the ranges that a model expects at the poses; where either is no return: left out, NaN."""
    if isinstance(model, PaperModel):
        return np.asarray(np.abs(model.ranges(data.poses) - usable_ranges(data.ranges, scene.scanner.range_max)))
    expected = model.expect(se2.compose(data.poses, np.array(scene.scanner.mount)), scene.scanner.angles()).ranges
    both = np.isfinite(expected) & np.isfinite(data.ranges)
    off = np.subtract(expected, data.ranges, out=np.full(expected.shape, np.nan), where=both)
    return np.asarray(np.abs(off))


def _usable(data: Data, scene: Scene) -> Data:
    return Data(data.poses, usable_ranges(data.ranges, scene.scanner.range_max))
