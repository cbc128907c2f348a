"""Checkpoints of a training: resumed with the same parameters, discarded with another, damage is one line of error."""

from __future__ import annotations

import io
from functools import partial

import numpy as np
import pytest
import torch

from common.errors import UserError
from services.estimator.paper.checkpoint import Checkpoint
from services.estimator.paper.decoder import DecoderShape
from services.estimator.paper.training import Trainer, TrainingParameters
from tests.estimator.paper.training_scans import normalisation, posed_scans

DATA = posed_scans(60, 1)
RECIPE = {"epochs": 3, "world": "room"}


def trainer() -> Trainer:
    return Trainer(DecoderShape(64, 8, 2), normalisation(), TrainingParameters(epochs=3, batch=20), DATA, DATA)


@pytest.fixture
def folder(tmp_path):
    """The folder of an interrupted training."""
    checkpoint = Checkpoint(tmp_path / "unfinished", RECIPE)
    assert not checkpoint.discarded
    checkpoint.save_samples("train", DATA)
    one = trainer()
    one.run(lambda progress: checkpoint.save_state(one) if progress.epoch == 2 else None)
    return checkpoint.folder


def test_resumed(folder):
    again = Checkpoint(folder, RECIPE)
    assert not again.discarded
    kept = again.load_samples("train")
    assert np.array_equal(kept.poses, DATA.poses)
    assert kept.ranges == pytest.approx(DATA.ranges, abs=1e-5)
    whole, rest = trainer(), trainer()
    assert again.restore_state(rest)
    assert rest.progress.epoch == 2
    for a, b in zip(whole.run().decoder.parameters(), rest.run().decoder.parameters(), strict=True):
        assert torch.equal(a, b)


def test_other_recipe(folder):
    other = Checkpoint(folder, {**RECIPE, "epochs": 4})
    assert other.discarded
    assert other.load_samples("train") is None
    assert not other.restore_state(trainer())
    assert not Checkpoint(folder, RECIPE).discarded  # nothing was in it yet


def flipped(data):
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]


def arrays(**values):
    def write(_):
        np.savez(stream := io.BytesIO(), **values)
        return stream.getvalue()

    return write


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("train.npz", lambda _: b""),
        ("train.npz", lambda _: b"no archive at all"),
        ("train.npz", lambda _: b"PK\x03\x04" + bytes(200)),
        ("train.npz", flipped),
        ("train.npz", arrays(poses=np.zeros((4, 3)))),
        ("train.npz", arrays(poses=np.zeros((4, 3)), ranges=np.zeros(3))),
        ("state.safetensors", lambda _: b""),
        ("state.safetensors", lambda data: data[:5]),
        ("state.safetensors", lambda data: data[:2000]),
    ],
)
def test_damaged_file(folder, name, damage):
    path = folder / name
    path.write_bytes(damage(path.read_bytes()))
    checkpoint = Checkpoint(folder, RECIPE)
    read = (
        partial(checkpoint.load_samples, "train")
        if name == "train.npz"
        else partial(checkpoint.restore_state, trainer())
    )
    with pytest.raises(UserError, match="cannot be resumed") as error:
        read()
    assert str(path) in str(error.value)
    assert f"remove {folder} and train from the start" in str(error.value)
    assert "\n" not in str(error.value)
