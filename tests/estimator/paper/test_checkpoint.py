"""Checkpoints of a training: resumed with the same recipe, discarded with another, damage is one line of error."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from common.errors import UserError
from services.estimator.paper.checkpoint import Checkpoint
from services.estimator.paper.decoder import Shape
from services.estimator.paper.training import Recipe, Trainer
from tests.estimator.models import normalisation, posed_scans

DATA = posed_scans(60, 1)
RECIPE = {"epochs": 3, "world": "room"}


def trainer() -> Trainer:
    return Trainer(Shape(64, 8, 2), normalisation(), Recipe(epochs=3, batch=20), DATA, DATA)


@pytest.fixture
def folder(tmp_path):
    """The folder of an interrupted training."""
    checkpoint = Checkpoint(tmp_path / "unfinished", RECIPE)
    assert not checkpoint.discarded
    checkpoint.keep_samples("train", DATA)
    one = trainer()
    one.run(lambda progress: checkpoint.save(one) if progress.epoch == 2 else None)
    return checkpoint.folder


def test_the_same_recipe_takes_it_up(folder):
    again = Checkpoint(folder, RECIPE)
    assert not again.discarded
    kept = again.samples("train")
    assert np.array_equal(kept.poses, DATA.poses)
    assert kept.ranges == pytest.approx(DATA.ranges, abs=1e-5)
    whole, rest = trainer(), trainer()
    assert again.restore(rest)
    assert rest.progress.epoch == 2
    for a, b in zip(whole.run().decoder.parameters(), rest.run().decoder.parameters(), strict=True):
        assert torch.equal(a, b)


def test_another_recipe_throws_it_away_and_says_so(folder):
    other = Checkpoint(folder, {**RECIPE, "epochs": 4})
    assert other.discarded
    assert other.samples("train") is None
    assert not other.restore(trainer())
    assert not Checkpoint(folder, RECIPE).discarded  # nothing was in it yet


@pytest.mark.parametrize(
    "garbage", [b"", b"no archive at all", b"PK\x03\x04" + bytes(200)], ids=["empty", "text", "zip"]
)
def test_damaged_samples_are_one_line(folder, garbage):
    (folder / "train.npz").write_bytes(garbage)
    damaged(folder / "train.npz", lambda: Checkpoint(folder, RECIPE).samples("train"))


@pytest.mark.parametrize("arrays", [{"poses": np.zeros((4, 3))}, {"poses": np.zeros((4, 3)), "ranges": np.zeros(3)}])
def test_samples_that_are_none_are_one_line(folder, arrays):
    np.savez(folder / "train.npz", **arrays)
    damaged(folder / "train.npz", lambda: Checkpoint(folder, RECIPE).samples("train"))


def test_a_damaged_byte_is_noticed(folder):
    data = bytearray((folder / "train.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "train.npz").write_bytes(data)
    damaged(folder / "train.npz", lambda: Checkpoint(folder, RECIPE).samples("train"))


@pytest.mark.parametrize("keep", [0, 5, 100, 2000])
def test_a_damaged_state_is_one_line(folder, keep):
    path = folder / "state.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    damaged(path, lambda: Checkpoint(folder, RECIPE).restore(trainer()))


def damaged(path, read):
    with pytest.raises(UserError, match="cannot be resumed") as error:
        read()
    assert str(path) in str(error.value)
    assert f"remove {path.parent} and train from the start" in str(error.value)
    assert "\n" not in str(error.value)
