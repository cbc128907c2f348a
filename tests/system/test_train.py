"""`presage train`: weights that an estimator uses, from its own simulator or the running scanner; resuming."""

from __future__ import annotations

import signal

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Belief
from common.messages.topics import BELIEF
from tests.conftest import wait_for_message

WORLD = """
name: closet
boundary: [[0, 0], [3, 0], [3, 2], [0, 2]]
obstacles:
  - circle: {center: [2.4, 1.4], radius: 0.3}
start: {x: 1, y: 1, yaw_deg: 90}
"""


@pytest.fixture
def world(tmp_path):
    path = tmp_path / "world.yaml"
    path.write_text(WORLD)
    return str(path)


@pytest.fixture
def train(process, world, tmp_path):
    """A function that starts a training; the weights get into ``tmp_path / "models"``."""

    config = tmp_path / "train.yaml"
    config.write_text("train: {batch: 50, epochs: 12}")
    args = ("--world", world, "--out", str(tmp_path / "models"), "--config", str(config), "--beams", "61")

    def start(preset, samples):
        return process("presage.__main__", "train", "--preset", preset, "--samples", str(samples), *args)

    return start


def assert_used(preset, process, bus, world, tmp_path):
    """An estimator with the trained weights publishes beliefs of a running simulator's scans."""
    stem = {"precise": "closet-precise", "paper": "closet-paper-61"}[preset]
    names = {path.name for path in (tmp_path / "models").iterdir()}
    assert names == {f"{stem}.json", f"{stem}.png", f"{stem}.safetensors"}
    beliefs = Inbox()
    bus.subscribe(BELIEF, beliefs)
    process("estimator", "--world", world, "--models", str(tmp_path / "models"), "--estimator", preset)
    wait_for_message(beliefs, Belief, lambda belief: belief.estimator == preset)


def test_precise_with_own_simulator(process, bus, world, train, tmp_path):
    training = train("precise", 300)
    assert training.wait(120) == 0, training.output
    use = f"use it with: presage up --world={world} --model={tmp_path / 'models'} --config={tmp_path / 'train.yaml'}"
    assert training.output.splitlines()[-1] == use
    process("simulator", "--world", world, "--beams", "61")
    assert_used("precise", process, bus, world, tmp_path)


def test_interrupted_paper_training(process, bus, world, train, tmp_path):
    process("simulator", "--world", world, "--beams", "61")
    assert wait_until(lambda: "simulator" in bus.alive(), 60)
    training = train("paper", 100)
    state = tmp_path / "models" / ".closet-paper-61.unfinished" / "state.safetensors"
    assert wait_until(lambda: state.exists() or not training.running, 60)
    assert "samples come from the running scanner tim571 in closet" in training.output
    assert training.stop(signal.SIGINT) == 130, training.output
    assert not list((tmp_path / "models").glob("*.safetensors"))
    again = train("paper", 100)
    assert again.wait(150) == 0, again.output
    assert "an interrupted run" in again.output
    assert_used("paper", process, bus, world, tmp_path)
