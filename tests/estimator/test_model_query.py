"""Query `model`: the description of the model, and that the same estimator can be built from the reply."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from common.errors import UserError
from common.geometry.world import load_world, save_world
from common.messages.requests import ModelRequest
from common.messages.topics import MODEL, SCAN
from services.estimator.paper import weights
from tests.estimator.models import change_weights
from tests.estimator.test_service import TRUTH, a_scan, opened


def ask(service, *, with_weights=True):
    return service.on_request(MODEL, ModelRequest(weights=with_weights))


def extracted(reply, folder):
    """Writes the reply to files, as a recording does."""
    folder.mkdir()
    (folder / reply.file).write_bytes(reply.weights.tobytes())
    (folder / reply.file).with_suffix(".json").write_text(reply.card)
    (folder / "world.yaml").write_text(save_world(reply.world))
    return folder


@pytest.fixture
def shipped(tmp_path):
    """A copy of the shipped weights, which a test may damage."""
    return Path(shutil.copytree(weights.FOLDER, tmp_path / "mine", ignore=shutil.ignore_patterns("*.png")))


def beliefs(service):
    rng = np.random.default_rng(0)
    for stamp in range(3):
        exact = a_scan(stamp, TRUTH)
        service.on_message(SCAN, a_scan(stamp, ranges=exact.ranges + rng.normal(0, 0.02, 622)))
    return service.sent


@pytest.mark.parametrize(
    ("settings", "file"),
    [({"estimator": "precise"}, "corridor-precise"), ({"estimator": "paper"}, "corridor-paper-622")],
)
def test_same_estimator_from_reply(settings, file, shipped, tmp_path):
    # These weights differ from the shipped ones, so that use of the shipped ones by mistake is noticed.
    data = change_weights(shipped / f"{file}.safetensors")
    service = opened(models=shipped, **settings)
    first = beliefs(service)
    reply = ask(service)
    assert reply.estimator == settings["estimator"]
    assert reply.file == f"{file}.safetensors"
    assert reply.weights.tobytes() == data
    assert reply.size == len(data)
    assert reply.card == (shipped / f"{file}.json").read_text()
    folder = extracted(reply, tmp_path / "model")
    shutil.rmtree(shipped)
    again = opened(models=folder, world=str(folder / "world.yaml"), **settings)
    assert beliefs(again) == first
    assert ask(again) == reply
    assert beliefs(opened(**settings)) != first  # the difference is visible


def test_without_weights(shipped):
    service = opened(models=shipped)
    reply = ask(service, with_weights=False)
    assert len(reply.weights) == 0
    assert reply.size == (shipped / reply.file).stat().st_size
    assert reply == ask(service).model_copy(update={"weights": reply.weights})


def test_file_name(shipped, tmp_path):
    for suffix in (".safetensors", ".json"):
        (shipped / f"corridor-precise{suffix}").rename(tmp_path / f"mine-of-old{suffix}")
    service = opened(model=str(tmp_path / "mine-of-old.safetensors"), world="maze")
    reply = ask(service)
    assert reply.file == "corridor-precise.safetensors"
    assert reply.world == load_world("corridor")
    folder = extracted(reply, tmp_path / "model")
    assert beliefs(opened(models=folder, world=str(folder / "world.yaml"))) == beliefs(service)


@pytest.mark.parametrize("settings", [{"estimator": "particle-filter"}, {"model": "exact"}])
def test_nothing_learned(settings):
    reply = ask(opened(**settings))
    assert reply.ok
    assert (reply.file, reply.card, reply.size) == ("", "", 0)
    assert reply.world == load_world("corridor")


def test_paper_before_first_scan():
    service = opened(estimator="paper")
    reply = ask(service)
    assert not reply.ok
    assert "no scan has come yet" in reply.reason
    service.on_message(SCAN, a_scan(1))
    assert ask(service).file == "corridor-paper-622.safetensors"
    beams = np.full(811, 2.0)
    service.on_message(SCAN, a_scan(2, ranges=beams, angle_increment=2 * -a_scan(1).angle_min / 810))
    assert ask(service).file == "corridor-paper-811.safetensors"
    assert json.loads(ask(service).card)["scanner"]["beams"] == 811


def test_weights_changed_on_disk(shipped):
    service = opened(models=shipped)
    path = shipped / "corridor-precise.safetensors"
    before = ask(service)
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(UserError, match=f"{path} was changed since the estimator loaded it"):
        ask(service)
    assert ask(service, with_weights=False).sha256 == before.sha256
    service.on_message(SCAN, a_scan(1, TRUTH))  # the first scan does not read the files again
    assert ask(service, with_weights=False).sha256 == before.sha256
    path.unlink()
    with pytest.raises(UserError, match="cannot be read"):
        ask(service)
