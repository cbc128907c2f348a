"""Weights and cards on disk."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from common.errors import UserError
from services.estimator.paper import weights
from services.estimator.paper.decoder import Decoder
from services.estimator.shared.digest import sha256
from services.estimator.shared.model_folder import SHIPPED
from tests.estimator.models import ROOM, SCANNER


def card(**changes) -> weights.ModelCard:
    values = {
        "preset": "paper", "world": ROOM, "scanner": SCANNER, "heading": 1.5, "samples": 10, "epochs": 1, "batch": 5,
        "learning_rate": 1e-3, "seed": 0, "hidden": 16, "channels": 4, "center": (3.0, 2.0), "half_size": (3.0, 2.0),
        "range_scale": 6.0, "test_samples": 5, "test_l1_mean": 0.1, "test_l1_median": 0.05, "curve_train_l1": [0.1],
        "curve_test_l1": [0.1], "training_s": 1.0, "commit": "c", "command": "presage train", "versions": {},
    }  # fmt: skip
    return weights.ModelCard(**{**values, **changes})


def saved(folder) -> tuple:
    torch.manual_seed(0)
    path = weights.path_of(folder, "room", 64)
    decoder = Decoder(card().shape())
    weights.save(path, decoder, card())
    return path, decoder


def test_saved_and_loaded(tmp_path):
    path, decoder = saved(tmp_path)
    model, read = weights.load(path)
    assert read == card().model_copy(update={"weights_sha256": sha256(path.read_bytes())})
    for a, b in zip(decoder.parameters(), model.decoder.parameters(), strict=True):
        assert torch.equal(a.half().float(), b)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room-paper-64.json", "room-paper-64.safetensors"]


def test_find(tmp_path):
    path, _ = saved(tmp_path)
    assert weights.available(tmp_path, "room") == {64: path}
    assert weights.find(tmp_path, "room", 64) == path
    with pytest.raises(UserError, match="presage train --world room --preset paper --scanner tim571 --beams 99"):
        weights.find(tmp_path, "room", 99)
    with pytest.raises(UserError, match="there are none in"):
        weights.find(tmp_path / "empty", "room", 64)


@pytest.mark.parametrize("beams", [622, 811])
def test_shipped_weights(beams):
    path = weights.find(SHIPPED, "corridor", beams)
    model, read = weights.load(path)
    assert path.stat().st_size < 4e6
    assert read.samples == 13_000
    assert read.scanner.beams == beams
    assert read.command.startswith("presage train")
    assert np.isfinite(model.ranges(np.array([[9.0, 1.5, read.heading]]))).all()
    assert read.test_l1_mean == pytest.approx(read.curve_test_l1[-1], rel=0.05)
