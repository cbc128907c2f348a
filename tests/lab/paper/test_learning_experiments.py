"""Small runs of the experiments on generative models: samples, aliasing and prediction."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry.world import load_world
from lab.accuracy.scenes import ROBOT, TWIN_OFFSET, Scene
from lab.experiments import model_training as learning
from lab.experiments.estimators import ExperimentWorld
from lab.paper import aliasing, prediction, samples
from services.estimator.shared.interface import Hypothesis, Posterior

QUIET = Console(quiet=True)
SMALL = samples.SamplesJob(3, steps=6, places=2, iterations=3, held_out=20, field=ExperimentWorld("corridor", 60))
FEW = aliasing.AliasingJob(3, places=2, iterations=3, beams=120, samples=60, steps=5, scans=200)


def timeless(row):
    return {name: value for name, value in row.items() if name != "learning_s"}


@pytest.mark.parametrize("name", samples.ESTIMATORS)
def test_reproducible_samples(name):
    job = replace(SMALL, estimator=name, samples=80)
    first, fewer = samples.trial(job), samples.trial(replace(job, samples=40))
    assert timeless(samples.trial(job)) == timeless(first)
    assert timeless(samples.trial(replace(job, seed=4))) != timeless(first)
    assert fewer.get("gradient_steps") == first.get("gradient_steps")


def test_more_scans_are_better():
    job = replace(SMALL, estimator="precise", held_out=200)
    few, many = (samples.trial(replace(job, samples=size)) for size in (30, 600))
    assert many["range_error_median_m"] < 0.6 * few["range_error_median_m"]
    assert max(many["position_error_m"]) < 0.05  # from nothing, one scan of 60 beams
    assert many["bound_median_m"] == few["bound_median_m"]  # judged at the same places


def test_files_of_samples(tmp_path):
    result = samples.run(SMALL, tmp_path, 1, QUIET, (40, 80))
    data = json.loads((tmp_path / "samples.json").read_text())
    assert list(data["summary"]) == ["paper, 40", "paper, 80", "precise, 40", "precise, 80"]
    assert len(samples.table(result.summary).splitlines()) == 2 + 4
    assert len((tmp_path / "samples.csv").read_text().splitlines()) == 1 + 2
    assert (tmp_path / "samples.png").stat().st_size > 10_000


def test_error_of_the_decoder():
    scene = Scene.of(load_world("corridor"), 40, 5)
    decoder = learning.train_paper(scene, 1.0, 200, 5, 0)
    fresh = learning.sample_scans(Scene.of(load_world("corridor"), 40, 6), 500, 1.0, noise=False)
    error = learning.range_errors(decoder.model, scene, fresh)
    assert decoder.card.test_l1_mean == pytest.approx(error.mean(), rel=0.1)
    assert decoder.card.heading == 1.0


def test_twin_scans():
    scene = aliasing.scene_of(replace(FEW, world="twins"), aliasing.PLACES_SEED)
    poses = aliasing.sample_places(scene, 40)
    assert poses.shape == (40, 3)
    right = poses[:, 0] > TWIN_OFFSET
    assert 0 < right.sum() < 40
    other = poses + np.where(right, -1, 1)[:, None] * np.array([TWIN_OFFSET, 0, 0])
    assert np.abs(scene.clean(poses) - scene.clean(other)).max() < 1e-6
    assert scene.world.clearance(poses[:, :2]).min() > ROBOT.radius


def test_boxes_of_a_scene():
    boxes = [o.box for o in aliasing.ALIKE.obstacles]
    assert len({box.size for box in boxes}) == 1
    x = np.array([box.center[0] for box in boxes])
    assert np.diff(x) == pytest.approx(np.diff(x)[0])
    assert aliasing.ALIKE.bounds == load_world("corridor").bounds


def belief(state, *places):
    share = 1 / len(places)
    hypotheses = tuple(Hypothesis(np.array([*place, 0.0]), None, share) for place in places)
    return Posterior(state, hypotheses, 0.0, 0.0, np.zeros(3), np.eye(3), np.zeros(1))


@pytest.mark.parametrize(
    ("posterior", "wrong", "kept"),
    [
        (belief("tracking", (1.0, 1.0)), 0, 0),
        (belief("tracking", (1.0 + TWIN_OFFSET, 1.0)), 1, 0),
        (belief("tracking", (1.3, 1.0)), 0, 0),
        (belief("localising", (3.0, 1.0)), 0, 0),
        (belief("ambiguous", (1.0 + TWIN_OFFSET, 1.0), (1.0, 1.1)), 0, 1),
        (belief("ambiguous", (1.0, 1.0), (3.0, 1.0)), 0, 0),
        (belief("tracking", (1.0, 1.0), (1.0 + TWIN_OFFSET, 1.0)), 0, 0),
    ],
)
def test_wrong_claims(posterior, wrong, kept):
    row = aliasing._row(np.array([1.0, 1.0, 0.0]), [posterior], twins=True)
    assert (row["wrong"], row["both_kept"]) == ([wrong], kept)


def test_small_aliasing(tmp_path):
    result = aliasing.run(FEW, tmp_path, 1, QUIET, ("twins",))
    summary = result.summary
    assert list(summary) == [f"twins, {name}" for name in aliasing.ESTIMATORS]
    assert summary["twins, precise"]["at_either_within_0.2_m"] == 2
    assert summary["twins, precise"]["tracking_but_wrong_ever"] == 0
    assert summary["twins, paper"]["both_kept"] == 0  # one belief cannot
    assert len(aliasing.table(summary).splitlines()) == 2 + 3
    assert (tmp_path / "aliasing.pdf").exists()
    again = aliasing.trial(replace(FEW, world="twins", estimator="particle-filter"))
    assert again == next(r for r in result.trials if (r["world"], r["estimator"]) == ("twins", "particle-filter"))


def test_calibrated_precision(tmp_path):
    job = prediction.PredictionJob(2, scans=25)
    result = prediction.run(job, tmp_path, 1, QUIET)
    precise, row = result.summary["precise"], result.trials[0]
    for k, (low, high) in {1: (0.65, 0.72), 2: (0.93, 0.97), 3: (0.98, 0.999)}.items():
        assert low < precise[f"within_{k}_sigma"] < high
    # Beams predicted as less precise are less precise: the scanner's noise alone would be too optimistic.
    assert precise["unsure_within_1_sigma"] > precise["unsure_within_noise_alone_1_sigma"] + 0.1
    shares = list(row["models"]["precise"]["within"].values())
    assert shares == sorted(shares)
    assert row["pose"][1] < 3.14 - prediction.FRONT_MARGIN
    measured, expected = np.array(row["measured_m"]), np.array(row["models"]["precise"]["expected_m"])
    assert np.median(np.abs(measured - expected)) < 0.02
    assert result.summary["paper"]["stated_sigma_median_m"] == 1.0
    assert result.summary["paper"]["range_error_mean_m"] == pytest.approx(0.356, rel=0.2)  # as its card says
    assert prediction.trial(job) == row
    assert "Gaussian" in prediction.table(result.summary)


def test_prediction_without_weights(tmp_path):
    with pytest.raises(UserError, match="presage train"):
        prediction.run(prediction.PredictionJob(1, field=ExperimentWorld("maze")), tmp_path, 1, QUIET)
