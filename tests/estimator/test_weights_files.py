"""Weights files of both presets: damage is one line of error, and cards without a digest are accepted."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.errors import UserError
from services.estimator.paper import weights as paper_weights
from services.estimator.precise.field import CLASSES, DistanceField, FieldModel
from services.estimator.precise.learning import weights as precise_weights
from tests.estimator.paper import test_weights as paper
from tests.estimator.precise.learning import test_learning as precise

FIELD = FieldModel(DistanceField(np.ones((30, 40), np.float32), (0.0, 0.0), 0.2))


@pytest.fixture(params=["paper", "precise"])
def files(request, tmp_path):
    """The path of saved weights, their card, and the function that loads them."""
    if request.param == "paper":
        path, load, card = paper.saved(tmp_path)[0], paper_weights.load, paper.card()
    else:
        path, load, card = precise.saved(FIELD, tmp_path), precise_weights.load, precise.card(FIELD)

    def save():
        return paper.saved(tmp_path) if request.param == "paper" else precise.saved(FIELD, tmp_path)

    return SimpleNamespace(path=path, card_path=path.with_suffix(".json"), load=load, card=card, save=save)


@given(position=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_flipped_bit(files, position, bit):
    data = files.path.read_bytes()
    damaged = bytearray(data)
    damaged[int(position * len(data))] ^= 1 << bit
    files.path.write_bytes(damaged)
    with pytest.raises(UserError, match=rf"the file is damaged.*{files.path.stem}\.json.*presage train"):
        files.load(files.path)
    files.path.write_bytes(data)


def test_card_without_digest(files, caplog):
    files.card_path.write_text(files.card.model_dump_json(exclude={"weights_sha256"}))
    files.load(files.path)
    assert "no digest" in caplog.text
    assert str(files.path) in caplog.text


@pytest.mark.parametrize(
    "damage",
    [
        lambda files: files.path.write_bytes(files.path.read_bytes()[:-100]),
        lambda files: files.path.write_bytes(b"\x00" * 64),
        lambda files: files.card_path.unlink(),
        lambda files: files.card_path.write_text('{"preset": 3}'),
    ],
    ids=["cut", "garbage", "no card", "bad card"],
)
def test_damaged_files(files, damage):
    damage(files)
    check_error(files.path, files.load)


def test_full_disk(files, monkeypatch):
    """A card that cannot be written leaves the old files, and no others."""
    files.path.write_bytes(b"old")
    files.card_path.write_text("old")
    monkeypatch.setattr(Path, "write_text", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left") as error:
        files.save()
    assert error.value.filename == str(files.path)
    assert {file: file.read_bytes() for file in files.path.parent.iterdir()} == {
        files.path: b"old",
        files.card_path: b"old",
    }


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("scales", np.ones(3, np.float32)),
        ("scales", np.full(int(np.prod(CLASSES)), np.nan, np.float32)),
        ("panoramas_in_bytes", np.ones((2, 3, 120), np.uint8)),
    ],
    ids=["shape", "not finite", "panoramas"],
)
def test_invalid_field(tmp_path, name, tensor):
    path = precise.saved(FIELD, tmp_path)
    path.write_bytes(safetensors.numpy.save(safetensors.numpy.load_file(path) | {name: tensor}))
    path.with_suffix(".json").write_text(precise.card(FIELD).model_dump_json())
    check_error(path, precise_weights.load)


@pytest.mark.parametrize("older", ["none", "three times the directions"])
def test_panoramas_of_older_versions(tmp_path, older):
    path = precise.saved(FIELD, tmp_path)
    model, seeds, _ = precise_weights.load(path)
    tensors = safetensors.numpy.load_file(path)
    panoramas = tensors.pop("panoramas_in_bytes")
    if older != "none":
        tensors["panoramas_in_bytes"] = np.stack([panoramas, panoramas + 1, panoramas + 2], axis=2)
    path.write_bytes(safetensors.numpy.save(tensors))
    path.with_suffix(".json").write_text(precise.card(FIELD).model_dump_json())
    old_model, old_seeds, _ = precise_weights.load(path)
    assert np.array_equal(old_model.field.phi, model.field.phi)
    assert np.array_equal(old_seeds.panoramas, seeds.panoramas)


def test_card_of_other_shape(tmp_path):
    path, _ = paper.saved(tmp_path)
    path.with_suffix(".json").write_text(paper.card(channels=5).model_dump_json())
    check_error(path, paper_weights.load)


def check_error(path, load):
    with pytest.raises(UserError) as error:
        load(path)
    assert str(path.with_suffix("")) in str(error.value)
    assert "\n" not in str(error.value)
