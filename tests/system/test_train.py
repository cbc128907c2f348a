"""`presage train`: samples from the running scanner or from its own simulator, resuming, and use of the weights."""

from __future__ import annotations

import signal

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox, Sample
from common.messages.definitions import Belief
from common.messages.topics import BELIEF

WORLD = """
name: closet
boundary: [[0, 0], [5, 0], [5, 3], [0, 3]]
obstacles:
  - circle: {center: [4, 2], radius: 0.3}
start: {x: 1.5, y: 1.5, yaw_deg: 90}
"""
SMALL = ("--beams", "61", "--samples", "300")


def train(process, tmp_path, preset, epochs=1):
    config = tmp_path / "train.yaml"
    config.write_text(f"train: {{batch: 50, epochs: {epochs}}}")
    where = ("--world", str(tmp_path / "w.yaml"), "--out", str(tmp_path / "m"), "--config", str(config))
    return process("presage.__main__", "train", "--preset", preset, *where, *SMALL)


@pytest.mark.parametrize(("preset", "stem"), [("precise", "closet-precise"), ("paper", "closet-paper-61")])
def test_training_for_a_custom_world_gives_beliefs(process, bus, tmp_path, preset, stem):
    (tmp_path / "w.yaml").write_text(WORLD)
    folder = str(tmp_path / "m")
    estimator = ("estimator", "--world", str(tmp_path / "w.yaml"), "--models", folder, "--estimator", preset)
    without = process(*estimator)
    assert without.wait(60) == 2
    assert f"presage train --world {tmp_path / 'w.yaml'}" in without.output

    training = train(process, tmp_path, preset, 3)
    assert training.wait(120) == 0, training.output
    assert sorted(p.name for p in (tmp_path / "m").iterdir()) == [
        f"{stem}.json", f"{stem}.png", f"{stem}.safetensors",
    ]  # fmt: skip

    inbox = Inbox()
    bus.subscribe(BELIEF, inbox)
    process(*estimator)
    process("simulator", "--world", str(tmp_path / "w.yaml"), "--beams", "61")
    assert wait_until(lambda: len(inbox) > 0, 60)
    sample = inbox.get(0)
    assert isinstance(sample, Sample)
    assert Belief.decode(sample.payload).estimator == preset


def test_a_running_scanner_provides_the_samples(process, bus, tmp_path):
    (tmp_path / "w.yaml").write_text(WORLD)
    process("simulator", "--world", str(tmp_path / "w.yaml"))
    assert wait_until(lambda: "simulator" in bus.alive(), 60)
    training = train(process, tmp_path, "paper")
    assert training.wait(120) == 0, training.output
    assert "samples come from the running scanner tim571 in closet" in training.output


def test_an_interrupted_training_continues_and_gives_the_same_weights(process, tmp_path):
    (tmp_path / "w.yaml").write_text(WORLD)
    whole = train(process, tmp_path, "paper", 15)
    assert whole.wait(150) == 0, whole.output
    weights = tmp_path / "m" / "closet-paper-61.safetensors"
    first = weights.read_bytes()
    weights.unlink()

    cut = train(process, tmp_path, "paper", 15)
    state = tmp_path / "m" / ".closet-paper-61.unfinished" / "state.safetensors"
    assert wait_until(lambda: state.exists() or not cut.running, 60)
    cut.send(signal.SIGINT)
    assert cut.wait(30) == 130, cut.output
    assert not weights.exists()

    again = train(process, tmp_path, "paper", 15)
    assert again.wait(150) == 0, again.output
    assert "an interrupted run" in again.output
    assert weights.read_bytes() == first
