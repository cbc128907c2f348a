"""A recording alone is enough to run the session's estimator again, with the map and the weights stored in it."""

from __future__ import annotations

import json
import shutil

import pytest

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Belief, Scan
from common.messages.topics import BELIEF, SCAN
from services.recorder.reader import read_recording
from tests.conftest import ROOT, wait_for_message
from tests.estimator.models import change_weights

SCANS = 15  # a second
SERVICES = {"recorder", "controller", "estimator", "simulator"}


def other_weights(folder, file):
    """Weights that differ from the shipped ones, so that a fallback to those is detected."""
    folder.mkdir()
    for suffix in ("safetensors", "json"):
        shutil.copy(ROOT / "models" / f"{file}.{suffix}", folder)
    change_weights(folder / f"{file}.safetensors")
    return folder


def record(process, bus, folder, *estimator):
    """Records one second of a lockstep session. Returns the recording."""
    scans = Inbox()
    bus.subscribe(SCAN, scans, keep_all=True)
    started = [
        process("recorder", "--directory", str(folder), "--file", "session"),
        process("controller", "--belief-timeout", "60"),
        process("estimator", "--initial-pose", "3.1,1.6", "--seed", "4", *estimator),
        process("simulator", "--beams", "622", "--pace", "lockstep", "--wait-for", "estimator,controller,recorder"),
    ]
    assert wait_until(lambda: bus.alive() >= SERVICES, 60)
    wait_for_message(scans, Scan, lambda scan: scan.seq >= SCANS)
    active = folder / "session.mcap.active"
    assert wait_until(lambda: b"model/world.yaml" in active.read_bytes(), 30), started[0].output
    for running in reversed(started):
        assert running.stop()[0] == 0, running.output
    return read_recording(folder / "session.mcap")


def extract(recording, folder):
    """Writes the attachments as files into ``folder`` under their names."""
    for name, data in recording.attachments.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def rerun(process, bus, config, folder, scans):
    """Runs an estimator with the recorded settings over the recorded scans. Returns its beliefs."""
    kept = {name: config[name] for name in ("estimator", "model", "initial_pose", "seed", "sigma", "prior")}
    kept = {name: value for name, value in kept.items() if value is not None}
    args = [part for name, value in kept.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    beliefs = Inbox()
    bus.subscribe(BELIEF, beliefs, keep_all=True)
    running = process(
        "estimator", "--models", str(folder / "model"), "--world", str(folder / "model/world.yaml"), *args
    )
    assert wait_until(lambda: "estimator" in bus.alive(), 60), running.output
    assert bus.wait_matching(SCAN, 10)
    found = []
    for scan in scans:
        bus.put(SCAN, scan.encode())
        found.append(wait_for_message(beliefs, Belief, lambda belief, s=scan: belief.stamp_ns == s.stamp_ns))
    assert running.stop()[0] == 0
    return found


@pytest.mark.parametrize(("estimator", "file"), [("precise", "corridor-precise"), ("paper", "corridor-paper-622")])
def test_a_recording_alone_reproduces_the_estimator(process, bus, tmp_path, estimator, file):
    mine = other_weights(tmp_path / "mine", file)
    recording = record(process, bus, tmp_path / "logs", "--estimator", estimator, "--models", str(mine))
    model = recording.metadata["model"]
    assert model["estimator"] == estimator
    assert model["file"] == f"{file}.safetensors"
    assert model["card"] == (mine / f"{file}.json").read_text()
    assert recording.attachments[f"model/{file}.safetensors"] == (mine / f"{file}.safetensors").read_bytes()
    assert recording.attachments[f"model/{file}.json"] == model["card"].encode()
    shutil.rmtree(mine)

    messages = [message for _, message, _ in recording.messages(SCAN, BELIEF)]
    before = {m.stamp_ns: m for m in messages if isinstance(m, Belief)}
    scans = [m for m in messages if isinstance(m, Scan) and m.stamp_ns in before]
    assert len(scans) >= SCANS
    config = json.loads(recording.metadata["config:estimator"]["config"])
    again = rerun(process, bus, config, extract(recording, tmp_path / "extracted"), scans)
    assert again == [before[scan.stamp_ns] for scan in scans]


def test_a_recording_with_the_particle_filter_contains_the_map(process, bus, tmp_path):
    recording = record(process, bus, tmp_path / "logs", "--estimator", "particle-filter")
    assert recording.metadata["model"] == {
        "estimator": "particle-filter", "card": "", "file": "", "weights": "none: nothing was learned",
    }  # fmt: skip
    assert recording.attachments["model/world.yaml"]
    assert not any(name.endswith(".safetensors") for name in recording.attachments)


def test_a_restarted_service_is_queried_for_its_new_settings(process, bus, tmp_path):
    recorder = process("recorder", "--directory", str(tmp_path), "--file", "session")
    recorder.wait_for("ready")
    active = tmp_path / "session.mcap.active"
    for gamma in ("0.41", "0.42", "0.41"):
        known, setting = len(active.read_bytes()), f'"gamma": {gamma}'.encode()
        running = process("controller", "--gamma", gamma)
        assert wait_until(lambda at=known, t=setting: t in active.read_bytes()[at:], 30), recorder.output
        running.kill()  # without a clean exit; the recorder must notice its successor anyway
    assert recorder.stop()[0] == 0
    config = json.loads(read_recording(tmp_path / "session.mcap").metadata["config:controller"]["config"])
    assert config["gamma"] == 0.41
