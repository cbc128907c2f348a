"""The paper's network: its shape, its Jacobian, its learning."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from services.estimator.paper.checkpoint import Checkpoint
from services.estimator.paper.decoder import Decoder, PaperModel, Shape
from services.estimator.paper.training import Recipe, Trainer, usable_ranges
from tests.estimator.models import normalisation, posed_scans

TRAIN, TEST = posed_scans(400, 1), posed_scans(100, 2)
SHAPE = Shape(64, hidden=32, channels=4)
RECIPE = Recipe(epochs=4, batch=50, learning_rate=5e-3)


def trainer() -> Trainer:
    return Trainer(SHAPE, normalisation(), RECIPE, TRAIN, TEST)


@pytest.mark.parametrize("beams", [2, 64, 181, 622, 811])
def test_any_number_of_beams(beams):
    torch.manual_seed(0)
    assert Decoder(Shape(beams))(torch.zeros(3, 2)).shape == (3, beams)


@given(st.floats(0.5, 5.5), st.floats(0.5, 3.5))
def test_jacobian_agrees_with_finite_differences(x, y):
    torch.manual_seed(3)
    model = PaperModel(Decoder(SHAPE).double(), normalisation())
    pose = np.array([x, y, np.pi / 2])
    ranges, jacobian = model.predict(pose)
    assert np.allclose(ranges, model.ranges(pose[None])[0])
    h = 1e-7  # so small that nearly no pose is at the kink of a ReLU
    for axis in range(2):
        step = h * np.eye(3)[axis]
        numeric = (model.ranges((pose + step)[None]) - model.ranges((pose - step)[None]))[0] / (2 * h)
        assert np.median(np.abs(jacobian[:, axis] - numeric)) < 1e-6
        assert np.mean(np.abs(jacobian[:, axis] - numeric) < 1e-5) > 0.9
    assert not jacobian[:, 2].any()  # the heading is constant


def test_learning_lowers_the_error_on_scans_not_trained_on():
    one = Trainer(Shape(64, 64, 8), normalisation(), Recipe(epochs=40, batch=50, learning_rate=5e-3), TRAIN, TEST)
    one.run()
    flat = np.abs(TEST.ranges - np.median(TRAIN.ranges, axis=0)).mean()  # error of a constant prediction
    assert one.progress.test_l1[-1] < 0.8 * flat
    assert one.progress.test_l1[-1] < one.progress.test_l1[0]


def test_same_seed_same_weights_other_seed_others():
    a, b = trainer().run(), trainer().run()
    other = Trainer(SHAPE, normalisation(), Recipe(epochs=4, batch=50, learning_rate=5e-3, seed=1), TRAIN, TEST).run()
    assert np.array_equal(a.ranges(TEST.poses), b.ranges(TEST.poses))
    assert not np.array_equal(a.ranges(TEST.poses), other.ranges(TEST.poses))


def test_an_interrupted_training_ends_in_the_same_weights(tmp_path):
    whole = trainer().run()
    checkpoint = Checkpoint(tmp_path / "unfinished", {"epochs": 4})
    first = trainer()
    with pytest.raises(KeyboardInterrupt):
        first.run(lambda progress: interrupt_after(2, progress, checkpoint, first))
    second = trainer()
    again = Checkpoint(tmp_path / "unfinished", {"epochs": 4})
    assert again.restore(second)
    assert second.progress.epoch == 2
    assert np.array_equal(second.run().ranges(TEST.poses), whole.ranges(TEST.poses))
    again.finish()
    assert not (tmp_path / "unfinished").exists()


def interrupt_after(epoch, progress, checkpoint, running):
    checkpoint.save(running)
    if progress.epoch == epoch:
        raise KeyboardInterrupt


def test_a_checkpoint_of_another_recipe_is_not_taken_up(tmp_path):
    checkpoint = Checkpoint(tmp_path / "c", {"epochs": 4})
    checkpoint.keep_samples("train", TRAIN)
    checkpoint.save(trainer())
    other = Checkpoint(tmp_path / "c", {"epochs": 5})
    assert other.samples("train") is None
    assert not other.restore(trainer())


def test_kept_samples_come_back(tmp_path):
    checkpoint = Checkpoint(tmp_path / "c", {})
    checkpoint.keep_samples("train", TRAIN)
    kept = Checkpoint(tmp_path / "c", {}).samples("train")
    assert np.array_equal(kept.poses, TRAIN.poses)
    assert np.array_equal(kept.ranges, TRAIN.ranges.astype(np.float32))


def test_ranges_without_return_are_the_longest_and_too_close_zero():
    assert usable_ranges(np.array([np.inf, -np.inf, 3.0, 30.0]), 25.0).tolist() == [25.0, 0.0, 3.0, 25.0]
